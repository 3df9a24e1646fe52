"""Newton's linear system with the barrier's own law on distances that are linear in its step.

The Jacobian knows only what touches at the iterate, and there the slope of the barrier's force, which changes
tenfold within a gap. Parts that meet on the way of its step then pass each other far, and what touches goes
too near or leaves. Here all that is near has the law of the barrier (``terms.one_sided``) in an otherwise
linear model, which is solved as by primal-dual methods of interior points: slopes of the law are those of
chords, from the distance that there is to the one where the force is that of the last linear system. Steps
are full ones: with line searches it took more of them. It costs no residual, no Jacobian and no detection of
collisions. (Nocedal & Wright, Numerical Optimization, 2nd ed., ch. 19.)
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.linear_system import LinearSystem
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.one_sided import Springs

SOLVES = 20
"""Linear systems with springs in a Newton iteration, at most."""

MATCH = 0.1
"""Part of the residual by which forces of springs may differ from those in the linear system."""


class ContactModel:
    """The linear model of one SNES.

    Parameters
    ----------
    ksp : PETSc.KSP
    equations : StageEquations
    linear : LinearSystem
    follow : callable
        Lets the matrices be those of the present stencils; whether they are others; collective.

    Attributes
    ----------
    linear_iterations : int
        Of the last call of ``improve``.
    """

    def __init__(
        self, ksp: PETSc.KSP, equations: StageEquations, linear: LinearSystem, follow: Callable[[], bool]
    ) -> None:
        self._ksp, self._equations, self._linear, self._follow = ksp, equations, linear, follow
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
        """Let y, the Newton step from velocities v (n_owned, 3), be that of the model; whether it is another;
        collective.

        ``assemble`` puts the linear system together again where it has other blocks, ``ease`` so that it is
        easier to solve after that failed, if that can be; ``tolerance`` is that of its solutions, relative to
        the residual.
        """
        equations, linear, self.linear_iterations = self._equations, self._linear, 0
        self._springs = equations.contact_springs(v, -y.getArray(readonly=True).reshape(v.shape))
        self._take(list(self._springs.values()))
        change, size = self._longer(y), residual.norm()
        length = self._length + change
        force, expected = self._law(length)[0], self._force - self._stiffness * change
        if self._apart(force, expected) <= MATCH * size:
            equations.release_contact_springs({})
            return False
        if self._follow():
            assemble()
        linear.save_rows(v)
        first, z, left = y.copy(), y.duplicate(), residual.copy()
        self._go(left, y, force - expected)
        for _ in range(SOLVES):
            slopes = self._chords(length, force, expected)
            while not (solved := self._solve(left, z, slopes, tolerance * size)) and ease():
                linear.save_rows(v)
                residual.copy(left)
                self._go(left, y, force - self._force + self._stiffness * (length - self._length))
            if not solved:
                break
            y.axpy(1.0, z)
            change = self._longer(z)
            length, expected = length + change, force - slopes * change
            force = self._law(length)[0]
            self._go(left, z, force - expected)
            if self._apart(force, expected) <= MATCH * size:
                break
        downwards = bool(residual.dot(y) > 0.0)
        if not downwards:
            first.copy(y)
        equations.release_contact_springs(
            dict(zip(self._springs, self._split(length), strict=True)) if downwards else {}
        )
        for each in (first, z, left):
            each.destroy()
        return downwards

    def _take(self, springs: list[Springs]) -> None:
        """Lengths, weights, and forces and stiffness in the linear system, of all springs."""
        none = np.empty(0)
        self._length = np.concatenate([none, *(each.length for each in springs)])
        self._counted = np.concatenate([none, *(each.counted for each in springs)])
        acts = np.concatenate([none, *(each.acts for each in springs)])
        self._force, self._stiffness = (acts * part for part in self._law(self._length))

    def _split(self, values: Array) -> list[Array]:
        """Values of all springs by term."""
        ends = np.cumsum([len(each.pair) for each in self._springs.values()])
        return np.split(values, ends[:-1])

    def _law(self, length: Array) -> tuple[Array, Array]:
        """Forces [N] and stiffness [N/m] of all springs at these lengths [m]."""
        none = (np.empty(0), np.empty(0))
        parts = zip(self._springs.values(), self._split(length), strict=True)
        found = [none, *(each.law(own) for each, own in parts)]
        return np.concatenate([force for force, _ in found]), np.concatenate([slope for _, slope in found])

    def _chords(self, length: Array, force: Array, expected: Array) -> Array:
        """Slopes [N/m] of the law from these lengths [m] to where forces [N] are those expected."""
        expected = np.maximum(expected, 0.0)
        parts = zip(self._springs.values(), *map(self._split, (length, force, expected)), strict=True)
        return np.concatenate([np.empty(0), *(each.secant_stiffness(*own) for each, *own in parts)])

    def _apart(self, force: Array, expected: Array) -> float:
        """How far forces [N] of springs are from those expected, which do not pull; collective."""
        off = force - np.maximum(expected, 0.0)
        return float(np.sqrt(self._equations.points.global_sum(float(np.vdot(self._counted * off, off)))[0]))

    def _go(self, left: PETSc.Vec, z: PETSc.Vec, more: Array) -> None:
        """Let what is ``left`` [N] of the model be that after a step z, to which the present matrix belongs,
        where springs push by ``more`` (m,) [N] than it expects.
        """
        there = left.duplicate()
        self._linear.operator.mat.mult(z, there)
        left.axpy(-1.0, there)
        left.setArray(left.getArray(readonly=True) - self._forces(more).ravel())
        there.destroy()

    def _longer(self, y: PETSc.Vec) -> Array:
        """By how much springs become longer [m] in a step y."""
        equations = self._equations
        ahead = np.zeros((equations.points.n_local, 3))
        ahead[: equations.points.n_owned] = -equations.stage.c * y.getArray(readonly=True).reshape(-1, 3)
        equations.points.update_ghosts(ahead)
        return np.concatenate([np.empty(0), *(each.elongations(ahead) for each in self._springs.values())])

    def _solve(self, left: PETSc.Vec, z: PETSc.Vec, slopes: Array, enough: float) -> bool:
        """Let z lead from where this is ``left`` [N] to the solution with springs of these slopes [N/m], to a
        residual ``enough`` [N]; whether it could be solved for.
        """
        ksp, linear, equations = self._ksp, self._linear, self._equations
        each = dict(zip(self._springs, self._split(slopes - self._stiffness), strict=True))

        def add(rows: Array) -> None:
            equations.add_contact_springs(self._springs, each, rows)

        linear.assemble_with(add)
        ksp.setOperators(linear.operator.mat, linear.preconditioner.mat)
        kept = ksp.getTolerances()
        ksp.setTolerances(rtol=1e-14, atol=enough)
        ksp.solve(left, z)
        ksp.setTolerances(*kept)
        self.linear_iterations += ksp.getIterationNumber()
        return ksp.getConvergedReason() > 0 and bool(left.dot(z) > 0.0)

    def _forces(self, size: Array) -> Array:
        """Gradient (n_owned, 3) [N] of springs that pull by ``size`` [N], 0 where unknowns are prescribed."""
        points = self._equations.points
        out = np.zeros((points.n_local, 3))
        for each, force in zip(self._springs.values(), self._split(size), strict=True):
            each.add_forces(force, out)
        return np.where(self._equations.prescribed.free, out[: points.n_owned], 0.0)
