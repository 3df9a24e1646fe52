"""``--ranks P``: every case in an mpirun of its own."""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Sequence
from pathlib import Path

from lyra_petsc.api.mpirun import last_words
from lyra_petsc.errors import InputError
from lyra_petsc.experiments.launch import Launcher, Watch
from lyra_petsc.experiments.stress.case import Case
from lyra_petsc.experiments.stress.record import Record
from lyra_petsc.experiments.stress.runner import Outcome
from lyra_petsc.experiments.stress.verdicts import of_physics

OUTCOME_FILE = "outcome.pickle"


def launched(launcher: Launcher, case: Case, asked: Sequence[str], watch: Watch) -> Outcome:
    """What comes of a case in processes of its own.

    Parameters
    ----------
    launcher : Launcher
    case : Case
    asked : sequence of str
        Scene and options of ``stress`` that say what is run.
    watch : callable
        Called again and again; where it raises, the processes are ended.

    Raises
    ------
    InputError
        If the launched program refuses what it was asked for.
    """
    with tempfile.TemporaryDirectory(prefix="lyra-stress-") as folder:
        code, heard = launcher([*asked, "--only", case.name, "--job", folder], watch)
        outcome = restore(Path(folder), case)
    if outcome is None:
        if code == InputError.exit_code:
            raise InputError(last_words(heard, code))
        record = Record(case.steps, stopped=last_words(heard, code))
        outcome = Outcome(case, of_physics(record), record=record)
    return outcome


def save(outcome: Outcome, folder: Path) -> None:
    """Write an outcome, but for its case, for the process that has launched this one. On one rank."""
    content = {name: value for name, value in vars(outcome).items() if name != "case"}
    (folder / OUTCOME_FILE).write_bytes(pickle.dumps(content))


def restore(folder: Path, case: Case) -> Outcome | None:
    """The outcome in a folder; None if there is none, or the process was stopped while it wrote."""
    try:
        return Outcome(case, **pickle.loads((folder / OUTCOME_FILE).read_bytes()))
    except (OSError, EOFError, pickle.UnpicklingError):
        return None
