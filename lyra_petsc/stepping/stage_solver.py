"""PETSc's TS, SNES, KSP and Mat with one linear solver: they solve the stage of a step."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.linear import failed_factors, presets, reasons
from lyra_petsc.linear.hierarchy import Surface
from lyra_petsc.linear.petsc_options import (
    PYTHON_SUFFIXES,
    culprits,
    fill_gaps,
    is_set,
    of_user,
    quoted,
    refused,
)
from lyra_petsc.parallel import all_ranks_arrive
from lyra_petsc.phases import RESIDUAL, logged
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.directors import update_frames
from lyra_petsc.stepping.newton.convergence import Convergence
from lyra_petsc.stepping.newton.convexity import Convexity
from lyra_petsc.stepping.newton.extrapolation import Extrapolation
from lyra_petsc.stepping.newton.inexact import CAREFUL, COLLIDING, LOOSEST, TIGHTEST
from lyra_petsc.stepping.newton.initial_guess import first_guess
from lyra_petsc.stepping.newton.iterates import Iterates
from lyra_petsc.stepping.newton.linear_system import LinearSystem
from lyra_petsc.stepping.newton.newton_trace import FailedSolve, Iteration, Trace
from lyra_petsc.stepping.newton.snes_callbacks import NewtonCallbacks
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.time_step import Evaluation
from lyra_petsc.stepping.ts_options import hidden_options

Reason = PETSc.SNES.ConvergedReason

FIRST_DT_FRACTION = 1e-3
"""First Δt of an adaptive run over its length; the error estimate corrects it at once."""


@dataclass(frozen=True)
class StageSolution:
    """Outcome of one solve: the evaluation that solves the stage, or None and why."""

    evaluation: Evaluation | None
    message: str
    newton_iterations: int
    linear_iterations: int


class StageSolver:
    """Solves stages by TSBEULER or TSTHETA, with Newton's method or one linear solve.

    TSBDF and TSALPHA2 are not used, as neither checkpoints nor a changed linear solver reach their histories;
    the integrator holds these instead, and TS only solves for the stage.

    Parameters
    ----------
    scene : Scene
    equations : StageEquations
    surface : Surface
    spacing : float
        Mean edge length [m], for the step tolerance.
    floor : float
        Norm [N] of the residual's round-off.
    candidates : sequence of str
        The linear solver, and those to try next.
    convexity : Convexity
    extrapolation : Extrapolation
        Of the velocities, where a step is one linear solve.

    Attributes
    ----------
    ts, snes, ksp : PETSc objects
        Without options prefix.
    velocity : PETSc.Vec
    linear : LinearSystem
        The matrices.
    newton : NewtonCallbacks
    convergence : Convergence
        The convergence test of the nonlinear solves.
    filled : list of str
        Options that are set here because the user did not.
    linear_failed : bool
        Whether the last solve failed, and might succeed with another preconditioner.

    Raises
    ------
    InputError
        For options that PETSc refuses.
    """

    def __init__(
        self,
        scene: Scene,
        equations: StageEquations,
        surface: Surface,
        *,
        spacing: float,
        floor: float,
        candidates: Sequence[str],
        convexity: Convexity,
        extrapolation: Extrapolation,
    ) -> None:
        self._equations, self._extrapolation, self._candidates = equations, extrapolation, candidates
        self._iterates, self.linear_failed = equations.integrator.iterates, False
        points = equations.points
        self._shape = (points.n_owned, 3)
        self.filled = fill_gaps(presets.options_of(candidates[0], points.comm.size))
        hessian = scene.solver.hessian
        self.linear = LinearSystem(equations, surface, candidates[0], hessian, iterates=self._iterates)
        self.velocity = PETSc.Vec().create(points.comm)
        self.velocity.setSizes((3 * points.n_owned, 3 * points.n_global), bsize=3)
        self.velocity.setType(PETSc.Vec.Type.MPI if points.comm.size > 1 else PETSc.Vec.Type.SEQ)
        self._residual = self.velocity.duplicate()
        self._create_ts(scene)
        self.snes, self.ksp = self.ts.getSNES(), self.ts.getSNES().getKSP()
        self.snes.setInitialGuess(self._guess)
        limit = presets.break_even_iterations(points.n_global, candidates)
        self.convergence = Convergence(equations, scene.solver, spacing, floor, break_even_iterations=limit)
        self._points = Iterates(equations)
        self.newton = newton = NewtonCallbacks(
            self.snes,
            equations,
            self.linear,
            convexity,
            self.convergence,
            self._points,
            iterates=self._iterates,
            follow=self._follow_stencils,
        )
        self.ksp.setType(PETSc.KSP.Type.CG)
        self.ksp.setTolerances(max_it=5000)
        self._trace = Trace(self.snes, points, lambda: newton.linear_iterations)
        self._set_monitors_and_tolerances(scene, floor)
        # objects that PETSc frees after Python has ended must not call Python
        self._at_exit = weakref.finalize(self, _remove_python_types, self.ksp)
        self._take_options()
        self.ts.setSolution(self.velocity)

    # -- objects -------------------------------------------------------------------------------------

    def _create_ts(self, scene: Scene) -> None:
        integrator = self._equations.integrator
        self.ts = ts = PETSc.TS().create(self._equations.points.comm)
        ts.setProblemType(PETSc.TS.ProblemType.NONLINEAR)
        ts.setType(integrator.ts_type)
        if integrator.ts_type == "theta":
            ts.setTheta(0.5)
        ts.setIFunction(self._ifunction, self._residual)
        self._set_jacobian()
        ts.setMaxTime(scene.time.end)
        ts.setTimeStep(FIRST_DT_FRACTION * scene.time.end if scene.time.step == "auto" else scene.time.step)
        ts.setMaxSteps(np.iinfo(PETSc.IntType).max - 1)
        ts.setMaxSNESFailures(1)
        ts.setErrorIfStepFails(False)
        ts.setExactFinalTime(PETSc.TS.ExactFinalTime.STEPOVER)

    def _print_contact(self, snes: PETSc.SNES, number: int, norm: float) -> None:
        """The monitor ``-contact_monitor``: contact at each iterate, below the line of ``-snes_monitor``."""
        equations, contact = self._equations, self._equations.contact
        assert contact is not None
        x = equations.evaluate(snes.getSolution().getArray(readonly=True).reshape(-1, 3)).x
        line = contact.report(x, equations.step.frozen).iterate(self.newton.step_fraction)
        PETSc.Sys.Print(f"{' ' * snes.getTabLevel()}{number:3d} {line}", comm=equations.points.comm)

    def _set_monitors_and_tolerances(self, scene: Scene, floor: float) -> None:
        equations, newton, snes, ksp = self._equations, self.newton, self.snes, self.ksp
        if equations.discretisation.stencils_change or (equations.active.with_edges and self._iterates):
            snes.setUpdate(self._update)
        if PETSc.Options().getBool("contact_monitor", False) and equations.contact is not None:
            snes.setMonitor(self._print_contact)
        if not self._iterates:
            snes.setType(PETSc.SNES.Type.KSPONLY)
            ksp.setTolerances(rtol=TIGHTEST)
            ksp.setInitialGuessNonzero(True)
            return
        snes.setMonitor(self._trace.monitor)
        snes.setType(PETSc.SNES.Type.NEWTONLS)
        snes.setObjective(newton.globalisation.objective)
        # shown by -snes_view, and compared with what options set. PETSc accepts only rtol < 1
        rtol, stol = min(scene.solver.force_tolerance, 0.99), scene.solver.step_tolerance
        snes.setTolerances(rtol=rtol, atol=floor, stol=stol, max_it=scene.solver.max_iterations)
        snes.setConvergenceTest(newton.converged)
        snes.setLineSearchPreCheck(newton.correct_direction)
        # an indefinite Hessian costs an iteration, not the step
        snes.setMaxKSPFailures(scene.solver.max_iterations)
        ksp.setTolerances(rtol=LOOSEST if equations.integrator.dynamic else CAREFUL)

    def _take_options(self) -> None:
        ksp = self.ksp
        try:
            self.velocity.setFromOptions()
            with hidden_options():
                self.ts.setFromOptions()
            self.linear.attach(ksp)
        except Exception as error:
            if not isinstance(error, (PETSc.Error, InputError)) and not _runs_foreign_python():
                raise
            problem = error if isinstance(error, InputError) else refused(error)
            self.destroy()
            raise problem from None
        if ksp.getType() in presets.CONJUGATE_GRADIENTS and not is_set("ksp_norm_type"):
            # the preconditioned norm is meaningless if the preconditioner is near breakdown
            ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)

    def _set_jacobian(self) -> None:
        self.ts.setIJacobian(self._ijacobian, self.linear.operator.mat, self.linear.preconditioner.mat)

    def _follow_stencils(self) -> bool:
        """Renew the matrices if stencils have changed; return whether they have; collective."""
        if not self.linear.update_pattern():
            return False
        self._set_jacobian()
        return True

    def destroy(self) -> None:
        """Free all PETSc objects and remove the options that were filled in; collective."""
        database = PETSc.Options()
        for name in self.filled:
            database.delValue(name)
        self._at_exit()
        self.newton.destroy()
        self.ts.destroy()
        self.linear.destroy()
        self.velocity.destroy()
        self._residual.destroy()

    # -- a solve -------------------------------------------------------------------------------------

    def solve(self, start: Array | None = None, guess: Array | None = None) -> StageSolution:
        """Solve the present stage; collective.

        ``start``, by default where the step starts, are velocities (n_owned, 3) [m/s] that no collision
        hinders; ``guess`` those of a solve of the stage with other contacts, where this one starts.
        """
        evaluation, message = self._solve(start, guess)
        return StageSolution(
            evaluation, message, self.snes.getIterationNumber(), self.newton.linear_iterations
        )

    def _solve(self, start: Array | None, guess: Array | None) -> tuple[Evaluation | None, str]:
        equations, step = self._equations, self._equations.step
        if start is None:
            equations.prescribe(start := equations.stationary_velocity())
        self._start, self._known_guess = start, guess
        self._follow_stencils()
        self.velocity.setArray(step.v_h.ravel())
        # a TS step whose stage is at the integrator's time and whose shift is the integrator's σ
        theta = 0.5 if self.ts.getType() == "theta" else 1.0
        length = 1.0 / (theta * step.stage.sigma)
        self.ts.setTime(step.at_stage - theta * length)
        self.ts.setTimeStep(length)
        self.newton.begin_solve()
        if not self._iterates and not is_set("ksp_rtol"):
            self.ksp.setTolerances(rtol=COLLIDING if equations.near else TIGHTEST)
        self._trace.begin_solve()
        try:
            self.ts.step()
        except Exception as error:
            if not isinstance(error, PETSc.Error) and not _runs_foreign_python():
                raise
            return None, self._message(error)
        self.linear_failed = False
        if not self._iterates:
            self.linear.reuse.end_solve(self.ksp.getIterationNumber())
        message = self._judge()
        if message:
            return None, message
        reached = self.snes.getSolution()
        velocity = reached.getArray(readonly=True).reshape(self._shape)
        if any(equations.points.global_max(not np.isfinite(velocity).all())):
            return None, "the velocities are not finite"
        whole = self._iterates or step.of_edges
        evaluation = self._points.at(reached) if whole else equations.evaluate(velocity)
        self._points.forget()  # to save memory
        return evaluation, ""

    def _message(self, error: Exception) -> str:
        """Message of a solve that PETSc stopped on all ranks, if another preset may help; collective."""
        together = all_ranks_arrive(self._equations.points.comm)
        if together and self._next_may_help(error):
            self.linear_failed = True
            return f"the preconditioner could not be set up: {reasons.error_message(error)}"
        kept = "the state before it" if together else "the last checkpoint (the other ranks work on)"
        raise SolverError(
            f"PETSc stopped in the step from t = {self._equations.step.start:g} s: "
            f"{reasons.error_message(error)}; {kept} is kept; check {culprits(error, self.filled)}",
            collective=together,
        ) from None

    def _next_may_help(self, error: Exception) -> bool:
        """Whether an error of PETSc's on all ranks is one of this preset's set-up, not of a user's option,
        and another preset is left; collective.
        """
        blamed = of_user(quoted(error), self.filled)
        may_help = len(self._candidates) > 1 and reasons.in_set_up(error) and not blamed
        return not any(self._equations.points.global_max(not may_help))

    def _judge(self) -> str:
        """Why the solve that PETSc ended is not good, or nothing; collective."""
        reason, convergence = self.snes.getConvergedReason(), self.convergence
        if self._iterates and (reason > 0 or reason == Reason.DIVERGED_LINE_SEARCH):
            if not convergence.accepts_last_iterate():
                self.snes.setConvergedReason(Reason.DIVERGED_LINE_SEARCH)
            elif reason < 0:
                self.snes.setConvergedReason(Reason.CONVERGED_FNORM_ABS)
                self.ts.setConvergedReason(PETSc.TS.ConvergedReason.CONVERGED_ITERATING)
        if self.ts.getConvergedReason() >= 0 and self.snes.getConvergedReason() > 0:
            return ""
        if self.stopped_by:
            return f"{self.stopped_by} stopped Newton's method short of solver.force_tolerance"
        self.linear_failed = convergence.too_slow or reasons.preconditioner_failed(self.ksp)
        return reasons.failure_reason(self.snes, self.ksp)

    @property
    def stopped_by(self) -> str:
        """The option that ended the last solve short of the scene's force tolerance; else empty."""
        return self.convergence.stopped_by

    def improve_factors(self) -> bool:
        """Whether one linear solve that failed may succeed with other factors, which the next solve makes."""
        if self._iterates:
            return False
        finite = self.ksp.getConvergedReason() != PETSc.KSP.ConvergedReason.DIVERGED_NANORINF
        too_old = self.linear.reuse.reused and self.linear_failed and finite
        if not (failed_factors.replace_failed(self.ksp) or self.linear.shift.increase() or too_old):
            return False
        self.linear.reuse.discard()
        return True

    def failed_solve(self) -> FailedSolve:
        """The state of the solve that just failed; collective, before the next step begins."""
        return _failed_solve(self._equations, self.snes, self._trace.iterations)

    def solve_without_start(self) -> FailedSolve:
        """The same of a solve that cannot begin, where the step starts; collective."""
        self._trace.begin_solve()
        start = self._equations.stationary_velocity()
        return _failed_solve(self._equations, self.snes, self._trace.iterations, start)

    # -- callbacks -----------------------------------------------------------------------------------

    @logged(RESIDUAL)
    def _ifunction(self, ts: PETSc.TS, t: float, u: PETSc.Vec, udot: PETSc.Vec, f: PETSc.Vec) -> None:
        v = u.getArray(readonly=True).reshape(self._shape)
        self._equations.forces.residual(v, self._points.at(u), f.getArray().reshape(self._shape))

    def _guess(self, snes: PETSc.SNES, u: PETSc.Vec) -> None:
        equations, guess = self._equations, u.getArray().reshape(self._shape)
        if self._known_guess is not None:
            guess[:] = self._known_guess
            return
        first = first_guess(equations, self._start, guess)
        if first.extrapolated:
            self.newton.curve_guess(equations.stationary_velocity(), self._start, guess)
        if not self._iterates:
            # the linear solve starts from the extrapolation; its tolerance stays relative to the full step
            step, v = equations.step, equations.v[: len(guess)]
            ahead = self._extrapolation.extrapolate(step.end, step.start, v)
            equations.prescribe(ahead)
            snes.getSolutionUpdate().setArray((guess - ahead).ravel())
        elif first.point is not None:
            del guess  # the vector's state changes when its array is no longer used
            self._points.add(u, first.point)

    def _ijacobian(
        self, ts: PETSc.TS, t: float, u: PETSc.Vec, udot: PETSc.Vec, shift: float, a: PETSc.Mat, p: PETSc.Mat
    ) -> bool:
        self.newton.assemble(u)
        if self._iterates:
            kinks = self._equations.has_active_pairs and self._equations.integrator.dynamic
            self.newton.globalisation.note_iterate(u, kinks=kinks)
        return True

    def _update(self, snes: PETSc.SNES, iteration: int) -> None:
        """Update stencils and frames before a Newton iteration; collective."""
        if iteration > 0 and update_frames(self._equations, self._points.at(snes.getSolution()).x):
            snes.computeFunction(snes.getSolution(), snes.getFunction()[0])
            self.newton.globalisation.begin_solve()
        self._follow_stencils()


