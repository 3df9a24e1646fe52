"""The stepper: owns PETSc's TS, SNES, KSP and Mat of a run, and makes one attempt at a step."""

from __future__ import annotations

import math
import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.linear import failed_factors, presets, reasons
from lyra_petsc.linear.hierarchy import Surface
from lyra_petsc.linear.petsc_options import (
    PYTHON_SUFFIXES,
    Value,
    culprits,
    fill_gaps,
    is_set,
    of_user,
    quoted,
    refused,
)
from lyra_petsc.parallel import all_ranks_arrive
from lyra_petsc.phases import FROZEN, RESIDUAL, logged
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping import contact_steps, edge_solve
from lyra_petsc.stepping import motion_limits as limits
from lyra_petsc.stepping.directors import turn_with_triangles, update_frames
from lyra_petsc.stepping.edge_solve import EdgeSolve
from lyra_petsc.stepping.newton.blend import HessianBlend
from lyra_petsc.stepping.newton.conditioning import expected_iterations
from lyra_petsc.stepping.newton.convergence import Convergence
from lyra_petsc.stepping.newton.extrapolation import Extrapolation
from lyra_petsc.stepping.newton.inexact import LOOSEST, ONCE, ONCE_IN_CONTACT, STATIC
from lyra_petsc.stepping.newton.initial_guess import first_guess, has_start
from lyra_petsc.stepping.newton.iterates import Iterates
from lyra_petsc.stepping.newton.linear_system import LinearSystem
from lyra_petsc.stepping.newton.newton_trace import FailedSolve, Trace
from lyra_petsc.stepping.newton.snes_callbacks import NewtonCallbacks
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.time_step import Evaluation
from lyra_petsc.stepping.ts_options import hidden_options


@dataclass(frozen=True)
class Attempt:
    """Outcome of one attempt at a step.

    Attributes
    ----------
    residual : float
        Norm [N] of the last residual.
    remaining : float
        Estimated displacement [m] of further Newton iterations.
    message : str
        Why the attempt failed; else empty.
    at_roundoff : bool
        Whether the solve ended because the residual was round-off.
    failed_solve : FailedSolve or None
        The last iterate and residual of a failed attempt.
    """

    converged: bool
    newton_iterations: int
    linear_iterations: int
    residual: float
    remaining: float = math.inf
    message: str = ""
    at_roundoff: bool = False
    failed_solve: FailedSolve | None = None


FIRST_DT_FRACTION = 1e-3
"""First Δt of an adaptive run over its length; the error estimate corrects it at once."""

MAX_SOLVES = 8
"""Largest number of solves of a step in which friction takes the contacts that the one before has found."""

BEYOND_LIMIT = "the handles would stretch the sheet beyond material.stretch_limit"
"""Message of an attempt whose prescribed motion leaves no start within the limits of all terms."""

WOULD_CROSS = "something would pass through the sheet"
"""Message of an attempt whose step would lead through a contact."""


