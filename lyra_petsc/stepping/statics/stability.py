"""Stability of an equilibrium: the inertia of the exact Hessian on the free unknowns, and the unstable mode.

The Hessian is that of all energies, plus the symmetric part of the stiffness of loads that follow the shape.
Unknowns of edges need no special treatment: if their block is positive definite, the negative pivots are
those of the Schur complement on the vertices.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.linear.inertia import Inertia
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.term import Load, UpcomingStep, Viscous

MAX_VERTICES = 200_000
"""Number of vertices above which no factors are computed."""

FIRST_DISPLACEMENT, MAX_DISPLACEMENT = 1e-3, 0.25
"""Displacements along a mode: the first over the mean edge length, the largest over the mesh's size."""

HALVINGS, DOUBLINGS = 10, 40

GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
"""Inverse golden ratio, whose multiples modulo 1 are evenly distributed."""

GAUSS = np.sqrt(3.0) / 6.0
"""Distance of the two Gauss points from the middle of the unit interval; exact for cubics."""

MIN_BENDING = 0.5
"""A mode with less than this fraction on vertices with bending stiffness is a wrinkle."""


@dataclass(frozen=True)
class Stability:
    """Stability of an equilibrium by the pivots of its Hessian.

    Attributes
    ----------
    stable : bool or None
        Whether no pivot is negative; None: not known.
    negative, neutral : int or None
        Number of negative pivots, and of pivots too small to have a sign.
    reason : str
        Why the stability is not known.
    """

    stable: bool | None = None
    negative: int | None = None
    neutral: int | None = None
    reason: str = ""

    @property
    def content(self) -> dict[str, Any]:
        """Entries of summary.json."""
        return {
            "stable": self.stable,
            "negative_pivots": self.negative,
            "neutral_pivots": self.neutral,
        } | ({"stability_unknown": self.reason} if self.reason else {})


def add_exact_hessian(system: StageEquations, values: Array) -> None:
    """Add the exact Hessian [N/m] of all energies at the state to block rows (n_blocks, 3, 3).

    The symmetric part of the stiffness of loads that follow the shape is added, too. Prescribed unknowns are
    decoupled.
    """
    from lyra_petsc.stepping.statics.following_loads import FollowingLoads  # needed in equilibria only

    rows, active, prescribed = system.discretisation.rows, system.active, system.prescribed
    for term in active.elastic:
        rows.add_stiffness(term, system.x, active.frozen[term], 0.0, 1.0, values)

    def force_of(term: Load | Viscous, x: Array, out: Array) -> None:
        """Add the force [N] of a load, or of the wind on a sheet at rest, at positions x."""
        if isinstance(term, Load):
            term.add_force_on_vertices(x, system.t0, system.t1, out)
        else:
            against = np.zeros_like(out)
            step = UpcomingStep(system.t0, system.t1, system.t1, x, system.reference.at)
            term.add_gradient(np.zeros_like(x), term.freeze(step), against)
            out -= against

    following = [*active.following, *active.viscous]
    loads = FollowingLoads(following, system.x, force_of, system.applied.factor)
    loads.add_hessian(1.0, rows.pattern, values)
    if len(prescribed.constrained.changed):
        rows.constrain(values, prescribed.mask, prescribed.constrained)


