"""``--ranks P``: each case in an mpirun of its own, of this program with the same PETSc options."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from lyra_petsc.api.mpirun import run_launched

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
        """Run the verb with these words; exit code and what was said on stderr, see `run_launched`."""
        program = [*self.command, sys.executable, "-m", "lyra_petsc", self.verb]
        return run_launched([*program, *words, *self.petsc], watch, keep_open)
