"""Stepping through a scene: choice of Δt, retries and recovery from failures; writes no files."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.kernels.compilation import COMPILATION
from lyra_petsc.linear.petsc_options import fill_gaps, is_set, petsc_number, unknown
from lyra_petsc.linear.refused_options import check_options, check_size
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.parallel import on_root
from lyra_petsc.phases import Phases
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping import term_states
from lyra_petsc.stepping.compression_watch import CompressionWatch
from lyra_petsc.stepping.energy_balance import Budget, EnergyBalance
from lyra_petsc.stepping.energy_guard import EnergyGuard
from lyra_petsc.stepping.failure.failure_report import FailedAttempt, Failure, explain_failure
from lyra_petsc.stepping.integrators.beuler import BackwardEuler, LaggedBackwardEuler
from lyra_petsc.stepping.integrators.integrator import Integrator
from lyra_petsc.stepping.local_error import LocalError
from lyra_petsc.stepping.newton.roundoff import residual_roundoff
from lyra_petsc.stepping.problem import Problem, build_problem, event_times, refuse_contact
from lyra_petsc.stepping.start_notes import nothing_acts
from lyra_petsc.stepping.statics.equilibrium import Equilibrium
from lyra_petsc.stepping.statics.stability import Stability
from lyra_petsc.stepping.step_control import (
    HALVINGS,
    NEAR_MINIMUM,
    LoadControl,
    StepControl,
    ToleranceControl,
)
from lyra_petsc.stepping.stepper import WOULD_CROSS, Attempt, Stepper
from lyra_petsc.stepping.ts_options import STEP_OPTIONS, step_option, with_ts_options
from lyra_petsc.terms.protocols import Dissipates

SMALLEST_FRACTION = 2.0**-12
"""Smallest Δt of a retry over the nominal Δt (``-ts_adapt_dt_min`` overrides it)."""

LARGEST_FRACTION = 0.1
"""Largest Δt of an adaptive run over its length (``-ts_adapt_dt_max`` overrides it)."""

IMPACT_DT = 0.2
"""Δt over the nominal one below which backward Euler repeats steps that fail in contact."""

IMPACT_SKIN_FRACTION, IMPACT_RUN_FRACTION = 0.02, 1e-4
"""Displacement in a step over the skin of the contact search, and Δt over the length of the run, below which
adaptive steps are not shortened for the error of an impact, which would lead to ever shorter ones.
"""

DOUBTFUL = 0.1
"""Residual at round-off over the loads above which a note doubts an equilibrium."""

START_HALVINGS = 2
"""Halvings after which backward Euler takes a step of a damped sheet at the start or after a jump."""

MAX_STEPS, MAX_STATES = 1e8, 1e6
"""Upper bounds of a run's numbers of steps and of states."""

FIRST_ORDER_STEPS = 500
"""Adaptive steps of a first-order integrator after which a note recommends one of second order."""

SMALLEST_ADAPTED = 1e-6
"""Smallest Δt of an adaptive run over the largest (``-ts_adapt_dt_min`` overrides it)."""


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


