"""Wall time of a run by phase, and our names in PETSc's own profile (``-log_view``).

Each phase is a stage of PETSc's profile, too. A stage or an event costs no more than a microsecond unless
the user asks PETSc to log.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import ParamSpec, TypeVar

from petsc4py import PETSc

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

# registered here, as PETSc adds up the stages of all ranks by number: the order must not depend on the way
# a rank takes
STAGES: dict[str, PETSc.Log.Stage] = {}


def _register(name: str) -> None:
    """Make a stage that the profile leaves out until it is pushed; PETSc would call it "Unknown"."""
    STAGES[name] = PETSc.Log.Stage(name)
    STAGES[name].setVisible(False)


for _name in ("mesh", "partition", "assembly", "solve", "balance", "output"):
    _register(_name)
# PETSc registers this one itself, for a server of linear solvers that we never start
PETSc.Log.Stage("PCMPI").setVisible(False)

RESIDUAL, JACOBIAN = "AssembleResidual", "AssembleJacobian"
"""Events, the latter once a Newton iteration; PETSc's table has room for names of 16 letters."""

JACOBIAN_AGAIN = "AssembleAgain"
"""The Jacobian with more regularisation, where the linear solve met negative curvature."""

FROZEN = "AssembleFrozen"
"""Once an attempt at a step: damping, loads and geometry that stay as they are during it."""

GALERKIN = "MGGalerkin"
"""Of the multigrid: coarser matrices."""

SWEEP, TRANSFER = PETSc.Log.Event("MGSweep"), PETSc.Log.Event("MGTransfer")
"""A level's Gauss-Seidel sweep, and transfers between levels; both too often to look them up by name."""

COMPILE = PETSc.Log.Event("CompileKernels")
"""Once for each kernel that is compiled and not loaded from the disk, with those that it calls."""


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Let PETSc charge what happens in the block to the stage ``name``; ended also by an exception."""
    if name not in STAGES:
        _register(name)
    STAGES[name].setVisible(True)
    STAGES[name].push()
    try:
        yield
    finally:
        STAGES[name].pop()


def logged(name: str) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """Decorate a function to be the event ``name``: each call counts once, also if it raises."""
    event = PETSc.Log.Event(name)

    def decorate(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
        @wraps(function)
        def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
            with event:
                return function(*args, **kwargs)

        return call

    return decorate


def _nobody(text: str) -> None:
    pass


class Phases:
    """Charges every second since construction to exactly one phase.

    ``with phases("assembly"):`` charges the block to ``assembly``; a phase entered inside
    another takes its time out of the outer one, so that all phases add up to the total.

    Parameters
    ----------
    clock : callable
        Returns seconds; the wall clock unless a test brings its own.
    tell : callable
        Called with a line where a phase takes long before the first step; on rank 0.
    """

    OTHER = "other"

    def __init__(
        self, clock: Callable[[], float] = time.perf_counter, tell: Callable[[str], None] = _nobody
    ) -> None:
        self._clock, self.tell = clock, tell
        self._seconds: dict[str, float] = {}
        self._open = [self.OTHER]
        self._start = self._charged_until = clock()

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        self.begin(name)
        try:
            with stage(name):
                yield
        finally:
            self.end()

    def begin(self, name: str) -> None:
        """Charge what follows to a phase, until `end`."""
        self._charge()
        self._seconds.setdefault(name, 0.0)
        self._open.append(name)

    def end(self) -> None:
        """Charge again to the phase before."""
        self._charge()
        self._open.pop()

    def begin_compilation(self) -> None:
        """Charge what follows to the compilation of a kernel, until `end_compilation`."""
        self.begin("compilation")
        COMPILE.begin()

    def end_compilation(self) -> None:
        """Charge again to the phase that needed the kernel."""
        COMPILE.end()
        self.end()

    @property
    def total(self) -> float:
        """Seconds since construction."""
        return self._clock() - self._start

    def seconds(self) -> dict[str, float]:
        """Seconds of each phase in the order of first entry, then ``other``: time in none."""
        self._charge()
        other = self._seconds.get(self.OTHER, 0.0)
        return {
            **{name: value for name, value in self._seconds.items() if name != self.OTHER},
            self.OTHER: other,
        }

    def _charge(self) -> None:
        now = self._clock()
        current = self._open[-1]
        self._seconds[current] = self._seconds.get(current, 0.0) + now - self._charged_until
        self._charged_until = now