class Examination:
    """Examination of the present equilibrium; a context that holds the factors of its Hessian; collective.

    Attributes
    ----------
    stability : Stability
    """

    def __init__(self, system: StageEquations, spacing: float, size: float) -> None:
        self._system, self._spacing, self._size = system, spacing, size
        self._inertia: Inertia | None = None
        self.stability = self._examine()

    def _examine(self) -> Stability:
        system = self._system
        points = system.points
        if not PETSc.Sys.hasExternalPackage("mumps"):
            return Stability(reason="this PETSc has no MUMPS, whose factors give the inertia")
        if points.n_vertices_global > MAX_VERTICES:
            return Stability(
                reason=f"{points.n_vertices_global} vertices are more than the {MAX_VERTICES} "
                "that factors are made for"
            )
        system.update_pattern()
        values = system.discretisation.rows.zeros()
        add_exact_hessian(system, values)
        self._inertia = Inertia(points, system.discretisation.rows.pattern, values)
        pivots = self._inertia.pivots()
        if pivots is None:
            return Stability(reason="there is no memory for the factors")
        return Stability(pivots.negative == 0, pivots.negative, pivots.neutral)

    def solve(self, force: Array) -> Array | None:
        """Displacement (n_owned, 3) [m] for a force (n_owned, 3) [N] by the exact Hessian; collective.

        None if there are no factors. Not to be called after `lowest_mode`.
        """
        return None if self.stability.stable is None or self._inertia is None else self._inertia.solve(force)

    def lowest_mode(self) -> Array | None:
        """The unstable mode (n_owned, 3) of length one with the lowest eigenvalue, or None; collective."""
        assert self._inertia is not None
        points = self._system.points
        # a start vector evenly distributed in (-1/2, 1/2), the same on any number of ranks
        start = np.zeros((points.n_owned, 3))
        number = 3 * points.mesh_vertices[:, None] + np.arange(3)
        start[: points.n_vertices] = (number + 1) * GOLDEN % 1.0 - 0.5
        found = self._inertia.lowest_mode(np.where(self._system.prescribed.free, start, 0.0))
        return None if found is None or not found[0] < 0.0 else found[1]

    def is_wrinkle(self, mode: Array) -> bool:
        """Whether a mode is mostly on vertices without bending stiffness."""
        system = self._system
        stiff = np.zeros(system.points.n_local, dtype=bool)
        for term in system.active.elastic:
            if term.registration.bends:
                stiff[term.stencil] = True
        n = system.points.n_vertices
        square = (mode[:n] ** 2).sum(axis=1)
        on_stiff, total = system.points.global_sum(float(square[stiff[:n]].sum()), float(square.sum()))
        return bool(on_stiff < MIN_BENDING * total)

    def descent(self, mode: Array) -> Array | None:
        """Displacement (n_owned, 3) [m] along a mode to about the lowest potential; None if none is lower."""
        points = self._system.points
        largest = points.comm.allreduce(float(np.abs(mode).max(initial=0.0)), MPI.MAX)
        first, maximum = FIRST_DISPLACEMENT * self._spacing / largest, MAX_DISPLACEMENT * self._size / largest
        here = self._potential(0.0 * mode)
        best, lowest = 0.0, here
        for sign in (1.0, -1.0):
            length = sign * first
            for _ in range(HALVINGS):
                if (value := self._potential(length * mode)) < here:
                    break
                length *= 0.5
            else:
                continue
            for _ in range(DOUBLINGS):
                farther = self._potential(2.0 * length * mode)
                if not farther < value or abs(2.0 * length) > maximum:
                    break
                length, value = 2.0 * length, farther
            if value < lowest:
                best, lowest = length, value
        if best == 0.0:
            return None
        displacement, system = best * mode, self._system
        if system.collisions.limits_steps:
            displacement *= system.collisions.largest_step(np.zeros_like(mode), displacement / system.stage.c)
        return displacement

    def _potential(self, displacement: Array) -> float:
        """Energies minus the work of the loads [J] after a displacement (n_owned, 3) [m] from the state."""
        system = self._system
        x = system.x.copy()
        x[: len(displacement)] += displacement
        system.points.update_ghosts(x)
        stored = sum(
            float(term.energies(x, system.active.frozen[term]).sum()) for term in system.active.elastic
        )
        force = system.applied.force.copy()
        for load in system.active.following:
            force += system.applied.factor * self._mean_change(load, x, len(displacement))
        return float(system.points.global_sum(stored - float(np.vdot(force, displacement)))[0])

    def _mean_change(self, load: Load, x: Array, n: int) -> Array:
        """Mean change (n, 3) [N] of a load over the displacement to x (n_local, 3); exact for a pressure."""
        system = self._system
        total = np.zeros_like(x)
        for part in (0.5 - GAUSS, 0.5 + GAUSS):
            load.add_force((1.0 - part) * system.x + part * x, system.t0, system.t1, total)
        here = np.zeros_like(x)
        load.add_force(system.x, system.t0, system.t1, here)
        return (0.5 * total - here)[:n]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        """Free the factors; collective."""
        if self._inertia is not None:
            self._inertia.destroy()
            self._inertia = None
