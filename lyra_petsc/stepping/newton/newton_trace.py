"""The history of a nonlinear solve, and the state of a failed one.

Arrays have a row for each owned block row. Functions that call the solver are collective.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.points import Layout


@dataclass(frozen=True)
class Iteration:
    """One Newton iterate.

    Attributes
    ----------
    residual : float
        Norm [N] of the residual.
    linear_iterations : int
        Linear iterations of the step to this iterate; 0 for the first iterate.
    linear_reason : int
        KSP's converged reason in this step; 0 for the first iterate.
    taken : float or None
        Fraction of the step that the line search took; None for the first iterate.
    """

    residual: float
    linear_iterations: int
    linear_reason: int
    taken: float | None


@dataclass(frozen=True)
class FailedSolve:
    """The state of a failed solve.

    Attributes
    ----------
    iterations : tuple of Iteration
    norm : float
        Norm [N] of the residual, rows of prescribed unknowns included.
    time : float
        Time [s] of the stage, or the load factor.
    velocity, position : (n_owned, 3)
        Velocities [m/s] and positions [m] of the stage.
    residual : (n_owned, 3)
        Residual [N], possibly with numbers that are not finite.
    forces : dict of name → (n_owned, 3)
        The parts [N] whose sum is the residual.
    prescribed : (n_owned, 3) bool
        Unknowns that handles prescribe.
    snes_reason, ksp_reason : int
    linear_residuals : (n,)
        Residual norms of the last linear solve [N], where KSP kept them.
    """

    iterations: tuple[Iteration, ...]
    norm: float
    time: float
    velocity: Array
    position: Array
    residual: Array
    forces: dict[str, Array]
    prescribed: NDArray[np.bool_]
    snes_reason: int
    ksp_reason: int
    linear_residuals: Array

    def of_vertices(self, n: int) -> FailedSolve:
        """The same without the rows of edges, for n owned vertices."""
        rows = ("velocity", "position", "residual", "prescribed")
        forces = {name: part[:n] for name, part in self.forces.items()}
        return replace(self, forces=forces, **{name: getattr(self, name)[:n] for name in rows})


class Trace:
    """Records the iterations of one SNES.

    Parameters
    ----------
    snes : PETSc.SNES
    points : Layout
    linear_iterations : callable
        Returns the number of linear iterations of the present solve so far.

    Attributes
    ----------
    iterations : list of Iteration
        Those of the present solve.
    """

    def __init__(self, snes: PETSc.SNES, points: Layout, linear_iterations: Callable[[], int]) -> None:
        self._ksp, self._points = snes.getKSP(), points
        self._linear_iterations = linear_iterations
        self.iterations: list[Iteration] = []
        self._linear = 0
        self._last: Array | None = None
        self._ksp.setConvergenceHistory(reset=True)

    def begin_solve(self) -> None:
        """Forget the last solve."""
        self.iterations, self._linear, self._last = [], 0, None

    def monitor(self, snes: PETSc.SNES, number: int, norm: float) -> None:
        """Record the present iterate; for ``SNES.setMonitor``; collective."""
        here = snes.getSolution().getArray(readonly=True).copy()
        linear = self._linear_iterations()
        taken = None
        if number > 0 and self._last is not None:
            increment = here - self._last
            (square,) = self._points.global_sum(float(np.vdot(increment, increment)))
            moved = np.sqrt(square)
            length = snes.getSolutionUpdate().norm()
            taken = float(moved / length) if length > 0.0 else 0.0
        reason = int(self._ksp.getConvergedReason()) if number > 0 else 0
        self.iterations.append(Iteration(norm, linear - self._linear, reason, taken))
        self._linear, self._last = linear, here
