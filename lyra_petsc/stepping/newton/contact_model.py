"""Newton's linear system with the nonlinear law of the barrier on linearised distances.

The Jacobian contains only the pairs that touch at the iterate, with the tangent of the barrier's force, that
changes tenfold within a gap. Parts that meet along the Newton step would then pass each other, and touching
parts come too near or separate. In this model all near pairs have the barrier's law (``terms.one_sided``) on
distances that are linear in the step, and all else is linear. It is solved as in primal-dual interior-point
methods, with secant stiffnesses of the law: from the present distance to the one where the force is that
expected by the last linear system. Steps are full ones, because line searches took more of them. The model
needs no further residual, Jacobian or collision detection. (Nocedal & Wright, Numerical Optimization, 2nd
ed., ch. 19.)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.contact.one_sided import Springs
from lyra_petsc.stepping.newton.linear_system import LinearSystem
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.term import Elastic

MAX_SOLVES = 20
"""Largest number of linear systems with springs in a Newton iteration."""

MATCH = 0.1
"""Fraction of the residual by which spring forces may differ from those of the linear system."""


def springs_along(system: StageEquations, v: Array, increment: Array) -> dict[Elastic, Springs]:
    """Springs of the pairs that touch at v, or may touch along an increment (n_owned, 3) [m/s] from v.

    Collective. Their blocks are part of the matrix until they are released.
    """
    x, displacement, _ = system.collisions.known_displacement(v, increment, 1.0)
    moved = np.linalg.norm(displacement[: system.points.n_vertices], axis=1).max(initial=0.0)
    approach = 2.0 * system.points.global_max(float(moved))[0]
    found = {term: term.springs(x, approach, system.active.frozen[term]) for term in system.active.separating}
    return {term: springs for term, springs in found.items() if springs is not None}


class ContactModel:
    """The linear model of one SNES.

    Parameters
    ----------
    ksp : PETSc.KSP
    system : StageEquations
    linear : LinearSystem
    follow : callable
        Updates the matrices to the present stencils, and returns whether they changed; collective.

    Attributes
    ----------
    linear_iterations : int
        Linear iterations in the last call of ``improve``.
    """

    def __init__(
        self, ksp: PETSc.KSP, system: StageEquations, linear: LinearSystem, follow: Callable[[], bool]
    ) -> None:
        self._ksp, self._system, self._linear, self._follow = ksp, system, linear, follow
        self.linear_iterations = 0

    def improve(
        self,
        v: Array,
        residual: PETSc.Vec,
        y: PETSc.Vec,
        assemble: Callable[[], None],
        ease: Callable[[], bool],
        tolerance: float,
    ) -> bool:
        """Replace y, the Newton step from velocities v (n_owned, 3), by that of the model; collective.

        Returns whether y changed.

        Parameters
        ----------
        assemble : callable
            Assembles the linear system again after its pattern has changed.
        ease : callable
            Changes the linear system after a failed solve, and returns whether another may succeed.
        tolerance : float
            Tolerance of the linear solves, relative to the residual.
        """
        system, linear, self.linear_iterations = self._system, self._linear, 0
        self._springs = springs_along(system, v, -y.getArray(readonly=True).reshape(v.shape))
        self._set_springs(list(self._springs.values()))
        change, size = self._elongations(y), residual.norm()
        length = self._length + change
        force, expected = self._law(length)[0], self._force - self._stiffness * change
        if self._mismatch(force, expected) <= MATCH * size:
            self._release({})
            return False
        if self._follow():
            assemble()
        linear.save_rows(v)
        first, z, remaining = y.copy(), y.duplicate(), residual.copy()
        self._advance_residual(remaining, y, force - expected)
        for _ in range(MAX_SOLVES):
            slopes = self._secants(length, force, expected)
            while not (solved := self._solve(remaining, z, slopes, tolerance * size)) and ease():
                linear.save_rows(v)
                residual.copy(remaining)
                linear_force = self._force - self._stiffness * (length - self._length)
                self._advance_residual(remaining, y, force - linear_force)
            if not solved:
                break
            y.axpy(1.0, z)
            change = self._elongations(z)
            length, expected = length + change, force - slopes * change
            force = self._law(length)[0]
            self._advance_residual(remaining, z, force - expected)
            if self._mismatch(force, expected) <= MATCH * size:
                break
        descends = bool(residual.dot(y) > 0.0)
        if not descends:
            first.copy(y)
        lengths = zip(self._springs, self._split(length), strict=True)
        self._release(dict(lengths) if descends else {})
        for each in (first, z, remaining):
            each.destroy()
        return descends

    def _release(self, length: Mapping[Elastic, Array]) -> None:
        """End the use of the springs; ``length`` [m] is theirs after the increment taken.

        It is empty where another increment is taken.
        """
        for term in self._system.active.separating:
            term.release_springs(length.get(term))

    def _set_springs(self, springs: list[Springs]) -> None:
        """Set lengths and weights of all springs, and their forces and stiffness in the linear system."""
        none = np.empty(0)
        self._length = np.concatenate([none, *(each.length for each in springs)])
        self._counted = np.concatenate([none, *(each.counted for each in springs)])
        acts = np.concatenate([none, *(each.acts for each in springs)])
        self._force, self._stiffness = (acts * part for part in self._law(self._length))

    def _split(self, values: Array) -> list[Array]:
        """Split values of all springs into those of each term."""
        ends = np.cumsum([len(each.pair) for each in self._springs.values()])
        return np.split(values, ends[:-1])

    def _law(self, length: Array) -> tuple[Array, Array]:
        """Forces [N] and stiffness [N/m] of all springs at these lengths [m]."""
        none = (np.empty(0), np.empty(0))
        parts = zip(self._springs.values(), self._split(length), strict=True)
        found = [none, *(each.law(own) for each, own in parts)]
        return np.concatenate([force for force, _ in found]), np.concatenate([slope for _, slope in found])

    def _secants(self, length: Array, force: Array, expected: Array) -> Array:
        """Slopes [N/m] of the law from these lengths [m] to where forces [N] are those expected."""
        expected = np.maximum(expected, 0.0)
        parts = zip(self._springs.values(), *map(self._split, (length, force, expected)), strict=True)
        return np.concatenate([np.empty(0), *(each.secant_stiffness(*own) for each, *own in parts)])

    def _mismatch(self, force: Array, expected: Array) -> float:
        """Norm [N] of the difference of spring forces and expected ones, if repulsive; collective."""
        off = force - np.maximum(expected, 0.0)
        return float(np.sqrt(self._system.points.global_sum(float(np.vdot(self._counted * off, off)))[0]))

    def _advance_residual(self, remaining: PETSc.Vec, z: PETSc.Vec, excess: Array) -> None:
        """Update the model's residual ``remaining`` [N] by a step z with the present matrix.

        ``excess`` (m,) [N] are the spring forces minus those expected by the matrix.
        """
        product = remaining.duplicate()
        self._linear.operator.mat.mult(z, product)
        remaining.axpy(-1.0, product)
        remaining.setArray(remaining.getArray(readonly=True) - self._forces(excess).ravel())
        product.destroy()

    def _elongations(self, y: PETSc.Vec) -> Array:
        """Elongations [m] of all springs in a step y; collective."""
        system = self._system
        displacement = np.zeros((system.points.n_local, 3))
        increment = y.getArray(readonly=True).reshape(-1, 3)
        displacement[: len(increment)] = -system.stage.c * increment
        system.points.update_ghosts(displacement)
        parts = [each.elongations(displacement) for each in self._springs.values()]
        return np.concatenate([np.empty(0), *parts])

    def _solve(self, remaining: PETSc.Vec, z: PETSc.Vec, slopes: Array, tolerance: float) -> bool:
        """Solve for the step z to the solution with springs of these slopes [N/m]; whether it succeeded.

        ``remaining`` [N] is the residual before the step, ``tolerance`` [N] that after it.
        """
        ksp, linear, system = self._ksp, self._linear, self._system
        each = dict(zip(self._springs, self._split(slopes - self._stiffness), strict=True))

        def add(values: Array) -> None:
            rows, constrained = system.discretisation.rows, system.prescribed.constrained
            for term, springs in self._springs.items():
                springs.add_stiffness(system.stage.c * each[term], rows.pattern.offsets[term.name], values)
            if len(constrained.changed):
                rows.constrain(values, system.prescribed.mask, constrained)

        linear.assemble_with(add)
        ksp.setOperators(linear.operator.mat, linear.preconditioner.mat)
        kept = ksp.getTolerances()
        ksp.setTolerances(rtol=1e-14, atol=tolerance)
        ksp.solve(remaining, z)
        ksp.setTolerances(*kept)
        self.linear_iterations += ksp.getIterationNumber()
        return ksp.getConvergedReason() > 0 and bool(remaining.dot(z) > 0.0)

    def _forces(self, size: Array) -> Array:
        """Gradient (n_owned, 3) [N] of springs with tensions ``size`` [N], 0 at prescribed unknowns."""
        points = self._system.points
        out = np.zeros((points.n_local, 3))
        for each, force in zip(self._springs.values(), self._split(size), strict=True):
            each.add_forces(force, out)
        return np.where(self._system.prescribed.free, out[: points.n_owned], 0.0)
