"""Wall time of a run by phase, and the stages and events of PETSc's profile (``-log_view``).

Each phase is also a stage of PETSc's profile. A stage or an event costs at most a microsecond unless the user
asks PETSc to log.
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

# PETSc sums the stages of all ranks by number, so all ranks must register the stages in the same order
STAGES: dict[str, PETSc.Log.Stage] = {}


def _register(name: str) -> None:
    """Create a stage that the profile omits until it is first pushed; PETSc would list it as "Unknown"."""
    STAGES[name] = PETSc.Log.Stage(name)
    STAGES[name].setVisible(False)


for _name in ("mesh", "partition", "assembly", "solve", "balance", "output"):
    _register(_name)
# PETSc registers this stage itself, for a server of linear solvers that is never started here
PETSc.Log.Stage("PCMPI").setVisible(False)

RESIDUAL, JACOBIAN = "AssembleResidual", "AssembleJacobian"
"""Events of assembly, the Jacobian once per Newton iteration. PETSc's table fits names of 16 letters."""

JACOBIAN_AGAIN = "AssembleAgain"
"""Assembly of the Jacobian with more regularisation, after the linear solver found negative curvature."""

FROZEN = "AssembleFrozen"
"""Assembly, once per attempted step, of damping, loads and geometry that are constant during the step."""

GALERKIN = "MGGalerkin"
"""Computation of the multigrid's coarse-level matrices."""

SWEEP, TRANSFER = PETSc.Log.Event("MGSweep"), PETSc.Log.Event("MGTransfer")
"""Gauss-Seidel sweep of a level, and transfers between levels: too frequent to look the events up by name."""

COMPILE = PETSc.Log.Event("CompileKernels")
"""Compilation of a kernel and the kernels it calls; does not count kernels loaded from the cache on disk."""


@contextmanager
def stage(name: str) -> Iterator[None]:
    """A context whose time PETSc charges to the stage ``name``; an exception ends the stage, too."""
    if name not in STAGES:
        _register(name)
    STAGES[name].setVisible(True)
    STAGES[name].push()
    try:
        yield
    finally:
        STAGES[name].pop()


def logged(name: str) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """A decorator that logs each call as the event ``name``, also a call that raises."""
    event = PETSc.Log.Event(name)

    def decorate(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
        @wraps(function)
        def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
            with event:
                return function(*args, **kwargs)

        return call

    return decorate


def _ignore(message: str) -> None:
    pass


class Phases:
    """Charges every second since construction to exactly one phase.

    ``with phases("assembly"):`` charges the block to ``assembly``. The time of a nested phase is not
    charged to the outer phase, so that all phases add up to the total.

    Parameters
    ----------
    clock : callable
        Returns seconds; the wall clock except in tests.
    report : callable
        Called on rank 0 with one line of text when a phase before the first step takes long.
    """

    OTHER = "other"

    def __init__(
        self, clock: Callable[[], float] = time.perf_counter, report: Callable[[str], None] = _ignore
    ) -> None:
        self._clock, self.report = clock, report
        self._seconds: dict[str, float] = {}
        self._active = [self.OTHER]  # nested phases, the innermost last
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
        """Charge the time until `end` to the phase ``name``."""
        self._charge()
        self._seconds.setdefault(name, 0.0)
        self._active.append(name)

    def end(self) -> None:
        """End the innermost phase and charge to the enclosing phase again."""
        self._charge()
        self._active.pop()

    def begin_compilation(self) -> None:
        """Charge the time until `end_compilation` to the compilation of a kernel."""
        self.begin("compilation")
        COMPILE.begin()

    def end_compilation(self) -> None:
        """Charge to the phase that needed the kernel again."""
        COMPILE.end()
        self.end()

    @property
    def total(self) -> float:
        """Seconds since construction."""
        return self._clock() - self._start

    def seconds(self) -> dict[str, float]:
        """Seconds of each phase in the order of first entry, then ``other``: time outside of all phases."""
        self._charge()
        other = self._seconds.get(self.OTHER, 0.0)
        return {
            **{name: value for name, value in self._seconds.items() if name != self.OTHER},
            self.OTHER: other,
        }

    def _charge(self) -> None:
        now = self._clock()
        current = self._active[-1]
        self._seconds[current] = self._seconds.get(current, 0.0) + now - self._charged_until
        self._charged_until = now