def _failed_solve(
    equations: StageEquations,
    snes: PETSc.SNES,
    iterations: Sequence[Iteration],
    velocity: Array | None = None,
) -> FailedSolve:
    """The state of a solve that failed, or could not begin at ``velocity`` (n_owned, 3) [m/s]; collective."""
    step, n, ksp = equations.step, equations.points.n_owned, snes.getKSP()
    if velocity is None:
        velocity = snes.getSolution().getArray(readonly=True).reshape(n, 3).copy()
    residual = equations.residual_at(velocity)
    position = (equations.x[:n] if step.stage.x is None else step.stage.x) + step.stage.c * velocity
    if equations.held and equations.integrator.handles_at_stage:
        there = equations.prescriptions.positions(step.start, step.end, step.at_stage, equations.x)
        step.prescribed.overwrite(position, there.take(step.prescribed.indices))
    (square,) = equations.points.global_sum(float(np.vdot(residual, residual)))
    return FailedSolve(
        tuple(iterations),
        float(np.sqrt(square)),
        step.at_stage,
        velocity,
        position,
        residual,
        dict(equations.forces_at_stage()),
        step.prescribed.mask[:n].copy(),
        int(snes.getConvergedReason()),
        int(ksp.getConvergedReason()),
        np.array(ksp.getConvergenceHistory()),
    )


def _remove_python_types(ksp: PETSc.KSP) -> None:
    """Change a KSP and its PC of Python type to types without Python; collective."""
    pc = ksp.getPC()
    if pc.getType() == PETSc.PC.Type.PYTHON:
        pc.setType(PETSc.PC.Type.NONE)
    if ksp.getType() == PETSc.KSP.Type.PYTHON:
        ksp.setType(PETSc.KSP.Type.PREONLY)


def _runs_foreign_python() -> bool:
    """Whether PETSc calls Python code of the user's."""
    options = PETSc.Options().getAll()
    return any(
        value != presets.PYTHON_TYPE for name, value in options.items() if name.endswith(PYTHON_SUFFIXES)
    )
