"""Newton's linear system with what would touch on the way of its step: springs that push but do not pull.

The Jacobian knows only what touches at the iterate. Parts that meet on the way of its step then pass each
other far, and each iteration could go no farther than to the next of them. With springs (``terms.one_sided``)
between all that is near the linear model is convex and piecewise quadratic, and Newton's method with exact
line searches solves it: each of its iterations is a linear system with those springs that push. It costs no
residual, no Jacobian and no detection of collisions. (Active sets of sequential quadratic programming:
Nocedal & Wright, Numerical Optimization, 2nd ed., ch. 18.)
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.stepping.linear_system import LinearSystem
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.one_sided import Springs

SOLVES = 10
"""Linear systems with springs in a Newton iteration, at most."""

BISECTIONS = 20
"""In a line search."""

SHORT = 0.02
"""Length of a spring, over half the gap, up to which it does not matter whether it pushes."""


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
        self, v: Array, residual: PETSc.Vec, y: PETSc.Vec, assemble: Callable[[], None], tolerance: float
    ) -> bool:
        """Let y, the Newton step from velocities v (n_owned, 3), be that of the model; whether it is another;
        collective.

        ``assemble`` puts the linear system together again where it has other blocks; ``tolerance`` is that
        of its solutions, relative to the residual.
        """
        equations, self.linear_iterations = self._equations, 0
        self._springs = equations.springs(v, -y.getArray(readonly=True).reshape(v.shape))
        self._take(list(self._springs.values()))
        length = self._length + self._longer(y)
        pushes = length < 0.0
        if not self._differ(self._acts, pushes, length):
            equations.release({})
            return False
        if self._follow():
            assemble()
        self._linear.keep(v)
        first, z = y.copy(), y.duplicate()
        for _ in range(SOLVES):
            fall = self._solve(residual, y, z, pushes, tolerance * residual.norm())
            if fall is None:
                break
            change = self._longer(z)
            part = self._part(fall, length, change, pushes)
            y.axpy(part, z)
            length = length + part * change
            before, pushes = pushes, length < 0.0
            if part == 1.0 and not self._differ(before, pushes, length):
                break
        downwards = bool(residual.dot(y) > 0.0)
        if not downwards:
            first.copy(y)
        equations.release(dict(zip(self._springs, self._split(length), strict=True)) if downwards else {})
        first.destroy()
        z.destroy()
        return downwards

    def _take(self, springs: list[Springs]) -> None:
        """Lengths, stiffness and weights of the springs of all terms, one after the other."""
        none = np.empty(0)
        self._length = np.concatenate([none, *(each.length for each in springs)])
        self._stiffness = np.concatenate([none, *(each.stiffness for each in springs)])
        self._weight = self._stiffness * np.concatenate([none, *(each.counted for each in springs)])
        self._acts = np.concatenate([none, *(each.acts for each in springs)]) > 0.0
        skins = [np.full(len(each.at), term.skin) for term, each in self._springs.items()]
        self._short = SHORT * np.concatenate([none, *skins])

    def _split(self, values: Array) -> list[Array]:
        """Values of all springs by term."""
        ends = np.cumsum([len(each.at) for each in self._springs.values()])
        return np.split(values, ends[:-1])

    def _longer(self, y: PETSc.Vec) -> Array:
        """By how much springs become longer [m] in a step y."""
        equations = self._equations
        ahead = np.zeros((equations.points.n_local, 3))
        ahead[: equations.points.n_owned] = -equations.stage.reach * y.getArray(readonly=True).reshape(-1, 3)
        equations.points.update_ghosts(ahead)
        return np.concatenate([np.empty(0), *(each.longer(ahead) for each in self._springs.values())])

    def _differ(self, before: Mask, after: Mask, length: Array) -> bool:
        """Whether other springs push, and not only by a hair; collective."""
        other = (before != after) & (np.abs(length) > self._short)
        return bool(self._equations.points.summed(float(np.count_nonzero(other)))[0] > 0.0)

    def _solve(
        self, residual: PETSc.Vec, y: PETSc.Vec, z: PETSc.Vec, pushes: Mask, left: float
    ) -> float | None:
        """Let z lead from y to the solution with the springs that push, to a residual of ``left`` [N]; twice
        how far the energy of that system falls on it [W]; None where the solve failed.
        """
        ksp, linear, equations = self._ksp, self._linear, self._equations
        change = self._stiffness * (pushes.astype(np.float64) - self._acts)
        each = dict(zip(self._springs, self._split(change), strict=True))

        def add(rows: Array) -> None:
            equations.add_springs(self._springs, each, rows)

        linear.with_more(add)
        b, at_y = residual.copy(), residual.duplicate()
        b.setArray(b.getArray(readonly=True) + self._forces(change * self._length).ravel())
        ksp.setOperators(linear.operator.mat, linear.preconditioner.mat)
        kept = ksp.getTolerances()
        y.copy(z)
        ksp.setInitialGuessNonzero(True)
        ksp.setTolerances(rtol=1e-14, atol=left)
        ksp.solve(b, z)
        ksp.setInitialGuessNonzero(False)
        ksp.setTolerances(*kept)
        self.linear_iterations += ksp.getIterationNumber()
        linear.operator.mat.mult(y, at_y)
        at_y.aypx(-1.0, b)
        z.axpy(-1.0, y)
        fall = float(at_y.dot(z))
        b.destroy()
        at_y.destroy()
        return fall if ksp.getConvergedReason() > 0 and fall > 0.0 else None

    def _forces(self, size: Array) -> Array:
        """Gradient (n_owned, 3) [N] of springs that pull by ``size`` [N], 0 where unknowns are prescribed."""
        points = self._equations.points
        out = np.zeros((points.n_local, 3))
        for each, force in zip(self._springs.values(), self._split(size), strict=True):
            each.add_forces(force, out)
        return np.where(self._equations.prescribed.free, out[: points.n_owned], 0.0)

    def _part(self, fall: float, length: Array, change: Array, pushes: Mask) -> float:
        """Which part of the way to the solution with springs that push (m,) leads lowest; collective.

        ``length`` and ``change`` (m,) [m] are those of springs at its beginning and on it.
        """
        equations = self._equations
        weight = self._weight * change / equations.stage.reach

        def slope(part: float) -> float:
            there = length + part * change
            more = float(np.vdot(weight, np.minimum(there, 0.0) - np.where(pushes, there, 0.0)))
            return float(equations.points.summed(more)[0]) - (1.0 - part) * fall

        if slope(1.0) <= 1e-6 * fall:
            return 1.0
        low, high = 0.0, 1.0
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if slope(middle) < 0.0 else (low, middle)
        return low
