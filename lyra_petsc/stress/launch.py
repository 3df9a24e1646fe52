"""``--ranks P``: every case in an mpirun of its own."""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lyra_petsc.errors import InputError
from lyra_petsc.stress.case import Case
from lyra_petsc.stress.exchange import restore
from lyra_petsc.stress.record import Record
from lyra_petsc.stress.runner import Outcome
from lyra_petsc.stress.verdicts import of_physics
from lyra_petsc.study.launch import last_words, run_launched


@dataclass(frozen=True)
class Launcher:
    """Runs cases, each in a launcher's processes.

    Attributes
    ----------
    command : sequence of str
        From `lyra_petsc.study.launch.find_launcher`.
    asked : sequence of str
        Scene and options of ``stress`` that say what is run.
    petsc : sequence of str
        PETSc's options of the command line.
    """

    command: Sequence[str]
    asked: Sequence[str]
    petsc: Sequence[str]

    def __call__(self, case: Case, family: str, watch: Callable[[], None]) -> Outcome:
        """Run a case.

        Raises
        ------
        InputError
            If the launched program refuses what it was asked for.
        """
        with tempfile.TemporaryDirectory(prefix="lyra-stress-") as folder:
            words = [*self.command, sys.executable, "-m", "lyra_petsc", "stress", *self.asked]
            code, heard = run_launched([*words, "--only", case.name, "--job", folder, *self.petsc], watch)
            outcome = restore(Path(folder), case, family)
        if outcome is None:
            if code == InputError.exit_code:
                raise InputError(last_words(heard, code))
            record = Record(case.steps, math.nan, math.nan, stopped=last_words(heard, code))
            outcome = Outcome(case, family, record, of_physics(record))
        return outcome
