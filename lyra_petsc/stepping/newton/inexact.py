"""Inexact Newton method: the relative tolerance of the linear solver in each Newton iteration.

A loose tolerance is enough while the residual falls from iteration to iteration. In stiff sheets the error of
a loose solve is stretch, and the residual does not fall. The tolerance of the next solves is then ten times
smaller, until the residual falls.
"""

from __future__ import annotations

from collections.abc import Mapping

from petsc4py import PETSc

from lyra_petsc.stepping.newton.convergence import Convergence

LOOSEST, TIGHTEST = 1e-2, 1e-6
"""Relative tolerances of the linear solver in Newton's method. `TIGHTEST` is also that of the single linear
solve of a semi-implicit step.

In scenes with contact `LOOSEST` and `LOOSEST_IN_CONTACT` are also the linear residual of the solve that is
expected to be a step's last one, over the residual that the step may leave: motions in contact magnify errors
of solves, which depend on the number of ranks. It takes up to a quarter more linear iterations. Solves with
multigrid hardly depend on the ranks, and have no such limit while no parts are near."""

LOOSEST_IN_CONTACT = 1e-3
"""`LOOSEST` where parts are near: looser solves cost more Newton iterations, each of which evaluates all
pairs. Not with multigrid, whose iterations are expensive."""

CAREFUL = 1e-4
"""Tolerance in a static analysis, where Newton steps are large and looser solves cost more of them; and in
steps of a scene with contact in which no parts are near: errors of looser solves differ with the number of
ranks and add up until parts meet. It saves one Newton iteration in three, and takes a third more linear
iterations."""

COLLIDING = 1e-9
"""Tolerance of the single linear solve of a semi-implicit step where parts are near, and of all solves of a
step in which parts collide: an impact magnifies the error of a solve, which depends on the number of ranks,
thirty to a hundred times."""

BUCKLING = 1e-5
"""Tolerance in steps in which the Hessian is indefinite while parts are near: the sheet buckles into one of
several shapes, and the error of looser solves decides into which."""

TIGHTEN = 0.3
"""After an iteration that leaves more than this fraction of the residual, the tolerance is tightened."""

TIGHTEN_IN_CONTACT = 0.7
"""The same where parts are near: residuals also fall slowly when contacts open or close."""

LOOSEN = 0.03
"""After an iteration that leaves less than this fraction, the tolerance is loosened."""


class Forcing:
    """Sets the relative tolerance of a KSP before each Newton iteration.

    Parameters
    ----------
    ksp : PETSc.KSP
    fixed : bool
        Whether the user or the analysis fixed the tolerance, which then stays.
    cycles : bool
        Whether the preconditioner is a cycle of multigrid.
    contact : bool
        Whether the scene has contact, whether or not parts are near.
    """

    def __init__(self, ksp: PETSc.KSP, *, fixed: bool, cycles: bool, contact: bool = False) -> None:
        self._ksp, self._fixed, self._cycles, self._contact = ksp, fixed, cycles, contact
        self.tolerance = LOOSEST
        self.begin_solve(near=False, collides=False, buckles=False)

    def begin_solve(self, *, near: bool, collides: bool, buckles: bool) -> None:
        """Prepare for a new solve, with ten times the tolerance at which the last one ended.

        Says whether parts are near in the step, whether they collide, and whether the Hessian may be
        indefinite at its start.
        """
        self._tighten_above = TIGHTEN_IN_CONTACT if near else TIGHTEN
        self._loosest = LOOSEST_IN_CONTACT if near and not self._cycles else LOOSEST
        self.tolerance = min(self._loosest, 10.0 * self.tolerance)
        self._norm = 0.0
        self._near, self._collides, self._buckles = near, collides, buckles

    @property
    def effective_tolerance(self) -> float:
        """The tolerance of the present solves, with the limits of contact but not that of buckling."""
        if self._fixed:
            return self.tolerance
        if self._collides:
            return COLLIDING
        return min(self.tolerance, CAREFUL) if self._contact and not self._near else self.tolerance

    def meet_negative_curvature(self) -> None:
        """Tighten the tolerance in the rest of the step, as its Hessian is indefinite."""
        self._buckles = True
        if self._near and not self._fixed:
            self._ksp.setTolerances(rtol=min(self._ksp.getTolerances()[0], BUCKLING))

    def saved_state(self) -> dict[str, float]:
        """Entries of a checkpoint, for `restore`."""
        return {"tolerance": self.tolerance}

    def restore(self, saved: Mapping[str, float]) -> None:
        """Restore a `saved_state`."""
        self.tolerance = saved["tolerance"]

    def before_solve(self, convergence: Convergence) -> None:
        """Set the tolerance for the next linear solve; collective."""
        if self._fixed:
            return
        norm = convergence.norm
        if self._norm > 0.0 and norm > self._tighten_above * self._norm:
            self.tolerance = max(TIGHTEST, 0.1 * self.tolerance)
        elif norm < LOOSEN * self._norm:
            self.tolerance = min(self._loosest, 10.0 * self.tolerance)
        self._norm, tolerance = norm, self.effective_tolerance
        if self._near and self._buckles:
            tolerance = min(tolerance, BUCKLING)
        if self._contact and (self._near or not self._cycles):
            enough = convergence.force_tolerance()
            if 0.0 < tolerance * norm <= enough:
                tolerance = min(tolerance, (LOOSEST_IN_CONTACT if self._near else LOOSEST) * enough / norm)
        self._ksp.setTolerances(rtol=tolerance)
