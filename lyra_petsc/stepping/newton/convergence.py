"""Convergence test of Newton's method: the scene's tolerances, ``-snes_*tol``, and the round-off floor."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from petsc4py import PETSc

from lyra_petsc.linear.petsc_options import is_set
from lyra_petsc.linear.reasons import NOT_A_NUMBER
from lyra_petsc.scene.schema import Solver
from lyra_petsc.stepping.motion_limits import may_impact
from lyra_petsc.stepping.newton.force_scales import limit_roundoff
from lyra_petsc.stepping.stage_equations import StageEquations

Reason = PETSc.SNES.ConvergedReason

TENFOLD = 0.1
"""The preconditioner is kept after an iteration that leaves less than this fraction of the residual."""

HALVED = 0.5
"""Fraction of the residual below which an iteration is a good one: the exact Hessian is then factored again,
and a correction is taken. Above it the iteration has stalled, at the round-off floor. Increments are
extrapolated only if each is less than this fraction of the one before."""

FINER_IN_CONTACT = 0.1
"""Where parts collide, one more iteration is taken unless this fraction of the tolerances is met: an impact
magnifies the error of a step, which depends on the number of ranks."""

RECENT = 0.1
"""Weight of the last Newton iteration in the running mean of linear iterations."""


class Convergence:
    """The convergence test of one SNES.

    Parameters
    ----------
    equations : StageEquations
    tolerances : Solver
        The block ``solver`` of the scene.
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
    fell_tenfold : bool
        Whether the last iteration reduced the residual tenfold.
    halved : bool
        Whether the last iteration halved the residual.
    at_roundoff : bool
        Whether the solve ended because only round-off was left.
    remaining : float
        Estimated remaining correction of any coordinate [m].
    too_slow : bool
        Whether the solve was given up because `mean_iterations` exceeded ``break_even_iterations``.
    mean_iterations : float
        Running mean of the linear iterations per Newton iteration.
    stopped_by : str
        The option that ended the solve before the scene's force tolerance was met, or an empty string.
    max_displacement : float
        Displacement [m] of a coordinate in one iteration beyond which the solve is given up.
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
        self._floor = self._minimum_floor = floor
        self._break_even_iterations = break_even_iterations
        self.mean_iterations, self.max_displacement = 0.0, np.inf
        self.begin_solve()

    def begin_solve(self) -> None:
        """Prepare for a new solve."""
        self.norm, self.fell_tenfold, self.at_roundoff, self._floor = 0.0, False, False, self._minimum_floor
        self.halved = True
        self.remaining, self.too_slow, self.stopped_by = np.inf, False, ""
        self._first_norm = self._increment = 0.0
        self._stalled = self._iterations_before = 0
        self._balanced = self._ended = self._met_tolerances = False
        self._after_correction = np.inf

    def saved_state(self) -> dict[str, float]:
        """Entries of a checkpoint, for `restore`."""
        return {"usual": self.mean_iterations}

    def restore(self, saved: Mapping[str, float]) -> None:
        """Restore a `saved_state`."""
        self.mean_iterations = saved["usual"]

    def accepts_last_iterate(self) -> bool:
        """Whether the solve is good where this test or a line search ended it; collective.

        In dynamics it is where forces are in balance, or where their round-off hides a smaller energy. After
        a failed line search PETSc reports convergence if the step is short, whatever the residual. In statics
        balanced forces are not enough, because small forces may cause large displacements.
        """
        if self._ended or not self._equations.integrator.dynamic:
            return self._ended
        self._raise_floor()
        self.at_roundoff = self.force_tolerance() < self.norm <= self._floor
        return self.balanced

    @property
    def balanced(self) -> bool:
        """Whether the last residual is below the force tolerance or the round-off floor."""
        return self.norm <= max(self._floor, self.force_tolerance())

    def test(self, snes: PETSc.SNES, iteration: int, residual: float, linear_iterations: int) -> int | None:
        """SNES's converged reason after so many linear iterations of the solve, or None; collective."""
        reason = self._test(snes, iteration, residual, linear_iterations)
        self._ended = reason is not None
        return reason

    def _test(self, snes: PETSc.SNES, iteration: int, residual: float, linear_iterations: int) -> int | None:
        before, self.norm = self.norm, residual
        self.fell_tenfold = residual < TENFOLD * before
        self.halved = iteration == 0 or residual < HALVED * before
        if not np.isfinite(residual):
            return NOT_A_NUMBER
        if iteration > 0:
            increment = snes.getSolutionUpdate().norm(PETSc.NormType.INFINITY)
            moved = increment * self._equations.step.stage.c
            if moved > self.max_displacement:
                return int(Reason.DIVERGED_MAX_IT)
            self._estimate_remaining(moved)
            spent = linear_iterations - self._iterations_before
            self.mean_iterations += RECENT * (spent - self.mean_iterations)
        slow = not self.halved
        if slow:
            self._raise_floor()
        self._stalled = self._stalled + 1 if slow and residual <= self._floor else 0
        if self._stalled > 1 or residual == 0.0:
            self.at_roundoff = residual > 0.0
            return int(Reason.CONVERGED_FNORM_ABS)
        self._iterations_before = linear_iterations
        if self.mean_iterations > self._break_even_iterations:
            self.too_slow = True
            return int(Reason.DIVERGED_LINEAR_SOLVE)
        rtol, atol, stol = (
            value if is_set(f"snes_{name}") else 0.0
            for name, value in zip(("rtol", "atol", "stol"), snes.getTolerances()[:3], strict=True)
        )
        if residual > atol and iteration == 0:
            self._first_norm = residual
            return None
        balanced = residual <= self.force_tolerance()
        if residual <= atol:
            self.stopped_by = "" if balanced else "-snes_atol"
            return int(Reason.CONVERGED_FNORM_ABS if balanced else Reason.DIVERGED_INNER)
        if residual <= rtol * self._first_norm:
            self.stopped_by = "" if balanced else "-snes_rtol"
            return int(Reason.CONVERGED_FNORM_RELATIVE)
        was_balanced, self._balanced = self._balanced, balanced
        tolerance = self._tolerances.step_tolerance * self.spacing
        if balanced and self.remaining <= tolerance and not self._needs_finer_solve(tolerance):
            # the reason is the tolerance that was met last
            return int(Reason.CONVERGED_SNORM_RELATIVE if was_balanced else Reason.CONVERGED_FNORM_RELATIVE)
        if 0.0 < self.remaining <= stol * self.spacing:
            self.stopped_by = "" if balanced else "-snes_stol"
            return int(Reason.CONVERGED_SNORM_RELATIVE)
        return None

    def _raise_floor(self) -> None:
        """Include the round-off of limits at the positions last evaluated in the floor; collective."""
        if self._equations.near or self._equations.active.limiting:
            self._floor = max(self._minimum_floor, limit_roundoff(self._equations.evaluated))

    def _needs_finer_solve(self, tolerance: float) -> bool:
        """Whether a solve that meets the tolerances needs one more iteration because parts may collide.

        ``tolerance`` [m] is that of the remaining correction; collective.
        """
        equations, was_good = self._equations, self._met_tolerances
        self._met_tolerances = True
        if was_good or not equations.integrator.dynamic:
            return False
        enough, part = self.force_tolerance(), FINER_IN_CONTACT
        coarse = self.norm > part * enough or self.remaining > part * tolerance
        return coarse and may_impact(equations)

    def force_tolerance(self) -> float:
        """Residual norm [N] that the scene's tolerance allows; collective."""
        return float(self._tolerances.force_tolerance * self._equations.forces.largest_force())

    def correction_suffices(self, correction: float, last: float, residual: float) -> bool:
        """Whether a Newton step and its corrections meet the tolerances, so that no further one is needed.

        The remaining correction is estimated from the ratio of ``correction`` to ``last``, the increment
        before it [m/s]; ``residual`` [N] is that after the correction.
        (Deuflhard, Newton Methods for Nonlinear Problems, 2004, section 2.1.)
        """
        part = correction / last
        expected = correction * part / (1.0 - part) if part < HALVED else np.inf
        self._after_correction = expected * self._equations.step.stage.c
        tolerance = self._tolerances.step_tolerance * self.spacing
        return self._after_correction <= tolerance and residual <= self.force_tolerance()

    def _estimate_remaining(self, increment: float) -> None:
        """Estimate the remaining correction from the ratio of the last two increments [m].

        The ratio is used only if the residual fell fast (Hairer & Wanner, Solving Ordinary Differential
        Equations II, equation IV.8.10). An estimate from corrections is better and replaces a larger one.
        """
        fell = increment / self._increment if self.fell_tenfold and self._increment > 0.0 else 1.0
        self._increment = increment
        self.remaining = increment * (fell / (1.0 - fell) if fell < HALVED else 1.0)
        self.remaining, self._after_correction = min(self.remaining, self._after_correction), np.inf