class Stepper:
    """Solves each step's stage equations by TSBEULER or TSTHETA.

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

    Attributes
    ----------
    ts, snes, ksp : PETSc objects
        Without options prefix.
    linear : LinearSystem
        The matrices.
    preset : str
        Name of the linear solver in use.
    presets : list of str
        The linear solver in use and those to try next if it breaks down.
    our_options : list of str
        Options that this class set because the user did not.

    Raises
    ------
    InputError
        For options that PETSc refuses.
    """

    def __init__(
        self, scene: Scene, equations: StageEquations, surface: Surface, spacing: float, floor: float
    ) -> None:
        self._scene, self._equations, self._surface = scene, equations, surface
        self._spacing, self._floor = spacing, floor
        self._iterates = equations.integrator.iterates
        # presets and state of Newton's method, while another integrator replaces the scene's
        self._suspended: tuple[list[str], dict[str, float]] | None = None
        points = equations.points
        self.presets = self._candidates()
        self._blend = HessianBlend(self._hessian)
        self.our_options: list[str] = []
        self._filled: list[str] = []
        self._linear_failed = False
        self._shape = (points.n_owned, 3)
        self._extrapolation = Extrapolation(points.comm)
        self._create_objects()

    # -- objects -------------------------------------------------------------------------------------

    def _candidates(self) -> list[str]:
        """Linear solvers to try in order; collective."""
        equations, scene, points = self._equations, self._scene, self._equations.points
        step = 0.0 if scene.time.step == "auto" else scene.time.step
        static = scene.time.scheme == "static"
        return presets.candidates(
            points.n_vertices_global if static else points.n_global,  # edges hardly enlarge the factors
            points.comm.size,
            static=static,
            newton=self._iterates,
            iterations=0.0 if static else expected_iterations(equations, step),
            contact=equations.contact is not None,
        )

    @property
    def _hessian(self) -> str:
        return self._scene.solver.hessian if self._iterates else "regularised"

    def follow_integrator(self) -> None:
        """Change between Newton's method and one linear solve as the integrator demands; collective."""
        if self._equations.integrator.iterates == self._iterates:
            return
        time, step = self.ts.getTime(), self.ts.getStepNumber()
        suspended, saved = self._suspended, self._newton.saved_state()
        self.destroy()
        self._iterates = not self._iterates
        self._blend = HessianBlend(self._hessian)
        if suspended is None:
            self._suspended, self.presets = (self.presets, saved), self._candidates()
        else:
            self._suspended, (self.presets, saved) = None, suspended
        self._create_objects()
        if suspended is not None:
            self._newton.restore(saved)
        self.start(time, step)

    def _create_objects(self) -> None:
        equations, scene = self._equations, self._scene
        points = equations.points
        self.preset = self.presets[0]
        self._fill(presets.options_of(self.preset, points.comm.size))
        self.linear = LinearSystem(
            equations, self._surface, self.preset, scene.solver.hessian, iterates=self._iterates
        )
        self.velocity = PETSc.Vec().create(points.comm)
        self.velocity.setSizes((3 * points.n_owned, 3 * points.n_global), bsize=3)
        self.velocity.setType(PETSc.Vec.Type.MPI if points.comm.size > 1 else PETSc.Vec.Type.SEQ)
        self.residual = self.velocity.duplicate()
        self.ts = ts = PETSc.TS().create(points.comm)
        ts.setProblemType(PETSc.TS.ProblemType.NONLINEAR)
        ts.setType(equations.integrator.ts_type)
        if equations.integrator.ts_type == "theta":
            ts.setTheta(0.5)
        ts.setIFunction(self._ifunction, self.residual)
        self._set_jacobian()
        ts.setMaxTime(scene.time.end)
        ts.setTimeStep(FIRST_DT_FRACTION * scene.time.end if scene.time.step == "auto" else scene.time.step)
        ts.setMaxSteps(np.iinfo(PETSc.IntType).max - 1)
        ts.setMaxSNESFailures(1)
        ts.setErrorIfStepFails(False)
        ts.setExactFinalTime(PETSc.TS.ExactFinalTime.STEPOVER)
        self.snes = snes = ts.getSNES()
        self.ksp = ksp = snes.getKSP()
        snes.setInitialGuess(self._guess)
        limit = presets.break_even_iterations(points.n_global, self.presets)
        convergence = Convergence(
            equations, scene.solver, self._spacing, self._floor, break_even_iterations=limit
        )
        self._points = Iterates(equations)
        self._newton = newton = NewtonCallbacks(
            snes,
            equations,
            self.linear,
            self._blend,
            convergence,
            self._points,
            iterates=self._iterates,
            follow=self._follow_stencils,
        )
        ksp.setType(PETSc.KSP.Type.CG)
        self._trace = Trace(snes, equations, lambda: newton.linear_iterations)
        if equations.discretisation.stencils_change or (equations.active.with_edges and self._iterates):
            snes.setUpdate(self._update)
        if PETSc.Options().getBool("contact_monitor", False) and equations.contact is not None:
            from lyra_petsc.contact.contact_monitor import ContactMonitor  # needed with the option only

            snes.setMonitor(
                ContactMonitor(
                    equations.contact,
                    lambda v: (equations.evaluate(v).x, equations.step.frozen),
                    lambda: newton.step_fraction,
                )
            )
        if self._iterates:
            snes.setMonitor(self._trace.monitor)
            snes.setType(PETSc.SNES.Type.NEWTONLS)
            snes.setObjective(newton.globalisation.objective)
            # shown by -snes_view, and compared with what options set. PETSc accepts only rtol < 1
            rtol, stol = min(scene.solver.force_tolerance, 0.99), scene.solver.step_tolerance
            snes.setTolerances(rtol=rtol, atol=self._floor, stol=stol, max_it=scene.solver.max_iterations)
            snes.setConvergenceTest(newton.converged)
            snes.setLineSearchPreCheck(newton.correct_direction)
            # an indefinite Hessian costs an iteration, not the step
            snes.setMaxKSPFailures(scene.solver.max_iterations)
            ksp.setTolerances(rtol=LOOSEST if equations.integrator.dynamic else STATIC, max_it=5000)
        else:
            snes.setType(PETSc.SNES.Type.KSPONLY)
            ksp.setTolerances(rtol=ONCE, max_it=5000)
            ksp.setInitialGuessNonzero(True)
        # objects that PETSc frees after Python has ended must not call Python
        self._at_exit = weakref.finalize(self, _remove_python_types, ksp)
        try:
            self.velocity.setFromOptions()
            with hidden_options():
                ts.setFromOptions()
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
        ts.setSolution(self.velocity)

    def _set_jacobian(self) -> None:
        self.ts.setIJacobian(self._ijacobian, self.linear.operator.mat, self.linear.preconditioner.mat)

    def _update(self, snes: PETSc.SNES, iteration: int) -> None:
        """Update stencils and frames before a Newton iteration; collective."""
        if iteration > 0 and update_frames(self._equations, self._points.at(snes.getSolution()).x):
            snes.computeFunction(snes.getSolution(), snes.getFunction()[0])
            self._newton.globalisation.begin_solve()
        self._follow_stencils()

    def _follow_stencils(self) -> bool:
        """Renew the matrices if stencils have changed; return whether they have; collective."""
        if not self.linear.update_pattern():
            return False
        self._set_jacobian()
        return True

    def _fill(self, options: Mapping[str, Value]) -> None:
        self._filled = fill_gaps(options)
        self.our_options += [name for name in self._filled if name not in self.our_options]

    def next_preset(self) -> str | None:
        """Change to the next linear solver and return its name, or None if none is left; collective."""
        if len(self.presets) < 2:
            return None
        time, step = self.ts.getTime(), self.ts.getStepNumber()
        self.destroy()
        self.presets.pop(0)
        self._create_objects()
        self.start(time, step)
        return self.preset

    def destroy(self) -> None:
        """Free all PETSc objects and remove the options that were filled in; collective."""
        database = PETSc.Options()
        for name in self._filled:
            database.delValue(name)
        self._at_exit()
        self._newton.destroy()
        self.ts.destroy()
        self.linear.destroy()
        self.velocity.destroy()
        self.residual.destroy()

    # -- a step ----------------------------------------------------------------------------------------

    def start(self, time: float, step: int) -> None:
        """Set time [s] and step number, and take the velocities from the equations' state."""
        self.ts.setTime(time)
        self.ts.setStepNumber(step)
        self.velocity.setArray(self._equations.v[: self._shape[0]].ravel())

    def attempt(self, t0: float, t1: float) -> Attempt:
        """Try the step from t0 to t1 [s]; the state changes only on success; collective."""
        equations = self._equations
        self._record(t0)
        with PETSc.Log.Event(FROZEN):
            equations.begin_step(t0, t1)
        number = self.ts.getStepNumber()
        before = equations.x[: self._shape[0]].copy() if edge_solve.is_needed(equations) else None
        rate_before = equations.v[: self._shape[0]].copy() if before is not None else None
        failed: FailedSolve | None = None
        start, blocked = limits.find_start(equations), ""
        if start is None or not has_start(equations, start):
            blocked = WOULD_CROSS if start is None else BEYOND_LIMIT
        if blocked:
            self._trace.begin_solve()
            failed = self._trace.failed_solve(equations.stationary_velocity())
            return Attempt(False, 0, 0, math.inf, message=blocked, failed_solve=failed)
        n = self._shape[0]
        solution, message = self._solve(t0, start)
        newton = linear = 0
        for _ in range(MAX_SOLVES - 1):
            if solution is None or not (
                self._iterates and contact_steps.follow_contacts(equations, solution)
            ):
                break
            newton, linear = newton + self.snes.getIterationNumber(), linear + self._newton.linear_iterations
            solution, message = self._solve(t0, start, solution.v[:n])
        if solution is not None and not limits.end_is_free(equations, solution.v[:n]):
            solution, message = None, WOULD_CROSS
        newton, linear = newton + self.snes.getIterationNumber(), linear + self._newton.linear_iterations
        outcome = self._newton.convergence
        ended = outcome.norm, outcome.remaining, outcome.at_roundoff
        if solution is not None:
            if not self._iterates and equations.active.with_edges:
                solution = self._turn_directors(solution)
            equations.accept(solution)
            if before is not None:
                assert rate_before is not None
                edges = EdgeSolve.begin(equations, before)
                rates, message = self._solve(t0)
                newton, linear = (
                    newton + self.snes.getIterationNumber(),
                    linear + self._newton.linear_iterations,
                )
                if rates is None:
                    failed, solution = self._trace.failed_solve(), None
                edges.end(equations, rates)
                if rates is None:
                    equations.state.set(before, rate_before)
        else:
            failed = self._trace.failed_solve()
        self.ts.setTimeStep(t1 - t0)
        if solution is not None:
            self.velocity.setArray(equations.v[: self._shape[0]].ravel())
            self.ts.setTime(t1)
            self.ts.setStepNumber(number + 1)
            norm, remaining, at_roundoff = ended
            return Attempt(True, newton, linear, norm, remaining, at_roundoff=at_roundoff)
        self.ts.setTime(t0)
        self.ts.setStepNumber(number)
        self.ts.setConvergedReason(PETSc.TS.ConvergedReason.CONVERGED_ITERATING)
        finite = self.ksp.getConvergedReason() != PETSc.KSP.ConvergedReason.DIVERGED_NANORINF
        too_old = self.linear.reuse.reused and self._linear_failed and finite
        if not self._iterates and (
            failed_factors.replace_failed(self.ksp) or self.linear.shift.increase() or too_old
        ):
            self.linear.reuse.discard()
            return self.attempt(t0, t1)
        return Attempt(False, newton, linear, outcome.norm, message=message, failed_solve=failed)

    def _turn_directors(self, solution: Evaluation) -> Evaluation:
        """The solution, whose directors turn with their triangles if they turn far; collective."""
        equations, staying = self._equations, self._equations.stationary_velocity()
        increment = solution.v[: len(staying)] - staying
        if turn_with_triangles(equations, staying, increment):
            solution = equations.evaluate(staying + increment)
        update_frames(equations, solution.x)
        return solution

    def balance_edge_moments(self, floor: float) -> bool:
        """Solve for edge unknowns until moments on edges balance at the start shape, to ``floor`` [N];
        return whether they do; collective.
        """
        equations, n = self._equations, self._shape[0]
        before = np.inf
        while floor < (moments := edge_solve.initial_moments(equations)) < before:
            before = moments if not self._iterates else 0.0
            edges = EdgeSolve.begin(equations, equations.x[:n].copy())
            rates, _ = self._solve(equations.step.start)
            edges.end(equations, rates)
            self.start(equations.step.start, 0)
            if rates is None:
                return False
        return True

    def _solve(
        self, t0: float, start: Array | None = None, found: Array | None = None
    ) -> tuple[Evaluation | None, str]:
        """The evaluation that solves the present stage, or None and why; collective.

        ``start``, by default where the step starts, are velocities (n_owned, 3) [m/s] that no collision
        hinders; ``found`` those of a solve of the stage with other contacts, where this one starts.
        """
        equations, stage = self._equations, self._equations.step.stage
        if start is None:
            equations.prescribe(start := equations.stationary_velocity())
        self._starts = start, found
        self._follow_stencils()
        self.velocity.setArray(equations.step.v_h.ravel())
        # a TS step whose stage is at the integrator's time and whose shift is the integrator's σ
        theta = 0.5 if self.ts.getType() == "theta" else 1.0
        length = 1.0 / (theta * stage.sigma)
        self.ts.setTime(t0 + stage.offset - theta * length)
        self.ts.setTimeStep(length)
        self._newton.begin_solve()
        if not self._iterates and not is_set("ksp_rtol"):
            self.ksp.setTolerances(rtol=ONCE_IN_CONTACT if equations.near else ONCE)
        self._trace.begin_solve()
        try:
            self.ts.step()
        except Exception as error:
            if not isinstance(error, PETSc.Error) and not _runs_foreign_python():
                raise
            together = all_ranks_arrive(equations.points.comm)
            if together and self._next_may_help(error):
                self._linear_failed = True
                return None, f"the preconditioner could not be set up: {reasons.error_message(error)}"
            kept = "the state before it" if together else "the last checkpoint (the other ranks work on)"
            raise SolverError(
                f"PETSc stopped in the step from t = {t0:g} s: {reasons.error_message(error)}; "
                f"{kept} is kept; check {culprits(error, self._filled)}",
                collective=together,
            ) from None
        self._linear_failed = False
        if not self._iterates:
            self.linear.reuse.end_solve(self.ksp.getIterationNumber())
        reason, known = self.snes.getConvergedReason(), PETSc.SNES.ConvergedReason
        if self._iterates and (reason > 0 or reason == known.DIVERGED_LINE_SEARCH):
            if not self._newton.convergence.accepts_last_iterate():
                self.snes.setConvergedReason(known.DIVERGED_LINE_SEARCH)
            elif reason < 0:
                self.snes.setConvergedReason(known.CONVERGED_FNORM_ABS)
                self.ts.setConvergedReason(PETSc.TS.ConvergedReason.CONVERGED_ITERATING)
        if self.ts.getConvergedReason() < 0 or self.snes.getConvergedReason() <= 0:
            slow = self._newton.convergence.too_slow
            self._linear_failed = slow or reasons.preconditioner_failed(self.ksp)
            if self.stopped_by:
                self._linear_failed = False
                return None, f"{self.stopped_by} stopped Newton's method short of solver.force_tolerance"
            return None, reasons.failure_reason(self.snes, self.ksp)
        reached = self.snes.getSolution()
        velocity = reached.getArray(readonly=True).reshape(self._shape)
        if equations.points.comm.allreduce(int(not np.isfinite(velocity).all())):
            return None, "the velocities are not finite"
        return self._points.at(reached) if self._iterates or equations.step.of_edges else equations.evaluate(
            velocity
        ), ""

    def _next_may_help(self, error: Exception) -> bool:
        """Whether an error of PETSc's on all ranks is one of this preset's set-up, not of a user's option,
        and another preset is left; collective.
        """
        blamed = of_user(quoted(error), self._filled)
        may_help = len(self.presets) > 1 and reasons.in_set_up(error) and not blamed
        return bool(self._equations.points.comm.allreduce(int(may_help), op=MPI.MIN))

    def saved_state(self, time: float) -> tuple[dict[str, Array], dict[str, Any]]:
        """Arrays (n_owned, 3) and numbers of a checkpoint at ``time`` [s]; collective."""
        arrays: dict[str, Array] = {}
        names, newton = self._suspended or (self.presets, self._newton.saved_state())
        numbers: dict[str, Any] = {"preset": names[0], **newton}
        self.linear.reuse.discard()  # a resumed run has no preconditioner to reuse, and must behave alike
        if self._record(time):
            arrays, numbers["extrapolation"] = self._extrapolation.saved_state()
        return arrays, numbers

    def _record(self, time: float) -> bool:
        """Record the velocities at ``time`` [s], where the scene's integrator extrapolates them, also while
        another one replaces it; return whether it does; collective.
        """
        extrapolates = not self._iterates or self._suspended is not None
        if extrapolates:
            self._extrapolation.record(time, self._equations.v[: self._shape[0]])
        return extrapolates

    def restore(
        self, arrays: Mapping[str, Array], numbers: Mapping[str, Any], time: float, step: int
    ) -> None:
        """Restore a `saved_state` for the state at ``time`` [s], after ``step`` steps; collective."""
        while numbers["preset"] in self.presets[1:]:
            self.next_preset()
        self._newton.restore(numbers)
        if not self._iterates:
            v = self._equations.v[: self._shape[0]]
            self._extrapolation.restore(arrays, numbers.get("extrapolation", {}), time, v)
        self.start(time, step)

    def tangent(self, force: Array) -> tuple[Array | None, int]:
        """Linear response (n_owned, 3) [m] to a small force (n_owned, 3) [N] at the end of the last solve, by
        its factors, or None without; and the number of linear iterations; collective.
        """
        return self._newton.tangent(force)

    def lowest_energy_positions(self) -> Array | None:
        """Positions (n_owned, 3) of the iterate of least energy in the last solve, or None if that is where
        Newton's method started; collective.
        """
        velocity = self._newton.globalisation.lowest_iterate()
        if velocity is None:
            return None
        positions: Array = self._equations.evaluate(velocity).x[: len(velocity)].copy()
        return positions

    @property
    def convergence(self) -> Convergence:
        """The convergence test of the nonlinear solves."""
        return self._newton.convergence

    @property
    def stopped_by(self) -> str:
        """The option that ended the last solve short of the scene's force tolerance; else empty."""
        return self._newton.convergence.stopped_by

    @property
    def linear_solver_failed(self) -> bool:
        """Whether the last failed attempt might succeed with another preconditioner."""
        return self._linear_failed

    def monitor(self) -> None:
        """Call the TS monitors that the user asked for; collective."""
        try:
            self.ts.monitor(self.ts.getStepNumber(), self.ts.getTime(), self.velocity)
        except PETSc.Error as error:
            asked = [f"-{name}" for name in PETSc.Options().getAll() if name.startswith("ts_monitor")]
            raise InputError(
                f"PETSc cannot: {reasons.error_message(error)}", key=" or ".join(sorted(asked))
            ) from None

    # -- callbacks ---------------------------------------------------------------------------------------

    @logged(RESIDUAL)
    def _ifunction(self, ts: PETSc.TS, t: float, u: PETSc.Vec, udot: PETSc.Vec, f: PETSc.Vec) -> None:
        v = u.getArray(readonly=True).reshape(self._shape)
        self._equations.forces.residual(v, self._points.at(u), f.getArray().reshape(self._shape))

    def _guess(self, snes: PETSc.SNES, u: PETSc.Vec) -> None:
        guess = u.getArray().reshape(self._shape)
        start, found = self._starts
        if found is not None:
            guess[:] = found
            return
        if first_guess(self._equations, start, guess):
            self._newton.curve_guess(self._equations.stationary_velocity(), start, guess)
        if not self._iterates:
            # the linear solve starts from the extrapolation; its tolerance stays relative to the full step
            equations = self._equations
            ahead = self._extrapolation.extrapolate(
                equations.step.end, equations.step.start, equations.v[: len(guess)]
            )
            equations.prescribe(ahead)
            snes.getSolutionUpdate().setArray((guess - ahead).ravel())

    def _ijacobian(
        self, ts: PETSc.TS, t: float, u: PETSc.Vec, udot: PETSc.Vec, shift: float, a: PETSc.Mat, p: PETSc.Mat
    ) -> bool:
        self._newton.assemble(u)
        if self._iterates:
            self._newton.globalisation.note_iterate(u)
        return True


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