def _positive(name: str, seconds: float) -> float:
    """Return ``seconds`` of an option ``name``; refuse what is not positive and finite."""
    if not 0.0 < seconds < math.inf:
        raise InputError(f"must be a finite number of seconds > 0, not {seconds:g}", key=name)
    return seconds


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
    stability : dict
        Static analysis: entries of summary.json on the last equilibrium.
    failure : Failure or None
        Why the last step could not be taken.
    last_integrator : Integrator
        The one that took the last step: the scene's, or one in its place.
    notes : list of str
        Messages to the user: mesh repairs, changed linear solver, …
    earlier_notes : int
        How many of the notes come from the run that wrote the checkpoint.

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
        stops: Sequence[float] = (),
    ) -> None:
        self.comm, self.scene, self._mesh, self._stops = comm, scene, mesh, list(stops)
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
        self.problem: Problem = build_problem(self.comm, scene, self.phases, self._mesh)
        self.notes, self.earlier_notes = list(self.problem.whole.notes), 0
        whole, system = self.problem.whole, self.problem.system
        check_size(self.problem.points.n_unknowns)
        with self.phases("solve"):
            floor = residual_roundoff(system, whole.largest_coordinate)
            if not math.isfinite(floor):
                raise InputError(
                    "stiffness times size overflows; give smaller numbers or another unit of length",
                    file=scene.source,
                    key="material",
                )
            self.stepper = Stepper(scene, system, self.problem.surface, whole.spacing, floor)
        self.notes += on_root(self.comm, lambda: unknown(self.stepper.our_options))
        self.roundoff = floor
        ts = self.stepper.ts
        self.max_steps = ts.getMaxSteps()
        self.control = self._create_control(
            _positive(f"-{step_option()}", petsc_number(step_option(), ts.getTimeStep())),
            _positive("-ts_max_time", petsc_number("ts_max_time", ts.getMaxTime())),
        )
        self._check_length(self.control)
        self.time, self.step_number = 0.0, 0
        self.local_error = LocalError(system) if scene.time.adaptive else None
        self.estimated_error = 0.0
        self.compression = CompressionWatch(self.problem)
        self._reported: set[str] = set()
        self.stability: dict[str, Any] = {}
        if scene.time.analysis == "static":
            self.stability = Stability(reason="the end is not reached").content
        self.totals = {"newton_iterations": 0, "linear_iterations": 0, "rejected": 0}
        self._repeats: dict[str, int] = {}
        self._smallest_dt = math.inf
        self.failure: Failure | None = None
        self._failed_attempts: list[FailedAttempt] = []
        self.stepper.start(0.0, 0)
        if self.problem.points.n_edges_global and not self.stepper.balance_edge_moments(floor):
            self.notes.append("the moments on the edges of the start shape do not balance")
        for term in system.active.stateful:
            if isinstance(term, Dissipates):  # whose rest state has edges in equilibrium
                term.initialise(system.x)
        self.notes += nothing_acts(scene, system, event_times(scene), self.control.end, floor)
        self._equilibrium: Equilibrium | None = None
        if scene.time.static:
            sizes = whole.spacing, whole.size, floor
            self._equilibrium = Equilibrium(system, self.stepper, scene.solver, *sizes)
        self.energy_balance = EnergyBalance(system)
        drift = scene.initial.velocity if scene.initial else (0.0, 0.0, 0.0)
        self.guard = EnergyGuard(system, drift) if system.integrator.dynamic else None

    def _create_control(self, step: float, end: float) -> StepControl:
        """Create the control of fixed steps, of steps by a tolerance, or of load increments."""
        time, every = self.scene.time, self.scene.output.every
        # the end of the run is recognised within a fraction of Δt, so Δt must not exceed the run's length
        largest = LARGEST_FRACTION * end if time.adaptive else min(step, end)
        largest = _positive("-ts_adapt_dt_max", min(largest, petsc_number("ts_adapt_dt_max", largest)))
        smallest = (SMALLEST_ADAPTED if time.adaptive else SMALLEST_FRACTION) * largest
        smallest = _positive("-ts_adapt_dt_min", petsc_number("ts_adapt_dt_min", smallest))
        stops = [*event_times(self.scene), *self._stops]
        if time.analysis == "static":
            maximum = petsc_number("ts_adapt_dt_max", end)
            return LoadControl(largest, end, stops, smallest, maximum)
        if time.adaptive:
            return ToleranceControl(step, largest, end, every, stops, smallest)
        return StepControl(largest, end, every, stops, smallest)

    def _check_length(self, control: StepControl) -> None:
        """Refuse runs of more than `MAX_STEPS` steps or `MAX_STATES` states."""
        time, every = self.scene.time, self.scene.output.every
        if time.analysis == "static":  # increments grow while Newton's method converges easily
            return
        steps = control.end / control.step
        if steps > MAX_STEPS:
            names = [f"-{name}" for name in ("ts_adapt_dt_max", *STEP_OPTIONS, "ts_max_time") if is_set(name)]
            self._refuse_length(f"{steps:.3g} steps", MAX_STEPS, control.step, [*names, "time.step"][0])
        states = steps if every is None else control.end / every
        if states > MAX_STATES:
            step = control.step if every is None else every
            self._refuse_length(f"{states:.3g} states", MAX_STATES, step, "output.every")

    def _refuse_length(self, count: str, maximum: float, step: float, key: str) -> None:
        raise InputError(
            f"{step:g} s makes {count} in {self.control.end:g} s; at most {maximum:g} are made: give more",
            file=None if key.startswith("-") else self.scene.source,
            key=key,
        )

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
        """Take one step, retried with a smaller Δt until it is accepted.

        Raises
        ------
        SolverError
            If even the smallest Δt fails; the state is then that before the step.
        """
        started = clock.perf_counter() - COMPILATION.seconds
        system, n = self.problem.system, self.problem.points.n_owned
        x_before, v_before = system.x, system.v
        newton = linear = rejected = halvings = 0
        self._failed_attempts = []
        system.integrator = system.in_contact if system.touches else system.usual
        starts, touched = False, system.touches
        while True:
            end = self.control.next_end(self.time)
            past, past_error = system.saved_histories(), self.estimated_error
            past_slope = self.local_error.saved_state() if self.local_error is not None else None
            with self.phases("solve"):
                self.stepper.follow_integrator()
                attempt = (self._equilibrium or self.stepper).attempt(self.time, end)
            starts |= system.start_acceleration.starts_anew and system.damping.active
            newton += attempt.newton_iterations
            linear += attempt.linear_iterations
            if not attempt.converged:
                if not self._switch_at_crossing(attempt, end - self.time):
                    self._recover_from_failure(attempt, end)
            else:
                if system.suits_contact:
                    solved = system.resolves_contact()
                else:
                    solved = not system.collisions.touches(system.stage_positions)
                accurate = solved and self._is_accurate(v_before[:n], end - self.time)
                if accurate and self._conserves_energy(x_before, v_before, end):
                    break
                system.state.set(x_before[:n], v_before[:n])
                system.restore_histories(*past)
                self.stepper.start(self.time, self.step_number)
                if not solved:
                    takes_it = touched and not system.suits_contact
                    system.integrator = system.in_contact if takes_it else self._backward_euler()
                elif accurate:
                    self.estimated_error = past_error
                    if self.local_error is not None and past_slope is not None:
                        self.local_error.restore(*past_slope)
                    assert self.guard is not None
                    jump = starts and halvings >= START_HALVINGS
                    if not self._switch_after_gain(end - self.time, jump=jump):
                        self._halve_step(end - self.time, halvings)
                        halvings += 1
            rejected += 1
        self.last_integrator = system.integrator
        if system.integrator is system.in_contact is not system.usual and system.usual.iterates:
            name = system.in_contact.name
            self._note_once("in contact", f"{name} takes the steps in which something touches")
        system.follow_step(v_before[:n])
        if self._equilibrium is not None and self.control.is_end(end):
            with self.phases("solve"):
                settled = self._equilibrium.settle(self.time, end)
            newton += settled.newton_iterations
            linear += settled.linear_iterations
            self.stability = settled.stability.content
            if settled.note:
                self.notes.append(settled.note)
        self.control.record_success(newton)
        dt, self.time = end - self.time, end
        self.step_number += 1
        with self.phases("balance"):
            if self.guard is None:
                self.energy_balance.record(x_before[:n])
            when = f"step {self.step_number} ({self.time_text()})"
            note = self.compression.check(when, reported="compression" in self._reported)
        if note:
            self._note_once("compression", note)
        if attempt.at_roundoff and "roundoff" not in self._reported:
            self._note_roundoff(attempt.residual)
        if self.stepper.stopped_by:
            self._note_once(
                "option",
                f"{when}: {self.stepper.stopped_by} stopped Newton's method at a residual of "
                f"{attempt.residual:.2g} N, short of solver.force_tolerance",
            )
        for term in system.active.stateful:
            term.accept(system.x, system.active.frozen[term])
        system.set_references(self.time)
        self.stepper.monitor()
        seconds = clock.perf_counter() - COMPILATION.seconds - started
        took = newton, linear, rejected, attempt.residual, seconds
        for name, number in zip(self.totals, took, strict=False):
            self.totals[name] += int(number)
        stretch = self.compression.smallest, self.compression.largest
        return StepReport(self.step_number, self.time, dt, *took, *stretch, attempt.remaining)

    def _note_once(self, subject: str, note: str) -> None:
        """Add a note unless the run has one on this subject; checkpoints hold the subjects."""
        if subject not in self._reported:
            self._reported.add(subject)
            self.notes.append(note)

    def _note_roundoff(self, residual: float) -> None:
        """Note once that round-off keeps the residual [N] above the scene's force tolerance; collective."""
        loads = float(np.sum(self.problem.system.applied.force**2))
        driving = math.sqrt(self.comm.allreduce(loads))
        if residual > self.scene.solver.force_tolerance * driving > 0.0:
            times = residual / driving
            doubt = "; slender triangles or a stiffness that is too large for the loads may make it wrong"
            self._note_once(
                "roundoff",
                f"step {self.step_number} ({self.time_text()}) ended at round-off: double precision leaves "
                f"a residual of {residual:.2g} N at this stiffness, {times:.1g} times the loads"
                + (doubt if self.scene.time.static and times > DOUBTFUL else ""),
            )

    def time_text(self) -> str:
        """Text of the present time, or load factor."""
        moves = self.problem.system.integrator.dynamic
        return f"t = {self.time:g} s" if moves else f"load factor {self.time:g}"

    def _is_accurate(self, v_before: Array, dt: float) -> bool:
        """Whether the local error of the step just taken is within its share of the tolerance."""
        control = self.control
        if self.local_error is None or not isinstance(control, ToleranceControl):
            return True
        size = self.problem.whole.size
        error = self.local_error.estimate(v_before, dt) / size
        share = (self.scene.time.tolerance or 0.0) * dt / control.end
        minimum = self._minimum_dt_in_contact()
        system = self.problem.system
        order, touches = system.integrator.order, system.has_active_pairs
        accepted = control.accept(dt, error / share, order, minimum, touches=touches)
        if accepted:
            self.local_error.record_step(v_before, dt)
            self.estimated_error += error
            if system.usual.order == 1 and self.step_number >= FIRST_ORDER_STEPS:
                self._note_once(
                    "order",
                    f"{self.step_number} steps to t = {self.time:g} s: {system.usual.name} is of "
                    "first order, with Δt in proportion to time.tolerance; bdf2 or alpha2 take fewer steps",
                )
            if error > share and dt <= NEAR_MINIMUM * max(minimum, control.smallest):
                where = "of those that follow impacts " if minimum > control.smallest else ""
                self._note_once(
                    "error",
                    f"step {self.step_number + 1} (t = {self.time:g} s): time.tolerance is not reached with "
                    f"the smallest Δt = {dt:.3g} s {where}(-ts_adapt_dt_min)",
                )
        return accepted

    def _minimum_dt_in_contact(self) -> float:
        """Smallest Δt [s] of adaptive steps while something touches; 0 without contact, or if
        ``-ts_adapt_dt_min`` is given; collective.
        """
        system = self.problem.system
        if not system.has_active_pairs or is_set("ts_adapt_dt_min"):
            return 0.0
        return min(IMPACT_SKIN_FRACTION * self._time_through_skin(), IMPACT_RUN_FRACTION * self.control.end)

    def _time_through_skin(self) -> float:
        """Time [s] in which the fastest vertex crosses the skin of the contact search; collective."""
        system = self.problem.system
        fastest = float(self.comm.allreduce(np.abs(system.v).max(initial=0.0), MPI.MAX))
        skins = (term.skin for term in system.active.changing if term.search_distance > 0.0)
        return min(skins, default=math.inf) / max(fastest, 1e-300)

    def _conserves_energy(self, x_before: Array, v_before: Array, end: float) -> bool:
        """Whether the energy guard accepts the step just taken; if so, `energy_balance` records it."""
        if self.guard is None:
            return True
        system = self.problem.system
        with self.phases("balance"):
            account = self.energy_balance.account_of(x_before[: system.points.n_owned])
            accepted = self.guard.accept(x_before, v_before, self.energy_balance)
            if accepted:
                self.energy_balance.enter(account)
            return accepted

    def _switch_at_crossing(self, attempt: Attempt, dt: float) -> bool:
        """Let another integrator repeat a step of dt [s] in which parts would cross; return whether one does.

        The midpoint rule and generalised-α extrapolate from their stage to the end of the step.
        """
        system = self.problem.system
        if not attempt.message.startswith(WOULD_CROSS):
            return False
        if system.integrator is system.usual and system.usual is not system.in_contact:
            system.integrator = system.in_contact
            return True
        return self._switch_to_backward_euler(dt, "finds no collision-free step")

    def _switch_after_gain(self, dt: float, *, jump: bool = False, last: bool = False) -> bool:
        """Let backward Euler repeat a step of dt [s] that gained energy; return whether it does.

        Not under the midpoint rule, which conserves angular momentum.
        """
        assert self.guard is not None
        if self.problem.system.integrator.moves_uniformly:
            return False
        return self._switch_to_backward_euler(dt, self.guard.message, jump=jump, last=last)

    def _switch_to_backward_euler(
        self, dt: float, why: str, *, jump: bool = False, last: bool = False
    ) -> bool:
        """Let backward Euler repeat a damped step after a start or a ``jump``, the ``last`` possible step, or
        a short one in contact; return whether it does.

        Neither a formula for smooth motions nor one linear solve is valid over an impact. If damping is
        stiff, generalised-α overshoots from the acceleration of a start or a jump. Adaptive steps are short
        near their minimum in contact.
        """
        system, usual = self.problem.system, self.problem.system.usual
        if self.scene.time.adaptive:
            long = dt > 2.0 * self._minimum_dt_in_contact()
        else:
            long = dt > IMPACT_DT * self.control.step
        impact = system.has_active_pairs and not long
        if usual.name == "beuler" or not usual.dynamic or not (jump or last or impact):
            return False
        if system.integrator not in (usual, system.in_contact):
            system.integrator = system.in_contact  # backward Euler failed, too
            return False
        system.integrator = self._backward_euler()
        self._note_other_integrator(why, "backward Euler", in_contact=system.has_active_pairs and not jump)
        return True

    def _backward_euler(self) -> Integrator:
        """Backward Euler with the loads of the scene's integrator."""
        return LaggedBackwardEuler() if self.problem.system.usual.lagged_loads else BackwardEuler()

    def _note_other_integrator(self, why: str, by: str, *, in_contact: bool = True) -> None:
        """Note once which integrator repeats steps that fail."""
        where = f"step {self.step_number + 1} ({self.time_text()}): {self.problem.system.usual.name} {why}"
        subject = "impact" if by == "backward Euler" else f"impact {by}"
        self._note_once(
            subject if in_contact else "energy",
            f"{where}{' in contact' if in_contact else ''}; such steps are repeated by {by}",
        )

    def _halve_step(self, dt: float, halvings: int) -> None:
        """Halve Δt after a step that gained energy; the state is that before it.

        Raises
        ------
        SolverError
            If Δt is as small as it may be.
        """
        assert self.guard is not None
        where, scheme = f"step {self.step_number + 1} ({self.time_text()})", self.scene.time.scheme
        if halvings >= HALVINGS or not self.control.shorten(dt, first=halvings == 0):
            if self._switch_after_gain(dt, last=True):
                return
            raise SolverError(
                f"{where}: {scheme} {self.guard.message}, even with Δt = {dt:.3g} s; "
                f"the state at {self.time_text()} is kept; try {self.guard.remedy}",
                collective=True,
            )
        if self.guard.gains.repeated == 1:
            self.notes.append(
                f"{where}: {scheme} {self.guard.message} with Δt = {dt:.3g} s; such steps are repeated with "
                f"half of it (energy_balance in summary.json has their number); try {self.guard.remedy}"
            )

    def _recover_from_failure(self, attempt: Attempt, end: float) -> None:
        """Change to the next linear solver or halve Δt after a failed attempt.

        Raises
        ------
        SolverError
            If neither is left; `failure` says why.
        """
        self._failed_attempts.append(FailedAttempt.of(attempt, end - self.time, self.stepper.preset))
        if self.stepper.linear_solver_failed:
            previous, slow = self.stepper.preset, self.stepper.convergence.too_slow
            following = self.stepper.next_preset()
            if following is not None:
                why = "took too many iterations" if slow else "broke down"
                self.notes.append(
                    f"step {self.step_number + 1}: linear solver '{previous}' {why}, "
                    f"going on with '{following}'"
                )
                return
        in_vain = self._equilibrium is not None and self._equilibrium.in_vain
        if in_vain or self.stepper.stopped_by or not self.control.halve_after_failure():
            assert attempt.failed_solve is not None
            self.failure = explain_failure(
                self.problem,
                self.scene,
                self.stepper,
                attempt.failed_solve,
                self._failed_attempts,
                step=self.step_number + 1,
                time=self.time,
                iterations_key=self._iterations_key,
            )
            raise SolverError(self.failure.sentence, collective=True, details=self.failure.lines)
        why = attempt.message or "no solution was found"
        solve = attempt.failed_solve
        if solve and solve.snes_reason == PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT:
            why += f" ({self._iterations_key} {self.stepper.snes.getTolerances()[3]})"
        self._repeats[why] = self._repeats.get(why, 0) + 1
        self._smallest_dt = min(self._smallest_dt, self.control.factor * self.control.step)

    @property
    def _iterations_key(self) -> str:
        """Name of the option or key that limits Newton's iterations."""
        return "-snes_max_it" if is_set("snes_max_it") else "solver.max_iterations"

    @property
    def note_of_repeats(self) -> str:
        """How many attempts so far were repeated with a smaller step, and why; empty if none was."""
        if not self._repeats:
            return ""
        times = sum(self._repeats.values())
        often = sorted(self._repeats.items(), key=lambda each: -each[1])
        reasons = "; ".join(f"{why}: {count} times" if count > 1 else f"{why}: once" for why, count in often)
        what, unit = ("Δt", " s") if self.problem.system.integrator.dynamic else ("increment", "")
        note = f"{times} {'attempt was' if times == 1 else 'attempts were'} repeated with a smaller {what}, "
        note += f"down to {self._smallest_dt:.3g}{unit} ({reasons})"
        if self.scene.time.adaptive or not self.problem.system.integrator.dynamic:
            return note
        planned = math.ceil(self.time / self.control.step * (1.0 - 1e-9))
        return f"{note}; {self.step_number} steps were taken where {planned} of the full Δt would do"

    def saved_state(self) -> tuple[dict[str, Array], dict[str, Any]]:
        """Arrays (n_owned, 3) and numbers of a checkpoint besides positions and velocities; collective.

        With them `resume` continues as if the run had never stopped.
        """
        system, time = self.problem.system, self.time
        arrays, integrator = system.saved_histories()
        balance, budget = self.energy_balance.saved_state()
        of_stepper, stepper = self.stepper.saved_state(time)
        arrays = arrays | balance | of_stepper
        scalars = {
            "time": time,
            "step": self.step_number,
            "scheme": self.scene.time.scheme,
            "budget": budget,
            "totals": dict(self.totals),
            "stability": self.stability,
            "repeated": dict(self._repeats),
            "least": self._smallest_dt if self._repeats else None,
            "notes": list(self.notes),
            "told": sorted(self._reported),
            **self.control.saved_state(),
            "estimated_error": self.estimated_error,
            "integrator": integrator,
            **stepper,
            "energy": None if self.guard is None else self.guard.saved_state(),
            "late_starts": sorted(system.reference.late),
            "obstacles": term_states.obstacle_places(system),
        }
        if self._equilibrium is not None:
            more, scalars["equilibrium"] = self._equilibrium.saved_state(time)
            arrays |= more
        if self.local_error is not None:
            more, numbers = self.local_error.saved_state()
            arrays, scalars["integrator"] = arrays | more, integrator | numbers
        return arrays, scalars

    def resume(
        self,
        arrays: Mapping[str, Array],
        scalars: Mapping[str, Any],
        edges: Mapping[str, Array] = MappingProxyType({}),
        elements: Mapping[str, tuple[Ints, Array]] = MappingProxyType({}),
    ) -> None:
        """Continue from a `saved_state`; x and v of the owned rows are in ``problem.system`` already.

        ``edges`` and ``elements`` are those of `term_states`; collective.
        """
        system = self.problem.system
        system.state.update_ghosts()
        term_states.restore_fixed(system, arrays, edges, elements)
        self.time, self.step_number = scalars["time"], scalars["step"]
        # loads and handles that only the changed scene starts earlier start now; the others have started
        system.set_references(self.time)
        system.hold_targets(self.time)
        refuse_contact(system, self.scene, f"at {self.time_text()}")
        self.energy_balance.restore(arrays, scalars["budget"])
        self.control.restore(scalars)
        if self._equilibrium is not None:
            self._equilibrium.restore(arrays, scalars["equilibrium"], self.time)
        self.estimated_error = scalars["estimated_error"]
        system.restore_histories(arrays, scalars["integrator"])
        if self.guard is not None:
            self.guard.restore(scalars["energy"], same=scalars["scheme"] == self.scene.time.scheme)
        if self.local_error is not None:
            self.local_error.restore(arrays, scalars["integrator"])
        term_states.restore_changing(system, elements, scalars["obstacles"])
        self.stepper.restore(arrays, scalars, self.time, self.step_number)
        self.totals |= scalars["totals"]
        self.stability = self.stability and scalars["stability"]
        self._repeats = dict(scalars["repeated"])
        self._smallest_dt = math.inf if scalars["least"] is None else scalars["least"]
        self._reported |= set(scalars["told"])
        earlier = scalars["notes"]
        self.earlier_notes = len(earlier)
        self.notes[:] = [*earlier, *(note for note in self.notes if note not in earlier)]

    def destroy(self) -> None:
        """Free all PETSc and MPI objects and remove the scene's PETSc options; collective."""
        self.stepper.destroy()
        self.problem.discretisation.destroy()
        self._remove_filled_options()

    def _remove_filled_options(self) -> None:
        for name in self._filled:
            PETSc.Options().delValue(name)
