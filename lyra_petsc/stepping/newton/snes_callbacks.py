"""The callbacks of PETSc's SNES: Jacobian, corrections of the Newton step, objective, convergence test."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.linear import failed_factors
from lyra_petsc.linear.petsc_options import is_set
from lyra_petsc.linear.pivots import negative_pivots
from lyra_petsc.phases import JACOBIAN, logged
from lyra_petsc.stepping import motion_limits as limits
from lyra_petsc.stepping.directors import turn_with_triangles
from lyra_petsc.stepping.newton.convergence import Convergence
from lyra_petsc.stepping.newton.convexity import Convexity
from lyra_petsc.stepping.newton.globalisation import Globalisation, descends
from lyra_petsc.stepping.newton.inexact import Forcing
from lyra_petsc.stepping.newton.iterates import Iterates
from lyra_petsc.stepping.newton.linear_system import LinearSystem
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.time_step import Evaluation

if TYPE_CHECKING:
    from lyra_petsc.stepping.newton.shell_steps import ShellSteps


SMALL_GAP = 0.005
"""Half the gap over the mean edge length below which `ContactModel` is used.

With larger gaps it saved a tenth of the iterations and took twice the time."""


class NewtonCallbacks:
    """Callbacks of one SNES.

    Parameters
    ----------
    snes : PETSc.SNES
    equations : StageEquations
    linear : LinearSystem
    convexity : Convexity
    convergence : Convergence
    points : Iterates
    iterates : bool
        Whether there is more than one iteration (not so under ``semi-implicit``).
    follow : callable
        Updates the matrices to the present stencils, and returns whether they changed; collective.

    Attributes
    ----------
    convergence : Convergence
    globalisation : Globalisation
    extra_iterations, contact_iterations : int
        Linear iterations of repeated solves and corrections, and those of the contact model.
    step_fraction : float
        Fraction of the last Newton step that terms allowed.
    """

    def __init__(
        self,
        snes: PETSc.SNES,
        equations: StageEquations,
        linear: LinearSystem,
        convexity: Convexity,
        convergence: Convergence,
        points: Iterates,
        *,
        iterates: bool,
        follow: Callable[[], bool],
    ) -> None:
        self._snes, self._ksp, self._equations = snes, snes.getKSP(), equations
        self._linear, self._convexity, self._points, self._iterates = linear, convexity, points, iterates
        self.convergence, self.globalisation = (
            convergence,
            Globalisation(snes, points, convergence),
        )
        self._shape = (equations.points.n_owned, 3)
        self._follow, contact = follow, equations.contact
        self._models_contact = (
            iterates and contact is not None and contact.skin < SMALL_GAP * convergence.spacing
        )
        self._last_iterate: PETSc.Vec | None = None
        self._last_c = 0.0
        self._convex_at_start = False
        self._shell: ShellSteps | None = None
        if not equations.integrator.dynamic and linear.factors and equations.active.with_edges:
            from lyra_petsc.stepping.newton.shell_steps import ShellSteps  # needed in equilibria only

            self._shell = ShellSteps(snes, equations, convergence)
        fixed = is_set("ksp_rtol") or not equations.integrator.dynamic
        self.forcing = Forcing(
            self._ksp, fixed=fixed, cycles=linear.cycles, contact=equations.contact is not None
        )

    def begin_solve(self) -> None:
        """Prepare for a new nonlinear solve; collective."""
        self.extra_iterations = self.contact_iterations = 0
        self._step_length, self.step_fraction = 0.0, 1.0
        # the Hessian at the start of a step mostly resembles that at the start of the last step
        self._convex = self._convex_at_start
        # sheets that approach each other by an edge buckle into one of many shapes, and the first Newton
        # steps decide into which
        collides = self._iterates and limits.may_collide(self._equations, self.convergence.spacing)
        self._points.forget()
        self._linear.begin_solve()
        self._linear.shift.decrease()
        self.convergence.begin_solve()
        self.globalisation.begin_solve()
        near = self._equations.near
        self.forcing.begin_solve(near=near, collides=collides, buckles=not self._convex_at_start)

    @property
    def _full_steps(self) -> ShellSteps | None:
        """Changes full steps in equilibria of shells, while no parts are near."""
        return None if self._equations.near else self._shell

    @logged(JACOBIAN)
    def assemble(self, u: PETSc.Vec) -> None:
        """Assemble the Jacobian and the preconditioning matrix at velocities u; collective."""
        at = self._points.at(u)
        if self._iterates:
            self._equations.predicted_stress.set_iterate(at.x)
            self.forcing.before_solve(self.convergence)
        # where Newton converges the geometry hardly changes, and the last preconditioner still serves
        exact = self._full_steps is not None and self.convergence.halved
        convexity = self._convexity.after(self._taken(u), exact=exact)
        keep = self.convergence.fell_tenfold
        by_prescribed = self._linear.assemble(at, convexity, keep=keep, convex=self._convex)
        if by_prescribed is not None:
            force = self._snes.getFunction()[0].getArray().reshape(self._shape)
            force += by_prescribed
        self._last_c = self._equations.step.stage.c

    def _array(self, u: PETSc.Vec) -> Array:
        values: Array = u.getArray(readonly=True).reshape(self._shape)
        return values

    def _taken(self, u: PETSc.Vec) -> float:
        """Fraction of the last Newton step that the line search took; 1 before the first."""
        if self._last_iterate is None or self._step_length == 0.0:
            return 1.0
        self._last_iterate.axpy(-1.0, u)
        taken = self._last_iterate.norm() / self._step_length
        self._last_iterate.destroy()
        self._last_iterate = None
        return float(taken)

    def correct_direction(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Correct the Newton step y (x − y is the next iterate) before the line search.

        The linear solve is repeated with more regularisation while it meets negative curvature. The step then
        follows contact, arcs and directors and is shortened to what terms allow. Returns whether y changed;
        for ``SNESLineSearch.setPreCheck``.
        """
        if self.globalisation.return_to_best(x, y):
            self._equations.predicted_stress.forget()
            return True
        changed = False
        residual = self._snes.getFunction()[0]
        failed = self._lacks_descent(residual, y)
        self._convex = not failed
        if failed:
            self.forcing.meet_negative_curvature()
        if self._snes.getIterationNumber() == 0:
            self._convex_at_start = self._convex
        while failed:
            if not self._ease_linear_solve(x):
                y.zeroEntries()
                return True
            self._ksp.setOperators(self._linear.operator.mat, self._linear.preconditioner.mat)
            self._ksp.solve(residual, y)
            self.extra_iterations += self._ksp.getIterationNumber()
            changed = True
            failed = self._lacks_descent(residual, y)
        if self._models_contact and not failed:
            changed |= self._apply_contact_model(x, residual, y)
        v, full = self._array(x), self.globalisation.takes_full_steps
        shell = self._full_steps if full else None
        curved = shell is not None and shell.curve(v, residual, y)
        if curved:
            self.step_fraction = 1.0
        elif self._equations.active.with_edges and full:
            changed |= self._turn_directors(x, residual, y)
        if limits.limits_steps(self._equations) and not curved:
            changed |= self._limit_step(x, residual, y)
        changed |= curved
        if shell is not None:
            exact = self._linear.uses_operator and self._convexity.value == 0.0
            before = shell.iterations
            changed |= shell.correct(v, y, exact=exact)
            self.extra_iterations += shell.iterations - before
        if self._last_iterate is not None:
            self._last_iterate.destroy()
        self._last_iterate, self._step_length = x.copy(), y.norm()
        self.globalisation.set_slope(residual.dot(y))
        return changed

    def _ease_linear_solve(self, x: PETSc.Vec) -> bool:
        """Improve the preconditioner or regularise the matrix at the iterate x after the linear solve failed.

        Returns whether another solve may succeed; collective.
        """
        at = self._points.at(x)
        if failed_factors.replace_failed(self._ksp) or self._linear.improve_preconditioner(at):
            return True
        if not self._convexity.increase():
            return False
        self._linear.reassemble_operator(at, self._convexity.value)
        return True

    def _apply_contact_model(self, x: PETSc.Vec, residual: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Replace a step y by that of `ContactModel`, which sees contacts along it; whether it changed."""
        from lyra_petsc.stepping.newton.repeated_solves import RepeatedSolves

        def at() -> Evaluation:
            return self._points.at(x)

        def renew() -> None:
            if self._follow():
                self._linear.assemble(at(), self._convexity.value, keep=False, convex=self._convex)

        def ease() -> bool:
            self._linear.reassemble_operator(at(), self._convexity.value)
            return self._ease_linear_solve(x)

        solves = RepeatedSolves(self._ksp, self._linear, at, renew, ease)
        model = limits.contact_model(self._equations, self._array(x))
        changed = model.improve(residual, y, solves, self.forcing.effective_tolerance)
        self.contact_iterations += solves.iterations
        return changed

    def destroy(self) -> None:
        """Free the PETSc objects of its own; collective."""
        if self._shell is not None:
            self._shell.destroy()

    def curve_guess(self, v: Array, start: Array, guess: Array) -> None:
        """See `ShellSteps.curve_guess`; collective."""
        if self._shell is not None:
            self._shell.curve_guess(v, start, guess)

    def tangent(self, force: Array) -> tuple[Array | None, int]:
        """Linear response (n_owned, 3) [m] to a small force (n_owned, 3) [N] at the end of the last solve, by
        its factors, or None without; and the number of linear iterations; collective.
        """
        shell = self._full_steps
        return (None, 0) if shell is None or self._last_c == 0.0 else shell.tangent(force, self._last_c)

    def _turn_directors(self, x: PETSc.Vec, residual: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Turn directors with their triangles in a step y that is taken in full; whether y changed."""
        increment = -self._array(y)
        if not turn_with_triangles(self._equations, self._array(x), increment):
            return False
        if not descends(residual, increment, self._equations.points):
            return False
        y.setArray(-increment.ravel())
        return True

    def _limit_step(self, x: PETSc.Vec, residual: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Shorten a step y to what terms allow, or separate the pairs that it brings too near.

        Returns whether y changed.
        """
        equations, v = self._equations, self._array(x)
        shortened = self._limit_displacement(y)
        fraction = limits.largest_step(equations, v, -self._array(y))
        slow = self._snes.getIterationNumber() > 0 and not self.convergence.fell_tenfold
        correct = fraction < 1.0 or slow
        separated = limits.separated(equations, v, -self._array(y)) if correct else None
        if separated is not None and descends(residual, separated, equations.points):
            farther = limits.largest_step(equations, v, separated)
            if farther > 0.0 and farther >= fraction:
                y.setArray(-separated.ravel())
                fraction, shortened = farther, True
        self.step_fraction = fraction
        y.scale(fraction)
        return shortened or fraction < 1.0

    def _limit_displacement(self, y: PETSc.Vec) -> bool:
        """Shorten a step y to an edge length in equilibria in contact; whether y changed.

        Full steps of indefinite Hessians lead sheets that slide or fall far off, and Newton's method takes
        many iterations to return.
        """
        equations = self._equations
        if equations.integrator.dynamic or not equations.near:
            return False
        vertices = self._array(y)[: equations.points.n_vertices]
        (largest,) = equations.points.global_max(float(np.abs(vertices).max(initial=0.0)))
        allowed = self.convergence.spacing / equations.step.stage.c
        if largest <= allowed:
            return False
        y.scale(allowed / largest)
        return True

    def _lacks_descent(self, residual: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Whether the linear solve failed or gave no direction of descent."""
        if self._ksp.getConvergedReason() < 0 or not residual.dot(y) > 0.0:
            return True
        return self._linear.uses_operator and negative_pivots(self._ksp.getPC()) > 0

    def converged(self, snes: PETSc.SNES, iteration: int, norms: tuple[float, float, float]) -> int | None:
        """For ``SNES.setConvergenceTest``."""
        self._points.reach(snes.getSolution())
        spent = self.linear_iterations - self.contact_iterations
        return self.convergence.test(snes, iteration, norms[2], spent)

    def saved_state(self) -> dict[str, float]:
        """Entries of a checkpoint, so that a resumed run solves the next steps alike."""
        return {
            "convex": self._convex_at_start,
            **self.forcing.saved_state(),
            **self.convergence.saved_state(),
            **self._convexity.saved_state(),
            **self._linear.shift.saved_state(),
        }

    def restore(self, saved: Mapping[str, float]) -> None:
        """Restore a `saved_state`."""
        self._convex_at_start = bool(saved["convex"])
        self.forcing.restore(saved)
        self.convergence.restore(saved)
        self._convexity.restore(saved)
        self._linear.shift.restore(saved)

    @property
    def linear_iterations(self) -> int:
        """Linear iterations of the present solve so far."""
        return int(self._snes.getLinearSolveIterations()) + self.extra_iterations + self.contact_iterations
