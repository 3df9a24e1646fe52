"""Newton's linear system with the nonlinear law of the barrier on linearised distances.

The Jacobian contains only the pairs that touch at the iterate, with the tangent of the barrier's force, that
changes tenfold within a gap. Parts that meet along the Newton step would then pass each other, and touching
parts come too near or separate. In this model all near pairs have the barrier's law (`one_sided`) on
distances that are linear in the step, and all else is linear. It is solved as in primal-dual interior-point
methods, with secant stiffnesses of the law: from the present distance to the one where the force is that
expected by the last linear system. Steps are full ones, because line searches took more of them. The model
needs no further residual, Jacobian or collision detection. (Nocedal & Wright, Numerical Optimization, 2nd
ed., ch. 19.)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.contact.barrier import ContactBarrier
from lyra_petsc.contact.obstacle_points import ObstaclePositions
from lyra_petsc.contact.one_sided import Springs
from lyra_petsc.linear.discretisation import Discretisation

MAX_SOLVES = 20
"""Largest number of linear systems with springs in a Newton iteration."""

MATCH = 0.1
"""Fraction of the residual by which spring forces may differ from those of the linear system."""


class LinearSolves(Protocol):
    """Solves of a Newton iteration's linear system with further stiffness; all methods are collective."""

    def renew(self) -> None:
        """Assemble the system again if the pattern of the present pairs demands it, for `solve`."""

    def ease(self) -> bool:
        """Change the system after a failed solve, and return whether another may succeed."""

    def product(self, z: PETSc.Vec) -> Array:
        """The matrix times z, (n_owned, 3)."""

    def solve(self, add: Callable[[Array], None], right: PETSc.Vec, z: PETSc.Vec, tolerance: float) -> bool:
        """Solve for z after ``add`` has added to the block rows (n_blocks, 3, 3), to a residual of at most
        ``tolerance`` [N]; whether it succeeded with a direction of descent.
        """


class ContactModel:
    """The model at one Newton iterate; all methods are collective.

    Parameters
    ----------
    barrier : ContactBarrier
    discretisation : Discretisation
    known : callable
        `Collisions._known`.
    x : (n_owned, 3)
        Positions [m] of the iterate.
    c : float
        Displacement [m] over velocity [m/s].
    free : (n_owned, 3)
        Unknowns that are not prescribed.
    obstacles : ObstaclePositions
    """

    def __init__(
        self,
        barrier: ContactBarrier,
        discretisation: Discretisation,
        known: Callable[[Array, Array, float], tuple[Array, Array, float]],
        x: Array,
        c: float,
        free: Mask,
        obstacles: ObstaclePositions,
    ) -> None:
        self._barrier, self._discretisation, self._known = barrier, discretisation, known
        self._x, self._c, self._free, self._obstacles = x, c, free, obstacles

    def springs_along(self, increment: Array) -> Springs:
        """Springs of the pairs that touch, or may touch along an increment (n_owned, 3) [m/s].

        Their blocks are part of the matrix until they are released.
        """
        dx = self._c * increment
        x, displacement, _ = self._known(self._x, dx, 1.0)
        layout = self._discretisation.layout
        moved = np.linalg.norm(displacement[: layout.n_vertices], axis=1).max(initial=0.0)
        approach = 2.0 * layout.global_max(float(moved))[0]
        return self._barrier.springs(x, approach, self._obstacles)

    def improve(self, residual: PETSc.Vec, y: PETSc.Vec, solves: LinearSolves, tolerance: float) -> bool:
        """Replace y, the Newton step, by that of the model; returns whether y changed.

        ``tolerance`` is that of the linear solves, relative to the residual.
        """
        release = self._barrier.release_springs
        self._springs = springs = self.springs_along(-y.getArray(readonly=True).reshape(-1, 3))
        first_force, first_stiffness = (springs.acts * part for part in springs.law(springs.length))
        change, size = self._elongations(y), residual.norm()
        length = springs.length + change
        force, expected = springs.law(length)[0], first_force - first_stiffness * change
        if self._mismatch(force, expected) <= MATCH * size:
            release(None)
            return False
        solves.renew()
        first, z, remaining = y.copy(), y.duplicate(), residual.copy()
        self._advance(remaining, y, force - expected, solves)
        for _ in range(MAX_SOLVES):
            slopes = springs.secant_stiffness(length, force, np.maximum(expected, 0.0))
            add = self._adding(slopes - first_stiffness)
            while not (solved := solves.solve(add, remaining, z, tolerance * size)) and solves.ease():
                residual.copy(remaining)
                linear_force = first_force - first_stiffness * (length - springs.length)
                self._advance(remaining, y, force - linear_force, solves)
            if not solved:
                break
            y.axpy(1.0, z)
            change = self._elongations(z)
            length, expected = length + change, force - slopes * change
            force = springs.law(length)[0]
            self._advance(remaining, z, force - expected, solves)
            if self._mismatch(force, expected) <= MATCH * size:
                break
        descends = bool(residual.dot(y) > 0.0)
        if not descends:
            first.copy(y)
        release(length if descends else None)
        for vector in (first, z, remaining):
            vector.destroy()
        return descends

    def _mismatch(self, force: Array, expected: Array) -> float:
        """Norm [N] of the difference of spring forces and expected ones, if repulsive."""
        off = force - np.maximum(expected, 0.0)
        square = float(np.vdot(self._springs.counted * off, off))
        return float(np.sqrt(self._discretisation.layout.global_sum(square)[0]))

    def _advance(self, remaining: PETSc.Vec, z: PETSc.Vec, excess: Array, solves: LinearSolves) -> None:
        """Update the model's residual ``remaining`` [N] by a step z with the present matrix.

        ``excess`` (m,) [N] are the spring forces minus those expected by the matrix.
        """
        layout = self._discretisation.layout
        forces = np.zeros((layout.n_local, 3))
        self._springs.add_forces(excess, forces)
        forces = np.where(self._free, forces[: layout.n_owned], 0.0)
        remaining.setArray(remaining.getArray(readonly=True) - (solves.product(z) + forces).ravel())

    def _elongations(self, y: PETSc.Vec) -> Array:
        """Elongations [m] of all springs in a step y."""
        increment = y.getArray(readonly=True).reshape(-1, 3)
        return self._springs.elongations(self._discretisation.layout.extended(-self._c * increment))

    def _adding(self, stiffness: Array) -> Callable[[Array], None]:
        """A function that adds springs of a ``stiffness`` (m,) [N/m] to block rows."""

        def add(values: Array) -> None:
            offsets = self._discretisation.rows.pattern.offsets[self._barrier.name]
            self._springs.add_stiffness(self._c * stiffness, offsets, values)

        return add
