"""Stepping through a scene: one step after another, each until it is accepted; writes no files."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NoReturn

from mpi4py import MPI
from petsc4py import PETSc

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.kernels.compilation import COMPILATION
from lyra_petsc.linear.petsc_options import fill_gaps, unknown
from lyra_petsc.linear.refused_options import check_options, check_size
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.parallel import on_root
from lyra_petsc.phases import Phases
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.time_curve import kink_times
from lyra_petsc.stepping import motion_limits as limits
from lyra_petsc.stepping.accuracy import Accuracy
from lyra_petsc.stepping.compression_watch import CompressionWatch
from lyra_petsc.stepping.energy_balance import Budget, EnergyBalance
from lyra_petsc.stepping.energy_guard import EnergyGuard
from lyra_petsc.stepping.failure.failure_report import FailedAttempt, Failure
from lyra_petsc.stepping.newton.force_scales import residual_roundoff
from lyra_petsc.stepping.problem import Problem, build_problem, event_times
from lyra_petsc.stepping.recovery import RejectedStep, Trouble, recover
from lyra_petsc.stepping.resumption import resume, saved_state
from lyra_petsc.stepping.run_notes import RunNotes, events, note_of_repeats, note_step
from lyra_petsc.stepping.start_notes import nothing_acts
from lyra_petsc.stepping.statics.equilibrium import Equilibrium
from lyra_petsc.stepping.statics.stability import Stability
from lyra_petsc.stepping.step_control import LoadControl, ToleranceControl
from lyra_petsc.stepping.step_plan import planned_control
from lyra_petsc.stepping.stepper import Attempt, Stepper
from lyra_petsc.stepping.term_states import ElementState
from lyra_petsc.stepping.ts_options import with_ts_options
from lyra_petsc.terms.protocols import Dissipates


@dataclass
class StepReport:
    """One accepted step; ``remaining`` [m] is the estimated displacement of further Newton iterations."""

    step: int
    time: float
    dt: float
    newton_iterations: int
    linear_iterations: int
    rejected: int
    residual: float
    wall_seconds: float
    smallest_stretch: float = 1.0
    largest_stretch: float = 1.0
    remaining: float = math.inf


class SteppedScene:
    """Set up a scene and step through it; every method is collective.

    Parameters
    ----------
    comm : MPI.Comm
    scene : Scene
    phases : Phases, optional
        Collects wall time by phase.
    mesh : Mesh, optional
        The scene's mesh on rank 0, if it has been built already.
    owner : (V,), optional
        Rank of each vertex, on rank 0, if it is known already.
    stops : sequence of float
        Further times [s] at which a step must end.

    Attributes
    ----------
    scene : Scene
        With the integrator and the step control that PETSc's options choose.
    problem : Problem
    time : float
        [s]
    step_number : int
    roundoff : float
        Upper bound of round-off in the norm [N] of the residual.
    totals : dict of str to int
        Newton and linear iterations, and rejected attempts, of all steps.
    accuracy : Accuracy or None
        That of adaptive steps.
    equilibrium : Equilibrium or None
        The solver of a static analysis.
    run_notes : RunNotes
    stability : dict
        Static analysis: entries of summary.json on the last equilibrium.
    failure : Failure or None
        Why the last step could not be taken.
    last_integrator : Integrator
        The one that took the last step: the scene's, or one in its place.

    Raises
    ------
    InputError
        On all ranks, if the scene cannot be simulated.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        scene: Scene,
        phases: Phases | None = None,
        *,
        mesh: Mesh | None = None,
        owner: Ints | None = None,
        stops: Sequence[float] = (),
    ) -> None:
        self.comm, self.scene, self._mesh, self._owner, self._stops = comm, scene, mesh, owner, list(stops)
        self.phases = phases or Phases()
        COMPILATION.begins, COMPILATION.ends = self.phases.begin_compilation, self.phases.end_compilation
        self._filled = fill_gaps(scene.petsc)
        try:
            check_options()
            self.scene = with_ts_options(scene)
            self._set_up(self.scene)
        except BaseException:
            self._remove_filled_options()
            raise

    def _set_up(self, scene: Scene) -> None:
        self.problem: Problem = build_problem(self.comm, scene, self.phases, self._mesh, self._owner)
        self.run_notes = RunNotes()
        self.notes.extend(self.problem.whole.notes)
        whole, equations = self.problem.whole, self.problem.equations
        check_size(self.problem.points.n_unknowns)
        with self.phases("solve"):
            floor = residual_roundoff(equations.forces, whole.largest_coordinate)
            if not math.isfinite(floor):
                raise InputError(
                    "stiffness times size overflows; give smaller numbers or another unit of length",
                    file=scene.source,
                    key="material",
                )
            self.stepper = Stepper(scene, equations, self.problem.surface, whole.spacing, floor)
        self.notes.extend(on_root(self.comm, lambda: unknown(self.stepper.our_options)))
        self.roundoff = floor
        self.max_steps = self.stepper.solver.ts.getMaxSteps()
        changes = [*event_times(scene), *kink_times(scene)]
        self.control = planned_control(scene, self.stepper.solver.ts, [*changes, *self._stops])
        self.accuracy: Accuracy | None = None
        if isinstance(self.control, ToleranceControl):
            self.accuracy = Accuracy(equations, self.control, scene.time.tolerance or 0.0, whole.size)
            equations.start_acceleration.followers.append(self.accuracy.local_error)
        self.time, self.step_number = 0.0, 0
        self.compression = CompressionWatch(self.problem)
        self.stability: dict[str, Any] = {}
        if scene.time.analysis == "static":
            self.stability = Stability(reason="the end is not reached").content
        self.totals = {"newton_iterations": 0, "linear_iterations": 0, "rejected": 0}
        self.failure: Failure | None = None
        self.stepper.start(0.0, 0)
        if self.problem.points.n_edges_global and not self.stepper.balance_edge_moments(floor):
            self.notes.append("the moments on the edges of the start shape do not balance")
        for term in equations.active.stateful:
            if isinstance(term, Dissipates):  # whose rest state has edges in equilibrium
                term.initialise(equations.x)
        start = equations.here()
        self.notes.extend(nothing_acts(scene, start, changes, self.control.end, floor))
        self.equilibrium: Equilibrium | None = None
        if scene.time.static:
            sizes = whole.spacing, whole.size, floor, self.control.end
            self.equilibrium = Equilibrium(equations, self.stepper, scene.solver, *sizes)
        self.energy_balance = EnergyBalance(equations)
        drift = scene.initial.velocity if scene.initial else (0.0, 0.0, 0.0)
        self.guard = EnergyGuard(equations, drift) if equations.integrator.dynamic else None

    @property
    def notes(self) -> list[str]:
        """Messages to the user: mesh repairs, changed linear solver, …"""
        return self.run_notes.texts

    @property
    def note_of_repeats(self) -> str:
        """How many attempts so far were repeated with a smaller step, and why; empty if none was."""
        return note_of_repeats(self)

    @property
    def budget(self) -> Budget:
        """Energies of the present state and works up to it."""
        return self.energy_balance.budget

    @property
    def finished(self) -> bool:
        """Whether the end of the scene, or ``-ts_max_steps``, is reached."""
        return self.at_end or self.step_number >= self.max_steps

    @property
    def at_end(self) -> bool:
        """Whether the end of the scene is reached."""
        return self.control.is_end(self.time)

    def step(self) -> StepReport:
        """Take one step, repeated as `recovery` says until it is accepted.

        Raises
        ------
        SolverError
            If no way to repeat it is left; the state is then that before the step.
        """
        started, equations = clock.perf_counter() - COMPILATION.seconds, self.problem.equations
        x_before, v_before = equations.x, equations.v
        v_owned = v_before[: self.problem.points.n_owned]
        newton = linear = rejected = gains = 0
        jumps, failed = False, []
        touches, integrators = equations.contact_before.touches, equations.integrators
        integrators.take(integrators.in_contact if touches or equations.nears_limit else integrators.usual)
        while True:
            end = self.control.next_end(self.time)
            dt, histories = end - self.time, self._histories()
            with self.phases("solve"):
                self.stepper.follow_integrator()
                attempt = (self.equilibrium or self.stepper).attempt(self.time, end)
            jumps |= equations.start_acceleration.starts_anew and equations.damping.active
            newton += attempt.newton_iterations
            linear += attempt.linear_iterations
            trouble = self._trouble(attempt, x_before, v_before, dt)
            if trouble is None:
                break
            if attempt.converged:
                self._return_to(x_before, v_before, *histories)
            elif not attempt.touches:
                failed.append(FailedAttempt.of(attempt, dt, self.stepper.preset))
            recover(self, RejectedStep(trouble, attempt, dt, gains, jumps, failed))
            gains += trouble is Trouble.GAIN
            rejected += 1
        self.last_integrator = equations.integrator
        usual, in_contact = integrators.usual, integrators.in_contact
        if equations.integrator is in_contact is not usual and usual.iterates:
            text = f"{in_contact.name} takes the steps in which something touches, nears a limit or closes"
            self.run_notes.once("in contact", text)
        if self.accuracy is not None:
            self.accuracy.record_step(v_owned, dt, self.step_number, self.time, self.run_notes)
        equations.follow_step(v_owned)
        self.control.record_success(newton)
        if self.equilibrium is not None and self.control.is_end(end) and not events(self):
            with self.phases("solve"):
                settled = self.equilibrium.settle(self.time, end)
            newton += settled.newton_iterations
            linear += settled.linear_iterations
            self.stability = settled.stability.content
            if settled.note:
                self.notes.append(settled.note)
        self.time, self.step_number = end, self.step_number + 1
        if self.guard is None:
            with self.phases("balance"):
                self.energy_balance.record(x_before[: len(v_owned)])
        changed = note_step(self, attempt)
        for term in equations.active.stateful:
            term.accept(equations.x, equations.step.frozen[term])
        if changed:
            self._take_up_changes()
        equations.reference.record_starts(self.time, equations.x)
        self.stepper.monitor()
        seconds = clock.perf_counter() - COMPILATION.seconds - started
        took = newton, linear, rejected, attempt.residual, seconds
        for name, number in zip(self.totals, took, strict=False):
            self.totals[name] += int(number)
        stretch = self.compression.smallest, self.compression.largest
        return StepReport(self.step_number, self.time, dt, *took, *stretch, attempt.remaining)

    def _take_up_changes(self) -> None:
        """Something has changed in terms at the end of the step: forces jump there."""
        self.problem.equations.state.forget()
        if self.equilibrium is None:
            self.expect_jump(self.time)
        else:
            assert isinstance(self.control, LoadControl)
            self.control.stay()
            self.equilibrium.forget_path()

    def _trouble(self, attempt: Attempt, x_before: Array, v_before: Array, dt: float) -> Trouble | None:
        """Why the attempt at a step of dt [s] from x_before and v_before (n_local, 3) is not accepted."""
        if not attempt.converged:
            if attempt.touches:
                return Trouble.TOUCHING
            return Trouble.CROSSING if attempt.crosses else Trouble.UNSOLVED
        equations, n = self.problem.equations, self.problem.points.n_owned
        if not limits.is_resolved(equations):
            return Trouble.UNRESOLVED
        if self.accuracy is not None and not self.accuracy.accepts(v_before[:n], dt):
            return Trouble.INACCURATE
        if self.guard is not None:
            with self.phases("balance"):
                account = self.energy_balance.account_of(x_before[:n])
                if not self.guard.accept(x_before, v_before, self.energy_balance):
                    return Trouble.GAIN
                self.energy_balance.enter(account)
        return None

    def _histories(self) -> tuple[Any, Any]:
        """Histories of the integrators and of the local error, for `_return_to`."""
        accuracy = self.accuracy
        return (
            self.problem.equations.integrators.saved_state(),
            accuracy and accuracy.local_error.saved_state(),
        )

    def _return_to(self, x: Array, v: Array, integrators: Any, error: Any) -> None:
        """Return to positions and velocities (n_local, 3) and histories before the step."""
        equations, n = self.problem.equations, self.problem.points.n_owned
        equations.state.set(x[:n], v[:n])
        equations.integrators.restore(*integrators)
        if self.accuracy is not None:
            self.accuracy.local_error.restore(*error)
        self.stepper.start(self.time, self.step_number)

    def fail(self, failure: Failure) -> NoReturn:
        """End the run before a step that has no solution.

        Raises
        ------
        SolverError
        """
        self.failure = failure
        raise SolverError(failure.sentence, collective=True, details=failure.lines)

    @property
    def in_vain(self) -> bool:
        """Whether a smaller increment of an equilibrium would not help."""
        return self.equilibrium is not None and self.equilibrium.in_vain

    @property
    def jumps(self) -> tuple[float, ...]:
        """Times [s] of the jumps of forces that the scene does not name."""
        return self.problem.equations.start_acceleration.jumps

    def expect_jump(self, time: float) -> None:
        """Let forces, or velocities of handles, jump at a further time [s]."""
        self.problem.equations.start_acceleration.expect_jump(time, self.time)
        if self.guard is not None:
            self.guard.forget_end()

    def follow_driven(self, time: float) -> None:
        """Follow what a program drives until a time [s], at which a step must end."""
        self.control.add_event(time)
        equations = self.problem.equations
        if equations.integrator.handles_at_stage and self.step_number:
            v = equations.v[: self.problem.points.n_owned].copy()
            equations.step.prescribed.overwrite(v, equations.prescriptions.end_rates(equations.step))
            equations.state.set_velocity(v)
            self.energy_balance.enter_outside_change()

    def time_text(self) -> str:
        """Text of the present time, or load factor."""
        moves = self.problem.equations.integrator.dynamic
        return f"t = {self.time:g} s" if moves else f"load factor {self.time:g}"

    def saved_state(self) -> tuple[dict[str, Array], dict[str, Any]]:
        """Arrays (n_owned, 3) and numbers of a checkpoint; see `resumption`."""
        return saved_state(self)

    def resume(
        self,
        arrays: Mapping[str, Array],
        scalars: Mapping[str, Any],
        edges: Mapping[str, Array] = MappingProxyType({}),
        elements: Mapping[str, ElementState] = MappingProxyType({}),
    ) -> None:
        """Continue from a `saved_state`; see `resumption`."""
        self.time, self.step_number = scalars["time"], scalars["step"]
        self.totals |= scalars["totals"]
        self.stability = self.stability and scalars["stability"]
        resume(self, arrays, scalars, edges, elements)

    def destroy(self) -> None:
        """Free all PETSc and MPI objects and remove the scene's PETSc options; collective."""
        self.stepper.destroy()
        self.problem.discretisation.destroy()
        self._remove_filled_options()

    def _remove_filled_options(self) -> None:
        for name in self._filled:
            PETSc.Options().delValue(name)
