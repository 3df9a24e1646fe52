"""What SNES asks while it iterates: Jacobians, directions, energies, and whether to stop."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.linear import failed_factors
from lyra_petsc.linear.petsc_options import is_set
from lyra_petsc.linear.pivots import negative_pivots
from lyra_petsc.phases import JACOBIAN, logged
from lyra_petsc.stepping.blend import Blend
from lyra_petsc.stepping.convergence import Convergence
from lyra_petsc.stepping.globalisation import Globalisation
from lyra_petsc.stepping.inexact import COLLISION, Forcing
from lyra_petsc.stepping.integrators.static import Static
from lyra_petsc.stepping.linear_system import LinearSystem
from lyra_petsc.stepping.stage_equations import StageEquations

if TYPE_CHECKING:
    from lyra_petsc.stepping.arcs import Arcs
    from lyra_petsc.stepping.contact_model import ContactModel


SMALL = 0.005
"""Half the gap over the edges' mean length below which the linear model has what is on its way: with larger
gaps it saves a tenth of the iterations, and took twice the time."""

CORRECTED = 0.5
"""Fraction of the residual at the end of a step below which a correction of it is taken."""

MOST_CORRECTIONS = 8
"""Of one step."""

BACK, ON = -1.0, 0.5
"""Broyden's matrix takes the place of the factored one where the correction, along the last step, is between
these parts of it."""


def _largest(vector: PETSc.Vec) -> float:
    return float(vector.norm(PETSc.NormType.INFINITY))


def _by_secants(correction: PETSc.Vec, steps: list[PETSc.Vec]) -> None:
    """Let a correction, solved for with the matrix of the first of these steps, be that of Broyden's matrix
    after the last of them; collective.

    (Deuflhard, Newton Methods for Nonlinear Problems, 2004, section 2.1.4, algorithm QNERR.)
    """
    for step, following in itertools.pairwise(steps):
        correction.axpy(step.dot(correction) / step.dot(step), following)
    repeated = steps[-1].dot(correction) / steps[-1].dot(steps[-1])
    if BACK < repeated < ON:
        correction.scale(1.0 / (1.0 - repeated))


class Newton:
    """Callbacks of one SNES.

    Parameters
    ----------
    snes : PETSc.SNES
    equations : StageEquations
    linear : LinearSystem
    blend : Blend
    convergence : Convergence
    iterates : bool
        There is more than one iteration (not so under ``semi-implicit``).
    follow : callable
        Lets the matrices be those of the present stencils; whether they are others; collective.

    Attributes
    ----------
    convergence : Convergence
    globalisation : Globalisation
    more_linear, foreseen_linear : int
        Linear iterations of directions that were solved for again, and with what touches on their way.
    allowed : float
        Fraction of the last direction that terms allowed to go.
    """

    def __init__(
        self,
        snes: PETSc.SNES,
        equations: StageEquations,
        linear: LinearSystem,
        blend: Blend,
        convergence: Convergence,
        *,
        iterates: bool,
        follow: Callable[[], bool],
    ) -> None:
        self._snes, self._ksp, self._equations = snes, snes.getKSP(), equations
        self._linear, self._blend, self._iterates = linear, blend, iterates
        self.convergence, self.globalisation = convergence, Globalisation(snes, equations, convergence)
        self._shape = (equations.points.n_owned, 3)
        skin = min((term.skin for term in equations.active.limiting), default=np.inf)
        self._contact: ContactModel | None = None
        if iterates and skin < SMALL * convergence.spacing:
            from lyra_petsc.stepping.contact_model import ContactModel  # of use for nothing else

            self._contact = ContactModel(self._ksp, equations, linear, follow)
        self._from: PETSc.Vec | None = None
        self._reach = 0.0
        self._began_convex = False
        still = not (equations.integrator.dynamic or equations.discretisation.limits_motion)
        self._corrects = still and linear.factors and bool(equations.active.with_edges)
        self._arcs: Arcs | None = None
        if self._corrects:
            from lyra_petsc.stepping.arcs import Arcs, possible  # of use for nothing else

            self._arcs = Arcs(equations) if possible(equations.points.comm.size) else None
        fixed = is_set("ksp_rtol") or not equations.integrator.dynamic
        self.forcing = Forcing(
            self._ksp, fixed=fixed, cycles=linear.cycles, contact=equations.discretisation.limits_motion
        )

    def begin_step(self) -> None:
        """Forget the step before."""
        self.more_linear = self.foreseen_linear = 0
        self._length, self.allowed = 0.0, 1.0
        # a step begins as the one before did
        self._convex = self._began_convex
        collides = self._iterates and self._equations.may_collide(COLLISION * self.convergence.spacing)
        self._linear.begin()
        self._linear.shift.begin()
        self.convergence.begin()
        self.globalisation.begin()
        self.forcing.begin(near=self._equations.discretisation.has_near_elements, collides=collides)

    @logged(JACOBIAN)
    def assemble(self, u: PETSc.Vec) -> None:
        """Jacobian, and preconditioning matrix, at velocities u."""
        v = self._array(u)
        if self._iterates:
            self._equations.set_iterate(v)
            self.forcing.before_solve(self.convergence.norm)
        # where Newton converges the geometry hardly changes: what was set up an iteration ago still serves
        blend = self._blend.after(self._taken(u), exact=self._corrects and self.convergence.halved)
        self._linear.set(v, blend, keep=self.convergence.fell, convex=self._convex)
        self._reach = self._equations.stage.c

    def _array(self, u: PETSc.Vec) -> Array:
        values: Array = u.getArray(readonly=True).reshape(self._shape)
        return values

    def _taken(self, u: PETSc.Vec) -> float:
        """Fraction of the last Newton step that the line search took; 1 before the first."""
        if self._from is None or self._length == 0.0:
            return 1.0
        self._from.axpy(-1.0, u)
        taken = self._from.norm() / self._length
        self._from.destroy()
        self._from = None
        return float(taken)

    def direction(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Solve again with more regularisation while the linear solve meets negative curvature."""
        if self.globalisation.go_back(x, y):
            return True
        changed = False
        residual = self._snes.getFunction()[0]
        useless = self._useless(residual, y)
        self._convex = not useless
        if self._snes.getIterationNumber() == 0:
            self._began_convex = self._convex
        while useless:
            if not self._ease(self._array(x)):
                y.zeroEntries()
                return True
            self._ksp.setOperators(self._linear.operator.mat, self._linear.preconditioner.mat)
            self._ksp.solve(residual, y)
            self.more_linear += self._ksp.getIterationNumber()
            changed = True
            useless = self._useless(residual, y)
        if self._contact is not None and not useless:
            changed |= self._foresee(x, residual, y)
        bent = self._arcs is not None and self.globalisation.trusts and self._bend(x, residual, y)
        if self._equations.active.with_edges and self.globalisation.trusts and not bent:
            changed |= self._follow_triangles(x, residual, y)
        if self._equations.limits_steps and not bent:
            changed |= self._limit(x, residual, y)
        changed |= bent
        if self._corrects and self.globalisation.trusts:
            exact = self._linear.same and self._blend.value == 0.0
            changed |= self._correct(x, y, exact=exact)
        if self._from is not None:
            self._from.destroy()
        self._from, self._length = x.copy(), y.norm()
        self.globalisation.search_along(residual.dot(y))
        return changed

    def _ease(self, v: Array) -> bool:
        """Let the linear system at velocities v be easier to solve, after that failed; whether it can be;
        collective.
        """
        if failed_factors.replace_failed(self._ksp) or self._linear.better_preconditioner(v):
            return True
        if not self._blend.raise_():
            return False
        self._linear.set_operator_again(v, self._blend.value)
        return True

    def _foresee(self, x: PETSc.Vec, residual: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Let a step y be that of the linear model in which parts do not pass each other; whether it is
        another.
        """
        assert self._contact is not None
        v = self._array(x)

        def assemble() -> None:
            self._linear.set(v, self._blend.value, keep=False, convex=self._convex)

        def ease() -> bool:
            self._linear.set_operator_again(v, self._blend.value)
            return self._ease(v)

        changed = self._contact.improve(v, residual, y, assemble, ease, self.forcing.in_use)
        self.foreseen_linear += self._contact.linear_iterations
        return changed

    def _correct(self, x: PETSc.Vec, y: PETSc.Vec, *, exact: bool) -> bool:
        """Solve again and again with the same matrix at the end of a step y that is taken in full, as long as
        what is left there becomes much less; whether y is another by that. ``exact``: y is the whole Newton
        step, and more than one correction is tried.

        The first takes back the stretch of a step along tangents, for a residual and a solve with factors at
        hand (Traub, Iterative Methods for the Solution of Equations, 1964, chapter 8: of third order). What
        follows are steps of Broyden's method.
        """
        convergence, v = self.convergence, self._array(x)
        first = v - self._array(y)
        size, force = self._force(first)
        if size == 0.0:
            return False
        left, correction, steps = y.duplicate(), y.duplicate(), [y.copy()]
        corrected = False
        for _ in range(MOST_CORRECTIONS if exact else 1):
            left.setArray(force.ravel())
            self._ksp.solve(left, correction)
            self.more_linear += self._ksp.getIterationNumber()
            if exact:
                _by_secants(correction, steps)
            before = size
            size, force = self._force(v - self._array(y) - self._array(correction))
            if not size < CORRECTED * before:
                break
            corrected = True
            y.axpy(1.0, correction)
            if exact and convergence.corrected_by(_largest(correction), _largest(steps[-1]), size):
                break
            steps.append(correction.copy())
        if corrected:
            self._equations.linearise_to(first)
        for vector in (left, correction, *steps):
            vector.destroy()
        return corrected

    def _force(self, v: Array) -> tuple[float, Array]:
        """F (n_owned, 3) [N] at velocities v and its norm; collective."""
        equations, force = self._equations, np.empty(self._shape)
        equations.residual(v, equations.stage.sigma * (v - equations.history), force)
        (square,) = equations.points.global_sum(float(np.vdot(force, force)))
        return float(np.sqrt(square)), force

    def bend_guess(self, v: Array, guess: Array) -> None:
        """Let the first guess (n_owned, 3) [m/s], far from v, lie along arcs: the end of least energy of all
        ways that are expected; collective.
        """
        integrator = self._equations.integrator
        if self._arcs is None or not isinstance(integrator, Static):
            return
        least, ways = np.inf, [guess - v, *(way / integrator.pseudo_dt for way in integrator.alternatives)]
        for way in ways:
            there = v + self._arcs.bend(v, way, strains=False)[0]
            self._equations.prescribe(there)
            energy = self._equations.objective(there)[0] if len(ways) > 1 else 0.0
            if energy < least:
                least, guess[:] = energy, there

    def tangent(self, force: Array) -> tuple[Array | None, int]:
        """See `Stepper.tangent`."""
        if self._arcs is None or self._reach == 0.0:
            return None, 0
        b, x = self._snes.getSolution().duplicate(), self._snes.getSolution().duplicate()
        b.setArray(force.ravel())
        self._ksp.solve(b, x)
        way = self._reach * self._array(x)
        b.destroy()
        x.destroy()
        return (way if self._ksp.getConvergedReason() > 0 else None), int(self._ksp.getIterationNumber())

    def _bend(self, x: PETSc.Vec, residual: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Let a step y that is taken in full go along arcs, as far as they lead; whether it does."""
        assert self._arcs is not None
        v = self._array(x)
        if not self._arcs.matter(-self._array(y)):
            return False
        before = y.copy()
        bent, way = self._arcs.bend(v, -self._array(y))
        y.setArray(-bent.ravel())
        downwards = bool(residual.dot(y) > 0.0)
        if downwards:
            self._equations.linearise_to(v + way)
            self.allowed = 1.0
        else:
            before.copy(y)
        before.destroy()
        return downwards

    def destroy(self) -> None:
        """Free what it has of PETSc's; collective."""
        if self._arcs is not None:
            self._arcs.destroy()

    def _follow_triangles(self, x: PETSc.Vec, residual: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Let directors follow their triangles in a step y that is taken in full; whether any does."""
        way = -self._array(y)
        if not self._equations.turn_directors(self._array(x), way):
            return False
        before = y.copy()
        y.setArray(-way.ravel())
        downwards = bool(residual.dot(y) > 0.0)
        if not downwards:
            before.copy(y)
        before.destroy()
        return downwards

    def _limit(self, x: PETSc.Vec, residual: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Shorten a step y to what terms allow, or let it lead past what is near; whether it is another."""
        equations, v = self._equations, self._array(x)
        fraction = equations.largest_step(v, -self._array(y))
        slow = self._snes.getIterationNumber() > 0 and not self.convergence.fell
        past = equations.second_order_correction(v, -self._array(y)) if fraction < 1.0 or slow else None
        if past is not None:
            before = y.copy()
            y.setArray(-past.ravel())
            farther = equations.largest_step(v, past) if residual.dot(y) > 0.0 else 0.0
            if farther > 0.0 and farther >= fraction:
                fraction = farther
            else:
                before.copy(y)
                past = None
            before.destroy()
        self.allowed = fraction
        y.scale(fraction)
        return past is not None or fraction < 1.0

    def _useless(self, residual: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Whether the linear solve failed in a way that leaves no direction of descent."""
        if self._ksp.getConvergedReason() < 0 or not residual.dot(y) > 0.0:
            return True
        return self._linear.same and negative_pivots(self._ksp.getPC()) > 0

    def converged(self, snes: PETSc.SNES, iteration: int, norms: tuple[float, float, float]) -> int | None:
        """For ``SNES.setConvergenceTest``."""
        spent = self.linear_iterations - self.foreseen_linear
        return self.convergence.test(snes, iteration, norms[2], spent)

    def memory(self) -> dict[str, float]:
        """What a checkpoint must hold for the next steps to be solved as they would be."""
        return {
            "convex": self._began_convex,
            "tolerance": self.forcing.tolerance,
            "usual": self.convergence.usual,
            **self._blend.memory(),
            **self._linear.shift.memory(),
        }

    def restore(self, memory: Mapping[str, float]) -> None:
        """Go on with a memory; an older one has less."""
        self._began_convex = bool(memory.get("convex", self._began_convex))
        self.forcing.tolerance = float(memory.get("tolerance", self.forcing.tolerance))
        self.convergence.usual = float(memory.get("usual", self.convergence.usual))
        self._blend.restore(memory)
        self._linear.shift.restore(memory)

    @property
    def linear_iterations(self) -> int:
        """Linear iterations of the present solve so far."""
        return int(self._snes.getLinearSolveIterations()) + self.more_linear + self.foreseen_linear
