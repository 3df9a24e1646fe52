"""Parts of every experiment: the case, its outcome and the verdicts.

Also shared by all experiments: the registry of cases, which imports their modules on demand; dataclasses
stored as JSON files; and the launcher for ``--ranks P``, which runs each case in an mpirun of its own with
the same PETSc options.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import PlainValidator, TypeAdapter

from lyra_petsc.api.mpirun import error_message, run_launched
from lyra_petsc.errors import InputError, suggest
from lyra_petsc.output.file_operations import replace_text
from lyra_petsc.startup import module_command

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


@dataclass(frozen=True)
class Verdict:
    """Whether a claim holds, with the numbers that decided it."""

    passed: bool
    message: str

    @property
    def line(self) -> str:
        """``passed: `` or ``FAILED: ``, then the message."""
        return f"{'passed' if self.passed else 'FAILED'}: {self.message}"


@dataclass(frozen=True)
class Case:
    """One experiment; each verb adds the scene, the varied settings and the expected result.

    Attributes
    ----------
    name : str
        Lower case with hyphens; unique among the cases of a verb.
    title : str
        One line that says what is done or compared.
    """

    name: str
    title: str


C = TypeVar("C", bound=Case)


@dataclass
class Outcome(Generic[C]):
    """The result of a case.

    Attributes
    ----------
    case : Case
    verdicts : dict of name → Verdict
        Empty if the case was left out.
    seconds : float
        Wall time of the whole case [s].
    left_out : str
        Why the case does not apply to the scene; empty if it was run.
    """

    case: C
    verdicts: dict[str, Verdict] = field(default_factory=dict)
    seconds: float = 0.0
    left_out: str = ""

    @property
    def passed(self) -> bool:
        """Whether the case was left out, or has verdicts and all of them passed."""
        return bool(self.left_out) or (bool(self.verdicts) and not self.failures)

    @property
    def status(self) -> str:
        """``passed`` or ``FAILED``."""
        return "passed" if self.passed else "FAILED"

    @property
    def failed(self) -> bool:
        """Whether the case makes the verb end with exit code 1."""
        return self.status == "FAILED"

    @property
    def failures(self) -> dict[str, Verdict]:
        """The verdicts that did not pass."""
        return {name: verdict for name, verdict in self.verdicts.items() if not verdict.passed}


def count_passed(outcomes: Sequence[Outcome[C]]) -> str:
    """``3 of 4 cases passed``; cases that were left out, or compare with nothing, do not count."""
    status = [outcome.status for outcome in outcomes if not outcome.left_out]
    passed, others = status.count("passed"), len(status) - status.count("passed") - status.count("FAILED")
    compared = len(status) - others
    texts = [f"{passed} of {compared} cases passed"] if compared or not others else []
    return ", ".join([*texts, f"{others} measured without a comparison"] if others else texts)


T = TypeVar("T")

OUTCOME_FILE = "outcome.json"
"""File in the folder of ``--job`` by which a launched process returns the record of its case."""

StoredArray = Annotated[NDArray[Any], PlainValidator(np.asarray)]
"""An array in a record."""


def save_record(path: Path, record: DataclassInstance) -> None:
    """Write a dataclass as JSON, replacing the file in one operation. Call on one rank."""

    def array_to_list(value: NDArray[Any]) -> Any:
        return value.tolist()

    text = json.dumps(asdict(record), indent=2, ensure_ascii=False, default=array_to_list)
    replace_text(path, text + "\n")


def load_record(path: Path, kind: type[T]) -> T:
    """Read a dataclass from a JSON file; unknown entries are ignored.

    Raises
    ------
    OSError, ValueError
        If the file cannot be read, or does not hold such a record.
    """
    return TypeAdapter(kind).validate_json(path.read_bytes())


def read_record(path: Path, kind: type[T]) -> T | None:
    """Read a dataclass from a JSON file; None if the file is missing or damaged."""
    try:
        return load_record(path, kind)
    except (OSError, ValueError):
        return None


@dataclass(frozen=True)
class Registry(Generic[T]):
    """Cases by the names of the command line, in listing order, made on demand.

    Attributes
    ----------
    entries : mapping of name → any
        What a case is made of.
    make : callable (name, entry) → case
    """

    entries: Mapping[str, Any]
    make: Callable[[str, Any], T]

    def load(self, name: str) -> T:
        """The case of that name.

        Raises
        ------
        InputError
            For an unknown name; the message suggests the nearest known one.
        """
        if name not in self.entries:
            raise InputError(f"unknown case, {suggest(name, self.entries)}", key=name)
        return self.make(name, self.entries[name])

    def all(self) -> list[T]:
        """Every case, in listing order."""
        return [self.load(name) for name in self.entries]


def member(module: str, name: str) -> Any:
    """The variable ``some_name`` of a module for the name ``some-name``; imports the module."""
    return getattr(import_module(module), name.replace("-", "_"))


Watch = Callable[[], None]
"""Called before every step, or repeatedly while another process runs; may raise to end the work."""


@dataclass(frozen=True)
class Launcher:
    """Starts this program on several ranks.

    Attributes
    ----------
    command : sequence of str
        The mpirun command of `lyra_petsc.api.mpirun.find_launcher`.
    verb : str
    petsc_options : sequence of str
        PETSc options of the command line.
    """

    command: Sequence[str]
    verb: str
    petsc_options: Sequence[str]

    def __call__(
        self, arguments: Sequence[str], watch: Watch, keep_open: Sequence[int] = ()
    ) -> tuple[int, str]:
        """Run the verb; returns the exit code and the last message on stderr, see `run_launched`."""
        program = [*self.command, *module_command("lyra_petsc"), self.verb]
        code, stderr = run_launched([*program, *arguments, *self.petsc_options], watch, keep_open)
        return code, error_message(stderr, code)

    def run_case(self, arguments: Sequence[str], watch: Watch, kind: type[T]) -> tuple[T | None, str]:
        """Run one case with ``--job``; returns its record, None if it left none, and the last message.

        Raises
        ------
        InputError
            If the launched program rejects its arguments.
        """
        with TemporaryDirectory(prefix=f"lyra-{self.verb}-") as folder:
            code, message = self([*arguments, "--job", folder], watch)
            record = read_record(Path(folder) / OUTCOME_FILE, kind)
        if record is None and code == InputError.exit_code:
            raise InputError(message)
        return record, message
