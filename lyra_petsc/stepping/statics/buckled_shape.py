"""From an unstable equilibrium along its unstable mode to another one.

The displacement a = m · (x − x₀) along the mode m is prescribed and increased, and the shape at each a is an
equilibrium with a force μ m that holds it. At first μ < 0: the sheet would buckle further. Where μ changes
its sign there is an equilibrium. A straight step along the mode would stretch membranes, which may be 1e9
times as stiff as the mode, and their round-off would hide its small forces.

Source: displacement control, Batoz & Dhatt, Int. J. Numer. Meth. Engng 14 (1979) 1262-1267.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.stepping import motion_limits as limits
from lyra_petsc.stepping.directors import transport_frames
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.statics.stability import Examination

FIRST_STEP, SMALLEST_STEP, LARGEST_STEP, FARTHEST = 0.02, 1e-8, 0.1, 0.25
"""Largest displacement of a vertex in the first, the smallest and the largest step of a, and in all of them,
over the size of the mesh."""

LONGER, SHORTER = 1.5, 0.25
"""Factors of the step after one that succeeded, and of the first one after it failed."""

MAX_ITERATIONS, CONVERGED, SAME = 12, 1e-2, 1e-3
"""Largest number of Newton iterations, their last displacement over the step and change of μ over μ, and the
relative accuracy of a where μ is zero."""

GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
"""Inverse golden ratio, whose multiples modulo 1 are evenly distributed."""


class BuckledShape:
    """Displaces a sheet in an unstable equilibrium to a buckled shape nearby; collective.

    Parameters
    ----------
    equations : StageEquations
    examine : callable
        Returns an `Examination` of the present state.
    before, factor : float
        Load factors at the start and the end of the load step.
    size : float
        Diagonal of the mesh's bounding box [m].
    """

    def __init__(
        self,
        equations: StageEquations,
        examine: Callable[[], Examination],
        before: float,
        factor: float,
        size: float,
    ) -> None:
        self._equations, self._examine, self._size = equations, examine, size
        self._load_step = before, factor

    def find(self, mode: Array) -> bool:
        """Set the state to a shape near an equilibrium along the mode (n_owned, 3); whether it did."""
        equations, n = self._equations, self._equations.points.n_owned
        start = equations.x[:n].copy()
        mode = self._oriented(mode)
        unit = self._size / self._largest(mode)  # a per relative displacement
        step, reached, last, holding = FIRST_STEP, 0.0, start, 0.0
        while reached < FARTHEST and step > SMALLEST_STEP:
            force = self._solve(start, mode, (reached + step) * unit, step)
            if force is None or (force >= 0.0 and not reached):
                self._set_positions(last)
                if reached:
                    break
                step *= SHORTER
                continue
            before = reached, holding
            reached, last, holding = reached + step, equations.x[:n].copy(), force
            if force >= 0.0:
                self._find_root(start, mode, unit, before, (reached, holding))
                break
            step = min(LONGER * step, LARGEST_STEP)
        return reached > 0.0

    def _find_root(
        self, start: Array, mode: Array, unit: float, one: tuple[float, float], other: tuple[float, float]
    ) -> None:
        """Go to the equilibrium between two relative displacements with their forces μ, by secants."""
        equations, n = self._equations, self._equations.points.n_owned
        for _ in range(MAX_ITERATIONS):
            (before, force_before), (at, force) = one, other
            last, between = equations.x[:n].copy(), at - force * (at - before) / (force - force_before)
            holding = self._solve(start, mode, between * unit, abs(between - at))
            if holding is None:
                self._set_positions(last)
            if holding is None or abs(between - at) <= SAME * between:
                break
            one, other = other, (between, holding)

    def _solve(self, start: Array, mode: Array, goal: float, step: float) -> float | None:
        """Newton's method to an equilibrium with m · (x − start) = goal; returns the force μ [N], or None."""
        equations, n = self._equations, self._equations.points.n_owned
        before = last = np.inf
        for _ in range(MAX_ITERATIONS):
            equations.begin_step(*self._load_step)
            unbalanced = equations.out_of_balance()
            with self._examine() as examination:
                change = examination.solve(unbalanced) if self._is_finite(unbalanced) else None
                response = None if change is None else examination.solve(mode)
            if change is None or response is None:
                return None
            moved, by_force, by_mode = equations.points.global_sum(
                *(float(np.vdot(mode, u)) for u in (equations.x[:n] - start, change, response))
            )
            holding = (goal - moved - by_force) / by_mode
            change += holding * response
            largest = self._largest(change) / self._size
            if not largest < max(2.0 * before, 10.0 * step):
                return None
            if limits.limits_steps(equations):
                change *= limits.largest_step(
                    equations, np.zeros_like(change), change / equations.step.stage.c
                )
            self._set_positions(equations.x[:n] + change)
            if largest <= CONVERGED * step and abs(holding - last) <= CONVERGED * abs(holding):
                return holding
            before, last = largest, holding
        return None

    def _oriented(self, mode: Array) -> Array:
        """The mode on vertices alone, with a sign that does not depend on the number of ranks."""
        points = self._equations.points
        mode = mode.copy()
        mode[points.n_vertices :] = 0.0
        number = 3 * points.mesh_vertices[:, None] + np.arange(3) + 1
        weight = (number * GOLDEN) % 1.0 - 0.5
        sign = points.global_sum(float(np.vdot(weight, mode[: points.n_vertices])))[0]
        return mode if sign >= 0.0 else -mode

    def _set_positions(self, x: Array) -> None:
        self._equations.state.set(x, np.zeros_like(x))
        transport_frames(self._equations)

    def _is_finite(self, values: Array) -> bool:
        return not any(self._equations.points.global_max(float(not np.all(np.isfinite(values)))))

    def _largest(self, displacement: Array) -> float:
        """Largest displacement [m] of a vertex."""
        points = self._equations.points
        lengths = np.linalg.norm(displacement[: points.n_vertices], axis=1)
        return float(points.comm.allreduce(float(lengths.max(initial=0.0)), MPI.MAX))
