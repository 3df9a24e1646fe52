"""How exactly a Newton iteration's linear system is solved: as exactly as pays.

A loose solve is enough where the residual falls from iteration to iteration. In stiff sheets what it leaves
is stretch, and the residual does not fall: then the next solves are ten times as exact, until it does.
"""

from __future__ import annotations

from petsc4py import PETSc

LOOSEST, TIGHTEST = 1e-2, 1e-6
"""Relative tolerances of the linear solver."""

LOOSEST_IN_CONTACT = 1e-3
"""Where parts are near, but for multigrid, whose iterations are dear: looser solves cost more Newton
iterations, each of which evaluates all pairs."""

STATIC = 1e-4
"""In a static analysis always: its Newton steps are so large that a looser solve costs more of them."""

ONCE, ONCE_IN_CONTACT = 1e-6, 1e-9
"""Of the one linear solve of a semi-implicit step; the second where parts are near, and of all solves of a
step in which parts collide. An impact magnifies what a solve leaves, which depends on the number of ranks,
thirty to a hundred times."""

ALONE = 1e-4
"""Tolerance of the solves of a step with contact in which nothing is near: what looser ones leave, more on
some ranks than on others, adds up until parts meet. It saves an iteration of Newton's method in three, and
takes a third more of the linear solver's."""

COLLISION = 1.0
"""How much nearer parts come in a step, over the edges' mean length, from which on they collide: sheets then
buckle in one of many ways, and the first directions of Newton's method tell in which."""

SLOW = 0.3
"""Fraction of the residual left by an iteration above which the linear solve was too loose."""

SLOW_IN_CONTACT = 0.7
"""The same where parts are near: residuals also fall slowly as pairs meet and part."""

FAST = 0.03
"""Fraction below which a looser one would have done."""


class Forcing:
    """Sets the tolerance of a KSP before each Newton iteration, unless the user gave one.

    Parameters
    ----------
    ksp : PETSc.KSP
    fixed : bool
        Leave it alone.
    cycles : bool
        Whether the preconditioner is a cycle of multigrid.
    contact : bool
        Whether there is contact, near or not.
    """

    def __init__(self, ksp: PETSc.KSP, *, fixed: bool, cycles: bool, contact: bool = False) -> None:
        self._ksp, self._fixed, self._cycles, self._contact = ksp, fixed, cycles, contact
        self.tolerance = LOOSEST
        self.begin(near=False, collides=False)

    def begin(self, *, near: bool, collides: bool) -> None:
        """A new solve: begin a little looser than the last one ended. In it parts may touch where they are
        ``near``, or collide.
        """
        self._slow = SLOW_IN_CONTACT if near else SLOW
        self._loosest = LOOSEST_IN_CONTACT if near and not self._cycles else LOOSEST
        self.tolerance = min(self._loosest, 10.0 * self.tolerance)
        self._norm = 0.0
        self._collides, self._alone = collides, self._contact and not near

    @property
    def in_use(self) -> float:
        """The tolerance of the present solves."""
        if self._collides and not self._fixed:
            return ONCE_IN_CONTACT
        return min(self.tolerance, ALONE) if self._alone and not self._fixed else self.tolerance

    def before_solve(self, norm: float) -> None:
        """``norm`` [N] is the residual at the present iterate."""
        if self._fixed:
            return
        if self._norm > 0.0 and norm > self._slow * self._norm:
            self.tolerance = max(TIGHTEST, 0.1 * self.tolerance)
        elif norm < FAST * self._norm:
            self.tolerance = min(self._loosest, 10.0 * self.tolerance)
        self._norm = norm
        self._ksp.setTolerances(rtol=self.in_use)
