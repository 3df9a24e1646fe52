"""What every experiment is made of: a case, what came of it and the verdicts on that.

Beside these, what all experiments share: a registry of cases, whose modules are imported when they are
asked for; dataclasses as JSON files, which outlive a process; and the launcher of ``--ranks P``, which
runs each case in an mpirun of its own with the same PETSc options.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Generic, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import PlainValidator, TypeAdapter

from lyra_petsc.api.mpirun import last_words, run_launched
from lyra_petsc.errors import InputError, nearest
from lyra_petsc.output.agreement import replace_text

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


@dataclass(frozen=True)
class Verdict:
    """Whether a claim holds, and why or why not, in words."""

    passed: bool
    words: str

    @property
    def line(self) -> str:
        """``passed: `` or ``FAILED: `` and the words."""
        return f"{'passed' if self.passed else 'FAILED'}: {self.words}"


@dataclass(frozen=True)
class Case:
    """One experiment; the verbs add the scene, what is varied and what is expected.

    Attributes
    ----------
    name : str
        Lower case with hyphens; unique among the cases of a verb.
    title : str
        What is done or compared, in one line.
    """

    name: str
    title: str


C = TypeVar("C", bound=Case)


@dataclass
class Outcome(Generic[C]):
    """What came of a case.

    Attributes
    ----------
    case : Case
    verdicts : dict of name → Verdict
        Empty where the case was left out.
    seconds : float
        Wall time of the whole case [s].
    left_out : str
        Why the case makes no sense here; empty if it was run.
    """

    case: C
    verdicts: dict[str, Verdict] = field(default_factory=dict)
    seconds: float = 0.0
    left_out: str = ""

    @property
    def passed(self) -> bool:
        """Whether every verdict is good, or the case was left out; without verdicts it has not passed."""
        return bool(self.left_out) or (bool(self.verdicts) and not self.failures)

    @property
    def failures(self) -> dict[str, Verdict]:
        """The verdicts that are not good."""
        return {name: verdict for name, verdict in self.verdicts.items() if not verdict.passed}


def passed_of(outcomes: Sequence[Outcome[C]]) -> str:
    """``3 of 4 cases passed``; cases that were left out do not count."""
    run = [outcome for outcome in outcomes if not outcome.left_out]
    return f"{sum(outcome.passed for outcome in run)} of {len(run)} cases passed"


T = TypeVar("T")

StoredArray = Annotated[NDArray[Any], PlainValidator(np.asarray)]
"""An array in a record."""


def save_record(path: Path, record: DataclassInstance) -> None:
    """Write a record; the file is the old or the new one, never half. Call on one rank."""

    def of_numpy(value: NDArray[Any]) -> Any:
        return value.tolist()

    text = json.dumps(asdict(record), indent=2, ensure_ascii=False, default=of_numpy)
    replace_text(path, text + "\n")


def load_record(path: Path, kind: type[T]) -> T:
    """The record in a file; what it holds beside the fields is passed over.

    Raises
    ------
    OSError, ValueError
        If it cannot be read, or holds no such record.
    """
    return TypeAdapter(kind).validate_json(path.read_bytes())


def read_record(path: Path, kind: type[T]) -> T | None:
    """The record in a file; None if there is none, or it is damaged."""
    try:
        return load_record(path, kind)
    except (OSError, ValueError):
        return None


@dataclass(frozen=True)
class Registry(Generic[T]):
    """Names on the command line, in their order, and the modules that define what they stand for.

    Attributes
    ----------
    package : str
        In which the modules are.
    modules : mapping of name → module
        Entry ``some-name`` is the variable ``some_name`` of its module.
    what : str
        What an entry is, for the message about an unknown name.
    """

    package: str
    modules: Mapping[str, str]
    what: str = "unknown case"

    def load(self, name: str, *, key: str | None = None) -> T:
        """The entry of that name.

        Raises
        ------
        InputError
            For a name that is not listed, with the nearest that is; ``key`` is the option that gave it.
        """
        if name not in self.modules:
            raise InputError(f"{self.what}, {nearest(name, self.modules)}", key=key or name)
        module = import_module(f"{self.package}.{self.modules[name]}")
        return cast(T, getattr(module, name.replace("-", "_")))

    def all(self) -> list[T]:
        """Every entry, in the order of the names."""
        return [self.load(name) for name in self.modules]


def in_modules(*modules: tuple[str, str]) -> dict[str, str]:
    """Names and their modules, of modules and the names that each defines, in the order of both."""
    return {name: module for module, names in modules for name in names.split()}


Watch = Callable[[], None]
"""Called before every step, or again and again while a process runs; may raise to end the work."""


@dataclass(frozen=True)
class Launcher:
    """Starts the program on several ranks.

    Attributes
    ----------
    command : sequence of str
        From `lyra_petsc.api.mpirun.find_launcher`.
    verb : str
    petsc : sequence of str
        PETSc's options of the command line.
    """

    command: Sequence[str]
    verb: str
    petsc: Sequence[str]

    def __call__(self, words: Sequence[str], watch: Watch, keep_open: Sequence[int] = ()) -> tuple[int, str]:
        """Run the verb with these words; exit code and last words on stderr, see `run_launched`."""
        program = [*self.command, sys.executable, "-m", "lyra_petsc", self.verb]
        code, heard = run_launched([*program, *words, *self.petsc], watch, keep_open)
        return code, last_words(heard, code)

    def restored(
        self, words: Sequence[str], watch: Watch, restore: Callable[[Path], T | None]
    ) -> tuple[T | None, str]:
        """What a case leaves in the folder of ``--job``, read by ``restore``, and the program's last words.

        Raises
        ------
        InputError
            If the program refuses what it is asked for.
        """
        with TemporaryDirectory(prefix=f"lyra-{self.verb}-") as folder:
            code, told = self([*words, "--job", folder], watch)
            found = restore(Path(folder))
        if found is None and code == InputError.exit_code:
            raise InputError(told)
        return found, told
