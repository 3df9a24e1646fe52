"""What SNES asks while it iterates: Jacobians, directions, energies, and whether to stop."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.assembly.matrix import SystemMatrix
from lyra_petsc.profiling import JACOBIAN, JACOBIAN_AGAIN, logged
from lyra_petsc.scene.schema import Solver
from lyra_petsc.solvers import failed_factors
from lyra_petsc.solvers.inertia import negative_pivots, shows_negative_curvature
from lyra_petsc.solvers.options import is_set
from lyra_petsc.solvers.reasons import NOT_A_NUMBER
from lyra_petsc.stepping.blend import Blend
from lyra_petsc.stepping.forcing import Forcing
from lyra_petsc.stepping.shift import Shift, allows_enlarging
from lyra_petsc.stepping.system import ReducedSystem
from lyra_petsc.stepping.watchdog import Watchdog

Array = NDArray[np.float64]
Reason = PETSc.SNES.ConvergedReason

ENERGY_ROUNDOFF = 1e-14
"""Differences of the objective below this fraction of its summands are noise."""


STALLED = 0.5
"""Fraction of the residual left by an iteration above which, at the round-off floor, it falls no more."""

FELL = 0.1
"""Fraction of the residual left by an iteration below which the preconditioner stays."""

SLOWEST = 0.5
"""Fraction of the increment before above which an increment says nothing of the next ones."""

RECENT = 0.1
"""Weight of the last Newton iteration in the mean of linear iterations that judges the linear solver."""


class Newton:
    """Callbacks of one SNES and the memory between them.

    Parameters
    ----------
    snes : PETSc.SNES
    system : ReducedSystem
    matrix, preconditioner : SystemMatrix
        The Jacobian and what the preconditioner is built from; may be the same.
    blend : Blend
    tolerances : Solver
        The scene's block.
    spacing : float
        Mean edge length [m], for the step tolerance.
    floor : float
        Norm [N] of the residual's round-off.
    iterates : bool
        There is more than one iteration (not so under ``semi-implicit``).
    linear_limit : float
        Linear iterations per Newton iteration above which another preconditioner is cheaper.

    Attributes
    ----------
    norm : float
        Last residual norm [N].
    at_roundoff : bool
        Whether the solve ended because only round-off was left.
    left : float
        What any coordinate is expected to move yet [m], should iterations go on.
    more_linear : int
        Linear iterations of directions that were solved for again.
    too_slow : bool
        Whether the solve was given up since its linear iterations passed the limit.
    """

    def __init__(
        self,
        snes: PETSc.SNES,
        system: ReducedSystem,
        matrix: SystemMatrix,
        preconditioner: SystemMatrix,
        blend: Blend,
        tolerances: Solver,
        spacing: float,
        floor: float,
        *,
        iterates: bool,
        linear_limit: float,
    ) -> None:
        self._iterates, self._linear_limit = iterates, linear_limit
        self._snes, self._ksp, self._system = snes, snes.getKSP(), system
        self._matrix, self._preconditioner, self._blend = matrix, preconditioner, blend
        self._tolerances, self._spacing, self._floor = tolerances, spacing, floor
        self._shape = (system.points.n_owned, 3)
        self._from: PETSc.Vec | None = None
        self._watchdog = Watchdog()
        self._usual = 0.0
        self._began_convex = False
        self.forcing = Forcing(self._ksp, fixed=is_set("ksp_rtol"))
        self._alone = preconditioner is matrix
        in_place = self._alone and not iterates and allows_enlarging(matrix)
        self.shift = Shift(self._ksp, acts=not self._alone or in_place)
        self.begin_step()

    def begin_step(self) -> None:
        """Forget the step before."""
        self.norm, self.at_roundoff, self.more_linear = 0.0, False, 0
        self._length = self._first_norm = self._at_norm = 0.0
        self._at = (0.0, 0.0)
        self._slope, self._returns = 0.0, False
        self._stalled, self.too_slow, self.left, self._increment = 0, False, np.inf, 0.0
        self._fell = self._kept = self._same = False
        # a step begins as the one before did
        self._convex = self._began_convex
        self._spent = 0
        self._watchdog.begin()
        self.shift.begin()
        self.forcing.begin()

    @logged(JACOBIAN)
    def assemble(self, u: PETSc.Vec) -> None:
        """Jacobian, and preconditioning matrix, at velocities u."""
        v = u.getArray(readonly=True).reshape(self._shape)
        if self._iterates:
            self._system.new_iterate(v)
            self.forcing.before_solve(self.norm)
        self._set_matrix(v, self._blend.after(self._taken(u)))
        # where Newton converges the geometry hardly changes: what was set up an iteration ago still serves
        if self._alone:
            return
        self._kept = self._fell
        convex = not self._iterates or (self._convex and shows_negative_curvature(self._ksp.getPC()))
        self._same = convex and not self._kept
        if self._same:
            # as long as it is positive definite there is no better preconditioner
            self._preconditioner.set(self._matrix.rows, self.shift.value)
        elif not self._kept:
            self._set_preconditioner(v)

    def factor(self) -> None:
        """Set up a preconditioner that is built from the Jacobian while that has a larger diagonal."""
        if self._alone and self.shift.value > 0.0:
            mat = self._matrix.mat
            self._ksp.setOperators(mat, mat)
            with self._matrix.larger_diagonal(self.shift.value):
                self._ksp.setUp()
                self._ksp.setUpOnBlocks()

    def _set_matrix(self, v: Array, blend: float) -> None:
        self._system.jacobian(v, blend, self._matrix.rows)
        self._matrix.set(self._matrix.rows)

    def _set_preconditioner(self, v: Array) -> None:
        self._system.jacobian(v, 1.0, self._preconditioner.rows)
        self._preconditioner.set(self._preconditioner.rows, self.shift.value)

    def remember(self, u: PETSc.Vec) -> None:
        """Note energy and residual of the present iterate, against which trial points are judged."""
        self._at = self._system.objective(u.getArray(readonly=True).reshape(self._shape))
        self._at_norm = self._snes.getFunctionNorm()
        energy, size = self._at
        self._watchdog.see(u, energy, ENERGY_ROUNDOFF * size)

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
        changed = False
        self._returns = self._watchdog.lost
        if self._returns:
            self._watchdog.go_back(x, y)
            self._system.new_iterate(None)
            return True
        residual = self._snes.getFunction()[0]
        useless = self._useless(residual, y)
        self._convex = not useless
        if self._snes.getIterationNumber() == 0:
            self._began_convex = self._convex
        while useless:
            if failed_factors.forget(self._ksp):
                pass
            elif self._kept or self._same or self.shift.raise_():
                self._precondition_again(x)
            elif self._blend.raise_():
                self._assemble_again(x)
            else:
                y.zeroEntries()
                return True
            self._ksp.setOperators(self._matrix.mat, self._preconditioner.mat)
            self._ksp.solve(residual, y)
            self.more_linear += self._ksp.getIterationNumber()
            changed = True
            useless = self._useless(residual, y)
        if self._from is not None:
            self._from.destroy()
        self._from, self._length = x.copy(), y.norm()
        self._slope = residual.dot(y)
        return changed

    @logged(JACOBIAN_AGAIN)
    def _precondition_again(self, u: PETSc.Vec) -> None:
        self._set_preconditioner(u.getArray(readonly=True).reshape(self._shape))
        self._kept = self._same = False

    @logged(JACOBIAN_AGAIN)
    def _assemble_again(self, u: PETSc.Vec) -> None:
        self._set_matrix(u.getArray(readonly=True).reshape(self._shape), self._blend.value)

    def _useless(self, residual: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Whether the linear solve failed in a way that leaves no direction of descent."""
        if self._ksp.getConvergedReason() < 0 or not residual.dot(y) > 0.0:
            return True
        return self._same and negative_pivots(self._ksp.getPC()) > 0

    def objective(self, snes: PETSc.SNES, u: PETSc.Vec) -> float:
        """Energy of a trial point; where differences drown in round-off, judged by its residual."""
        v = u.getArray(readonly=True).reshape(self._shape)
        value, size = self._system.objective(v)
        here, here_size = self._at
        if value != here and np.isfinite(value) and (self._returns or self._watchdog.trusts):
            return min(value, here - self._slope)
        noise = ENERGY_ROUNDOFF * max(size, here_size)
        if value == here or not abs(value - here) < noise:
            return value
        trial = np.empty(self._shape)
        self._system.residual(v, self._system.stage.sigma * (v - self._system.history), trial)
        (square,) = self._system.points.summed(float(np.vdot(trial, trial)))
        smaller = bool(np.sqrt(square) < self._at_norm)
        return here - noise if smaller else here + noise

    def converged(self, snes: PETSc.SNES, iteration: int, norms: tuple[float, float, float]) -> int | None:
        """SNES's reason to stop, in terms of the scene's tolerances and of the user's ``-snes_*tol``."""
        _, _, residual = norms
        before, self.norm = self.norm, residual
        self._fell = residual < FELL * before
        if not np.isfinite(residual):
            return NOT_A_NUMBER
        if iteration > 0:
            self._moved_by(snes.getSolutionUpdate().norm(PETSc.NormType.INFINITY) * self._system.stage.reach)
        stalls = iteration > 0 and STALLED * before < residual <= self._floor
        self._stalled = self._stalled + 1 if stalls else 0
        if self._stalled > 1 or residual == 0.0:
            self.at_roundoff = residual > 0.0
            return int(Reason.CONVERGED_FNORM_ABS)
        spent = snes.getLinearSolveIterations() + self.more_linear
        if iteration > 0:
            self._usual += RECENT * (spent - self._spent - self._usual)
        self._spent = spent
        if self._usual > self._linear_limit:
            self.too_slow = True
            return int(Reason.DIVERGED_LINEAR_SOLVE)
        rtol, atol, stol, _ = snes.getTolerances()
        if residual <= atol:
            return int(Reason.CONVERGED_FNORM_ABS)
        if iteration == 0:
            self._first_norm = residual
            return None
        if residual <= rtol * self._first_norm:
            return int(Reason.CONVERGED_FNORM_RELATIVE)
        scale = self._system.largest_force()
        if (
            residual <= self._tolerances.force_tolerance * scale
            and self.left <= self._tolerances.step_tolerance * self._spacing
        ):
            return int(Reason.CONVERGED_FNORM_RELATIVE)
        if 0.0 < self.left <= stol * self._spacing:
            return int(Reason.CONVERGED_SNORM_RELATIVE)
        return None

    def _moved_by(self, increment: float) -> None:
        """Expect increments to go on falling as they fell last, where the residual shows that they may.

        (Hairer & Wanner, Solving Ordinary Differential Equations II, equation IV.8.10.)
        """
        fell = increment / self._increment if self._fell and self._increment > 0.0 else 1.0
        self._increment = increment
        self.left = increment * (fell / (1.0 - fell) if fell < SLOWEST else 1.0)
