"""When Newton's method stops: by the scene's tolerances, ``-snes_*tol``, or at the floor of round-off."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from lyra_petsc.linear.petsc_options import is_set
from lyra_petsc.linear.reasons import NOT_A_NUMBER
from lyra_petsc.scene.schema import Solver
from lyra_petsc.stepping.roundoff import roundoff_of_contact
from lyra_petsc.stepping.stage_equations import StageEquations

Reason = PETSc.SNES.ConvergedReason

STALLED = 0.5
"""Fraction of the residual left by an iteration above which, at the round-off floor, it falls no more."""

FELL = 0.1
"""Fraction of the residual left by an iteration below which the preconditioner stays."""

HALVED = 0.5
"""Fraction of it below which factors of the exact Hessian are worth another try, at the price of a solve."""

FINER_IN_CONTACT = 0.1
"""Part of the tolerances above which one more iteration is taken where parts meet: an impact magnifies what a
step leaves, which depends on the number of ranks."""

SLOWEST = 0.5
"""Fraction of the increment before above which increments are not extrapolated."""

RECENT = 0.1
"""Weight of the last Newton iteration in the mean of linear iterations that judges the linear solver."""


class Convergence:
    """The convergence test of one SNES.

    Parameters
    ----------
    equations : StageEquations
    tolerances : Solver
        The scene's block.
    spacing : float
        Mean edge length [m], for the step tolerance.
    floor : float
        Norm [N] of the residual's round-off.
    break_even_iterations : float
        Linear iterations per Newton iteration above which another preconditioner is cheaper.

    Attributes
    ----------
    norm : float
        Last residual norm [N].
    fell : bool
        Whether the last iteration lessened it much.
    halved : bool
        Whether it at least halved it.
    at_roundoff : bool
        Whether the solve ended because only round-off was left.
    left : float
        Estimated remaining correction of any coordinate [m].
    too_slow : bool
        Whether the solve was given up since its linear iterations passed the limit.
    usual : float
        Mean of recent linear iterations per Newton iteration, which the limit is for.
    stopped_by : str
        The option that ended the solve while the scene's force tolerance was not met; or nothing.
    farthest : float
        Way [m] of a coordinate in an iteration beyond which the solve is given up.
    """

    def __init__(
        self,
        equations: StageEquations,
        tolerances: Solver,
        spacing: float,
        floor: float,
        *,
        break_even_iterations: float,
    ) -> None:
        self._equations, self._tolerances, self.spacing = equations, tolerances, spacing
        self._floor = self._least_floor = floor
        self._break_even_iterations = break_even_iterations
        self.usual, self.farthest = 0.0, np.inf
        self.begin()

    def begin(self) -> None:
        """A new solve."""
        self.norm, self.fell, self.at_roundoff, self._floor = 0.0, False, False, self._least_floor
        self.halved = True
        self.left, self.too_slow, self.stopped_by = np.inf, False, ""
        self._first_norm = self._increment = 0.0
        self._stalled = self._spent = 0
        self._balanced = self._ended = self._was_good = False
        self._expected = np.inf

    @property
    def judged(self) -> bool:
        """Whether the solve ended by this test, or in a motion where it is good enough.

        Where its line search fails, PETSc takes a short direction for convergence, whatever the residual. In
        statics small forces may lead far.
        """
        return self._ended or (self._equations.integrator.dynamic and self.balanced)

    @property
    def balanced(self) -> bool:
        """Whether the last residual is as small as the scene asks, or round-off."""
        return self.norm <= max(self._floor, self._force_tolerance())

    def test(self, snes: PETSc.SNES, iteration: int, residual: float, spent: int) -> int | None:
        """SNES's reason to stop after so many linear iterations ``spent``, or None."""
        reason = self._test(snes, iteration, residual, spent)
        self._ended = reason is not None
        return reason

    def _test(self, snes: PETSc.SNES, iteration: int, residual: float, spent: int) -> int | None:
        before, self.norm = self.norm, residual
        self.fell = residual < FELL * before
        self.halved = iteration == 0 or residual < HALVED * before
        if not np.isfinite(residual):
            return NOT_A_NUMBER
        if iteration > 0:
            increment = snes.getSolutionUpdate().norm(PETSc.NormType.INFINITY)
            moved = increment * self._equations.stage.c
            if moved > self.farthest:
                return int(Reason.DIVERGED_MAX_IT)
            self._moved_by(moved)
            self.usual += RECENT * (spent - self._spent - self.usual)
        slow = iteration > 0 and residual > STALLED * before
        if slow and self._equations.discretisation.has_near_elements:
            self._floor = max(self._least_floor, roundoff_of_contact(self._equations))
        self._stalled = self._stalled + 1 if slow and residual <= self._floor else 0
        if self._stalled > 1 or residual == 0.0:
            self.at_roundoff = residual > 0.0
            return int(Reason.CONVERGED_FNORM_ABS)
        self._spent = spent
        if self.usual > self._break_even_iterations:
            self.too_slow = True
            return int(Reason.DIVERGED_LINEAR_SOLVE)
        rtol, atol, stol = (
            value if is_set(f"snes_{name}") else 0.0
            for name, value in zip(("rtol", "atol", "stol"), snes.getTolerances()[:3], strict=True)
        )
        if residual > atol and iteration == 0:
            self._first_norm = residual
            return None
        balanced = residual <= self._force_tolerance()
        if residual <= atol:
            self.stopped_by = "" if balanced else "-snes_atol"
            return int(Reason.CONVERGED_FNORM_ABS if balanced else Reason.DIVERGED_INNER)
        if residual <= rtol * self._first_norm:
            self.stopped_by = "" if balanced else "-snes_rtol"
            return int(Reason.CONVERGED_FNORM_RELATIVE)
        was_balanced, self._balanced = self._balanced, balanced
        near = self._tolerances.step_tolerance * self.spacing
        if balanced and self.left <= near and not self._finer_in_contact(near):
            # which came last
            return int(Reason.CONVERGED_SNORM_RELATIVE if was_balanced else Reason.CONVERGED_FNORM_RELATIVE)
        if 0.0 < self.left <= stol * self.spacing:
            self.stopped_by = "" if balanced else "-snes_stol"
            return int(Reason.CONVERGED_SNORM_RELATIVE)
        return None

    def _finer_in_contact(self, near: float) -> bool:
        """Whether a solve that is good enough, with corrections below ``near`` [m], takes another iteration
        as parts meet; collective.
        """
        equations, was_good = self._equations, self._was_good
        self._was_good = True
        if was_good or not (equations.discretisation.limits_motion and equations.integrator.dynamic):
            return False
        enough, part = self._force_tolerance(), FINER_IN_CONTACT
        return (self.norm > part * enough or self.left > part * near) and equations.may_impact

    def _force_tolerance(self) -> float:
        """Residual norm [N] that the scene asks for."""
        return float(self._tolerances.force_tolerance * self._equations.largest_force())

    def corrected_by(self, correction: float, last: float, residual: float) -> bool:
        """Expect corrections after a Newton step, by its matrix, to go on falling as from ``last`` to
        ``correction`` [m/s]; whether that and the ``residual`` [N] they leave are as small as asked.

        (Deuflhard, Newton Methods for Nonlinear Problems, 2004, section 2.1.)
        """
        part = correction / last
        expected = correction * part / (1.0 - part) if part < SLOWEST else np.inf
        self._expected = expected * self._equations.stage.c
        near = self._tolerances.step_tolerance * self.spacing
        return self._expected <= near and residual <= self._force_tolerance()

    def _moved_by(self, increment: float) -> None:
        """Expect increments to go on falling as they fell last, where the residual shows that they may.

        (Hairer & Wanner, Solving Ordinary Differential Equations II, equation IV.8.10.) Corrections that were
        added tell more.
        """
        fell = increment / self._increment if self.fell and self._increment > 0.0 else 1.0
        self._increment = increment
        self.left = increment * (fell / (1.0 - fell) if fell < SLOWEST else 1.0)
        self.left, self._expected = min(self.left, self._expected), np.inf
