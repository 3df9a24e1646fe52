"""Static equilibrium at a load factor, by proximal steps: backward Euler from rest with growing Δτ.

A load step starts from the polynomial extrapolation of the last equilibria, with their stress in the first
Jacobian. Each solve minimises E(x) − W(x) + ‖x − x_k‖²_M / (2 Δτ²), whose Hessian is positive definite where
that of the shell alone is singular (flat, slack) or indefinite (buckling). Δτ grows while Newton's method
converges in few iterations, until the out-of-balance force is small without the last term. Loads that follow
the shape (pressure, moments, wind) are updated before every solve, under-relaxed; all but wind also change
during a solve with their own stiffness. Friction takes the normal forces of the solve before, as
`friction_balance` tells.

A snap takes many solves in which the out-of-balance force grows, while the potential energy falls. If a solve
in contact without friction runs out of iterations, the next one starts from its iterate of least energy; not
with friction, as solves whose friction lags behind normal forces may let sheets slide off.

Source: pseudo-transient continuation, Kelley & Keyes, SIAM J. Numer. Anal. 35 (1998) 508-523.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.scene.schema import Solver
from lyra_petsc.stepping import motion_limits as limits
from lyra_petsc.stepping.active_terms import Frozen
from lyra_petsc.stepping.directors import transport_frames
from lyra_petsc.stepping.integrators.static import Static
from lyra_petsc.stepping.newton.newton_trace import FailedSolve
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.statics.descent import EquilibriumReport, descend
from lyra_petsc.stepping.statics.force_balance import ForceBalance
from lyra_petsc.stepping.statics.friction_balance import FrictionBalance
from lyra_petsc.stepping.statics.load_step_progress import LoadStepProgress
from lyra_petsc.stepping.statics.path_prediction import PathPrediction
from lyra_petsc.stepping.statics.pseudo_time import LEAP_ITERATIONS, PseudoTimeStep
from lyra_petsc.stepping.statics.relaxation import Relaxation
from lyra_petsc.stepping.statics.stability import Examination, Stability
from lyra_petsc.stepping.stepper import Attempt, Stepper

if TYPE_CHECKING:
    from lyra_petsc.stepping.statics.whole_stiffness import WholeStiffness

MAX_SOLVES = 100
"""Largest number of proximal steps in a load step."""

PATIENCE = 15
"""A load step is given up after so many proximal steps without progress."""

MAX_FAILURES = 8
"""Number of proximal steps after which a load step is given up if none has converged."""

MAX_DISPLACEMENT = 1e3
"""Displacement in a load step, over the size of the mesh, beyond which there is no equilibrium."""

MAX_IN_VAIN = 60
"""Number of proximal steps without progress since the last equilibrium after which smaller increments are
not tried."""

MAX_RESUMED = 3
"""Number of leaps in a load step that are resumed where they ended: a snap may take more iterations."""

HARD_STEP = 14
"""After a load step with more Newton iterations, the next one begins with `WholeStiffness`."""

WORSE = 2.0
"""Δτ is reduced after a solve in which the out-of-balance force grows by more than this factor."""


class Equilibrium:
    """Finds the equilibrium at one load factor after another; collective.

    Parameters
    ----------
    equations : StageEquations
        With the integrator `Static`; its positions are the start shape.
    stepper : Stepper
    tolerances : Solver
    spacing, size : float
        Mean edge length [m] and diagonal of the bounding box [m].
    floor : float
        Norm [N] of the residual's round-off.
    end : float
        Load factor at the end of the run.
    """

    def __init__(
        self,
        equations: StageEquations,
        stepper: Stepper,
        tolerances: Solver,
        spacing: float,
        size: float,
        floor: float,
        end: float,
    ) -> None:
        assert isinstance(equations.integrator, Static)
        self._equations, self._stepper, self._integrator = equations, stepper, equations.integrator
        self._size = size
        self._whole_first = False  # whether the next load step begins with it
        self._in_vain = 0
        self._balance = ForceBalance(equations, tolerances.force_tolerance, floor)
        self._friction = FrictionBalance(equations, spacing, end)
        self._whole_stiffness: WholeStiffness | None = None
        if equations.active.following:
            from lyra_petsc.stepping.statics.whole_stiffness import (
                WholeStiffness,  # needed with loads that follow the shape only
            )

            zero = self._balance.is_zero
            self._whole_stiffness = WholeStiffness(equations, stepper.tangent, self._examine, zero)
        self._prediction = PathPrediction(equations, stepper.tangent, self._whole_stiffness, spacing)
        self._pseudo_time = PseudoTimeStep(
            self._integrator,
            spacing,
            leaps=not equations.active.viscous,
            contact=equations.contact is not None,
            factors=stepper.solver.linear.factors,
        )
        self._follows = bool(equations.active.viscous or equations.active.following)
        force = start_force(equations)
        self._balance.scale = self._balance.norm(force)
        # if the sheet slides, forces that hold its start shape would push it along
        held = not equations.near
        if held and self._balance.scale > floor and not self._unstable():
            equations.take_loads(unbalanced=-force)

    def _unstable(self) -> bool:
        """Whether the start shape with the forces that hold it is unstable, as if compressed; collective.

        Reducing these forces step by step would then lead to a distant folded shape. Without them the first
        solve finds the nearest equilibrium.
        """
        with self._examine() as examination:
            return examination.stability.stable is False

    def _examine(self) -> Examination:
        return Examination(self._equations, self._size)

    def attempt(self, before: float, factor: float, *, limited: bool = True) -> Attempt:
        """Find the equilibrium at load factor ``factor``; on failure the state is restored; collective.

        ``limited``: it counts as a failure if much lands in a large increment.
        """
        whole = self._by_whole_stiffness(before, factor) if self._whole_first else None
        if whole is not None:
            return whole
        attempt = self._by_proximal_steps(before, factor, limited=limited)
        hard = not attempt.converged or attempt.newton_iterations > HARD_STEP
        if not (attempt.converged or self._whole_first or self._stepper.solver.stopped_by):
            whole = self._by_whole_stiffness(before, factor)
        self._whole_first = hard
        if whole is None:
            return attempt
        newton = whole.newton_iterations + attempt.newton_iterations
        return dataclasses.replace(
            whole, newton_iterations=newton, linear_iterations=attempt.linear_iterations
        )

    def _by_whole_stiffness(self, before: float, factor: float) -> Attempt | None:
        """Find the equilibrium by Newton's method with the whole stiffness; collective."""
        if self._whole_stiffness is None:
            return None
        guess = self._prediction.extrapolated(before, factor)
        attempt = self._whole_stiffness.find(before, factor, guess)
        if attempt is not None:
            self._record(factor)
        return attempt

    def _by_proximal_steps(self, before: float, factor: float, *, limited: bool) -> Attempt:
        """Find the equilibrium as described at the top of the module; collective."""
        equations, friction = self._equations, self._friction
        x = equations.x[: equations.points.n_owned].copy()
        progress, relaxation = LoadStepProgress(before, factor, x), Relaxation(equations.points.comm)
        judges_energy = equations.contact is not None and self._is_held()
        self._integrator.predicted = self._prediction.extrapolated(before, factor) - x
        self._pseudo_time.begin_load_step()
        friction.begin_step()
        attempt = Attempt(False, 0, 0, 0.0)
        while True:
            force, fastest = self._balance.at_start(before, factor)
            if not progress.solves:
                self._pseudo_time.start(fastest)
                self._integrator.alternatives = self._prediction.along_tangent(before, factor)
                frozen = equations.step.frozen
            progress.record_force(force, attempt.linear_iterations if progress.solves else None)
            if progress.solves and judges_energy:
                progress.record_potential(self._potential_energy(x))
            balanced = progress.solved_once and self._balance.is_zero(force, progress.last_force)
            settled = friction.is_rough or (balanced and friction.is_settled())
            if settled:
                friction.judge_landing(factor - before, limited=limited)
            if friction.lands:
                message = "much landed in the increment"
                break
            if settled:
                friction.record_success(factor - before)
                self._record(factor)
                self._pseudo_time.sufficed = self._integrator.pseudo_dt
                progress.linear += self._prediction.compute_tangent(x, before, factor)
                roundoff = attempt.at_roundoff
                return Attempt(True, progress.newton, progress.linear, force, at_roundoff=roundoff)
            message = self._failure_message(progress)
            if friction.keeps_first_state(failed=bool(message) or not attempt.converged):
                continue
            if message:
                break
            if attempt.converged:
                if force > WORSE * progress.last_force:
                    self._pseudo_time.shrink()
                friction.accept_substep()
            progress.last_force = force
            if balanced:  # except for friction
                progress.restart()
                progress.last_force, fastest = self._balance.at_start(before, factor)
                self._pseudo_time.restart(fastest)
            if self._follows:
                progress.linear += self._update_loads(relaxation, progress)
            attempt, goes_on = self._solve(relaxation, progress)
            if not goes_on:
                break
        return self._give_up(progress, attempt, message, frozen)

    def _update_loads(self, relaxation: Relaxation, progress: LoadStepProgress) -> int:
        """Set the loads of the next solve to those of the present shape, with their stiffness.

        Returns linear iterations; collective.
        """
        equations, now = self._equations, self._equations.step.loads.force.copy()
        if self._whole_stiffness is None:
            equations.take_loads(override=relaxation.relax(now))
            return 0
        step = progress.before, progress.factor
        loads = self._whole_stiffness.linearise_loads(*step)
        displacement, iterations = None, 0
        if equations.active.viscous:  # the wind's stiffness is not known
            pass
        elif progress.solves:
            displacement, iterations = self._whole_stiffness.tangent(equations.out_of_balance(), loads)
        elif self._integrator.alternatives:
            displacement = self._prediction.linear_displacement(*step)
        if displacement is None:
            now = relaxation.relax(now)
        else:
            now = now + self._whole_stiffness.skew_force(loads, displacement)
        equations.take_loads(override=now, following=loads)
        return iterations

    def _is_held(self) -> bool:
        """Whether handles hold vertices, and loads have a potential: it is then bounded below; collective."""
        equations = self._equations
        springs = any(not term.registration.of_contact for term in equations.active.external)
        holds = springs or len(equations.step.prescribed.indices) > 0
        return not self._follows and any(equations.points.global_max(float(holds)))

    def _potential_energy(self, start: Array) -> float:
        """Energy [J] without friction, less the work of loads from ``start`` (n_owned, 3); collective."""
        equations, frozen = self._equations, self._equations.here().frozen
        terms = [term for term in equations.active.elastic if term not in equations.active.sliding]
        energy = sum(float(term.energies(equations.x, frozen[term]).sum()) for term in terms)
        energy -= float(np.vdot(equations.step.loads.force, equations.x[: len(start)] - start))
        return float(equations.points.global_sum(energy)[0])

    def _solve(self, relaxation: Relaxation, progress: LoadStepProgress) -> tuple[Attempt, bool]:
        """Take a proximal step and set the next Δτ; returns whether there is to be a next one; collective.

        A step in which friction lags too far behind normal forces does not count as converged.
        """
        equations, leap = self._equations, self._pseudo_time.is_leap
        begin = equations.x[: equations.points.n_owned].copy()
        attempt = self._proximal_step(progress, LEAP_ITERATIONS if leap else None)
        if self._follows:
            relaxation.record(equations.step.loads.force_at(equations.x))
        equations.take_loads(override=None, following=None)
        self._integrator.predicted, self._integrator.alternatives = None, []
        progress.count(attempt)
        lags = attempt.converged and self._friction.lags(begin)
        if lags and self._pseudo_time.shorten_to_repeat():
            equations.state.set(begin, np.zeros_like(begin))
            return dataclasses.replace(attempt, converged=False), True
        if attempt.converged:
            if not progress.solved_once:  # the force before is smaller if handles move
                progress.restart()
            progress.solved_once = True
            transport_frames(equations)  # edges may turn far until they are in equilibrium
            self._pseudo_time.record_success(attempt.newton_iterations)
        elif leap and progress.resumed < MAX_RESUMED and self._resume_from_lowest(attempt):
            progress.resumed += 1
        elif leap:
            self._pseudo_time.record_failed_leap(first=not progress.solved_once)
        elif self._stepper.solver.linear_failed or self._stepper.solver.stopped_by:
            return attempt, False
        else:
            if equations.contact is not None:
                self._resume_from_lowest(attempt)
            self._pseudo_time.record_failure()
        return attempt, True

    def _proximal_step(self, progress: LoadStepProgress, limit: int | None) -> Attempt:
        """One proximal step; ``limit`` bounds Newton iterations, and then also displacements; collective."""
        snes, convergence = self._stepper.solver.snes, self._stepper.solver.convergence
        maximum = snes.getTolerances()[3]
        snes.setTolerances(max_it=min(maximum, limit or maximum))
        convergence.max_displacement = self._size if limit else np.inf
        attempt = self._stepper.attempt(progress.before, progress.factor)
        snes.setTolerances(max_it=maximum)
        convergence.max_displacement = np.inf
        return attempt

    def _resume_from_lowest(self, attempt: Attempt) -> bool:
        """Set the state to the iterate of least energy of a solve that ran out of iterations; collective.

        Returns whether it did: the energy must have fallen. Not with loads that follow the shape, nor with
        friction, whose forces do not follow the normal forces in a solve: sheets might slide off.
        """
        equations = self._equations
        ran_out = attempt.newton_iterations >= LEAP_ITERATIONS
        if not ran_out or self._follows or limits.has_friction_pairs(equations):
            return False
        lowest = self._stepper.lowest_energy_positions()
        if lowest is None:
            return False
        equations.state.set(lowest, np.zeros_like(lowest))
        transport_frames(equations)
        return True

    def _give_up(self, progress: LoadStepProgress, attempt: Attempt, message: str, frozen: Frozen) -> Attempt:
        """Restore the state at the start of a load step, with frames ``frozen``; collective."""
        equations, x, increment = self._equations, progress.start, progress.factor - progress.before
        slides = self._friction.record_failure(increment) if message and progress.solved_once else ""
        self._pseudo_time.sufficed = 0.0
        if progress.solved_once and not self.lands:
            self._in_vain += progress.solves - progress.last_by_force
        stuck = attempt.failed_solve or _failed_solve(equations, progress)
        equations.state.set(x, equations.v[: len(x)])
        transport_frames(equations, frozen)
        equations.active.restore_contacts(self._friction.contacts)
        message = f"{message}; {slides}" if slides else attempt.message or message
        return dataclasses.replace(
            attempt,
            converged=False,
            newton_iterations=progress.newton,
            linear_iterations=progress.linear,
            message=message,
            failed_solve=stuck,
        )

    def settle(self, before: float, factor: float) -> EquilibriumReport:
        """Leave the equilibrium just found along its lowest mode while it is unstable; collective."""

        def attempt() -> Attempt:
            self._pseudo_time.sufficed = 0.0
            return self.attempt(before, factor, limited=False)

        def skew_part_stabilises(stability: Stability, mode: Array) -> bool:
            whole = self._whole_stiffness
            return whole is not None and whole.skew_part_stabilises(stability, mode, factor)

        step, note = (before, factor), self._friction.note
        return descend(self._equations, step, self._size, attempt, skew_part_stabilises, note)

    def forget_path(self) -> None:
        """Predict no shape from the equilibria so far: something has changed."""
        self._prediction.forget()

    def saved_state(self, factor: float) -> tuple[dict[str, Array], dict[str, Any]]:
        """Arrays (n_owned, 3) and numbers of a checkpoint at the equilibrium at ``factor``; collective."""
        arrays, past = self._prediction.saved_state(factor)
        numbers = {"scale": self._balance.scale, "in_vain": self._in_vain}
        numbers |= {"sufficed": self._pseudo_time.sufficed} | self._friction.saved_state()
        return arrays, numbers | {"extrapolation": past}

    def restore(self, arrays: Mapping[str, Array], saved: Mapping[str, Any], factor: float) -> None:
        """Restore a `saved_state`."""
        self._balance.scale, self._in_vain = saved["scale"], saved["in_vain"]
        self._friction.restore(saved)
        self._pseudo_time.sufficed = saved["sufficed"]
        self._prediction.restore(arrays, saved["extrapolation"], factor)

    @property
    def lands(self) -> bool:
        """Whether the last load step is to be repeated with a smaller increment, as much landed in it."""
        return self._friction.lands

    @property
    def in_vain(self) -> bool:
        """Whether attempts since the last equilibrium show that a smaller increment would not help."""
        return self._in_vain >= MAX_IN_VAIN or self._friction.in_vain

    def _failure_message(self, progress: LoadStepProgress) -> str:
        """Why no further proximal step is taken, or an empty string; collective."""
        solves = progress.solves
        if not progress.solved_once:
            return "no proximal step was found" if solves >= MAX_FAILURES else ""
        start, equations = progress.start, self._equations
        moved = float(np.abs(equations.x[: len(start)] - start).max(initial=0.0))
        moved = equations.points.comm.allreduce(moved, MPI.MAX)
        if moved > MAX_DISPLACEMENT * self._size:
            return f"no equilibrium within {moved:.1g} m of the start, as if nothing held the sheet"
        idle = solves - progress.last
        if idle >= PATIENCE:
            return f"no equilibrium: the last {idle} of {solves} proximal steps came no nearer"
        return f"no equilibrium within {solves} proximal steps" if solves >= MAX_SOLVES else ""

    def _record(self, factor: float) -> None:
        """Record that the present state is the equilibrium at load factor ``factor``; collective."""
        self._in_vain = 0
        self._balance.record()
        self._prediction.record(factor)


def start_force(equations: StageEquations) -> Array:
    """Force (n_owned, 3) [N] of the start shape on its free unknowns, without loads; collective."""
    equations.begin_step(0.0, 0.0)
    loads = np.where(equations.step.prescribed.free, equations.step.loads.force, 0.0)
    return equations.out_of_balance() - loads


def _failed_solve(equations: StageEquations, progress: LoadStepProgress) -> FailedSolve:
    """The state that the proximal steps have reached; collective."""
    equations.begin_step(progress.before, progress.factor)
    force, loads = equations.out_of_balance(), equations.step.loads.force
    n = len(force)
    return FailedSolve(
        iterations=tuple(progress.history),
        norm=float(np.sqrt(equations.points.global_sum(float(np.vdot(force, force)))[0])),
        time=progress.factor,
        velocity=np.zeros_like(force),
        position=equations.x[:n].copy(),
        residual=-force,
        forces={"loads": -loads, "internal": loads - force},
        prescribed=equations.step.prescribed.mask[:n].copy(),
        snes_reason=0,
        ksp_reason=0,
        linear_residuals=np.empty(0),
    )
