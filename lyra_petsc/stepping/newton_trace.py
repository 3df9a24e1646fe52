"""What a nonlinear solve did, iteration by iteration, and where it stood when it failed.

Arrays are rows of the owned vertices; collective where the solver is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.stage_equations import StageEquations


@dataclass(frozen=True)
class Iteration:
    """One Newton iterate.

    Attributes
    ----------
    residual : float
        Norm [N].
    linear_iterations : int
        Of the direction that led here; 0 for the first iterate.
    linear_reason : int
        KSP's reason to stop there; 0 for the first iterate.
    taken : float or None
        Fraction of the direction that the line search took; None for the first iterate.
    """

    residual: float
    linear_iterations: int
    linear_reason: int
    taken: float | None


@dataclass(frozen=True)
class FailedSolve:
    """Where a failed solve stood.

    Attributes
    ----------
    iterations : tuple of Iteration
    norm : float
        Of the residual [N], with prescribed coordinates.
    time : float
        Of the stage [s], or the load factor.
    velocity, position : (n_owned, 3)
        Of the stage, [m/s] and [m].
    residual : (n_owned, 3)
        [N]; may hold numbers that are not finite.
    forces : dict of name → (n_owned, 3)
        The parts that the residual is the sum of [N].
    prescribed : (n_owned, 3) bool
        Coordinates that handles prescribe.
    goal : (n_owned, 3)
        Where they prescribe them to be at the end of the step [m]; elsewhere the position before it.
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
    goal: Array
    snes_reason: int
    ksp_reason: int
    linear_residuals: Array

    def of_vertices(self, n: int) -> FailedSolve:
        """The same with the rows of the n owned vertices alone."""
        rows = ("velocity", "position", "residual", "prescribed", "goal")
        forces = {name: part[:n] for name, part in self.forces.items()}
        return replace(self, forces=forces, **{name: getattr(self, name)[:n] for name in rows})


class Trace:
    """Watches one SNES.

    Parameters
    ----------
    snes : PETSc.SNES
    system : StageEquations
    linear_iterations : callable
        Those of the present solve so far.
    """

    def __init__(
        self, snes: PETSc.SNES, system: StageEquations, linear_iterations: Callable[[], int]
    ) -> None:
        self._snes, self._ksp, self._system = snes, snes.getKSP(), system
        self._linear_iterations = linear_iterations
        self._iterations: list[Iteration] = []
        self._linear = 0
        self._last: Array | None = None
        self._ksp.setConvergenceHistory(reset=True)

    def begin(self) -> None:
        """A new solve."""
        self._iterations, self._linear, self._last = [], 0, None

    def monitor(self, snes: PETSc.SNES, number: int, norm: float) -> None:
        """Note the present iterate; for ``SNES.setMonitor``."""
        here = snes.getSolution().getArray(readonly=True).copy()
        linear = self._linear_iterations()
        taken = None
        if number > 0 and self._last is not None:
            way = here - self._last
            (square,) = self._system.points.global_sum(float(np.vdot(way, way)))
            moved = np.sqrt(square)
            length = snes.getSolutionUpdate().norm()
            taken = float(moved / length) if length > 0.0 else 0.0
        reason = int(self._ksp.getConvergedReason()) if number > 0 else 0
        self._iterations.append(Iteration(norm, linear - self._linear, reason, taken))
        self._linear, self._last = linear, here

    def stuck(self, velocity: Array | None = None) -> FailedSolve:
        """Where the solve that just failed stands, or one that does not begin, at a velocity (n_owned, 3);
        collective, before the next step begins.
        """
        system, stage = self._system, self._system.stage
        n = system.points.n_owned
        if velocity is None:
            velocity = self._snes.getSolution().getArray(readonly=True).reshape(n, 3).copy()
        residual = np.empty((n, 3))
        system.residual(velocity, stage.sigma * (velocity - system.history), residual)
        position = (system.x[:n] if stage.x is None else stage.x) + stage.c * velocity
        goal = system.x[:n].copy()
        if system.held:
            if system.integrator.handles_at_stage:
                system.prescribed.targets(system.t0, system.t1, system.t0 + stage.offset, position)
            system.prescribed.targets(system.t0, system.t1, system.t1, goal)
        square = system.points.comm.allreduce(float(np.vdot(residual, residual)))
        return FailedSolve(
            tuple(self._iterations),
            float(np.sqrt(square)),
            system.t0 + stage.offset,
            velocity,
            position,
            residual,
            dict(system.forces_at_stage()),
            system.prescribed.mask[:n].copy(),
            goal,
            int(self._snes.getConvergedReason()),
            int(self._ksp.getConvergedReason()),
            np.array(self._ksp.getConvergenceHistory()),
        )
