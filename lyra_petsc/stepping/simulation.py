"""A scene in motion: steps with retries, no files."""

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
from lyra_petsc.linear.petsc_options import fill_gaps, is_set, petsc_number
from lyra_petsc.linear.refused_options import check_options, check_size
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.phases import Phases
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping import term_memory
from lyra_petsc.stepping.compression_watch import CompressionWatch
from lyra_petsc.stepping.energy_balance import Budget, Ledger
from lyra_petsc.stepping.energy_guard import EnergyGuard
from lyra_petsc.stepping.equilibrium import Equilibrium
from lyra_petsc.stepping.failure_advice import Circumstances, advice, more_room, trouble
from lyra_petsc.stepping.failure_diagnosis import diagnose
from lyra_petsc.stepping.failure_report import FailedAttempt, Failure
from lyra_petsc.stepping.integrators.beuler import BackwardEuler, LaggedBackwardEuler
from lyra_petsc.stepping.local_error import LocalError
from lyra_petsc.stepping.near_pairs import nearest_obstacle, worst_pair
from lyra_petsc.stepping.problem import Problem, build_problem, events, refuse_contact
from lyra_petsc.stepping.roundoff import residual_roundoff
from lyra_petsc.stepping.stability import Stability
from lyra_petsc.stepping.step_control import HALVINGS, LoadControl, StepControl, ToleranceControl
from lyra_petsc.stepping.stepper import MEETS, Attempt, Stepper
from lyra_petsc.stepping.ts_options import STEP_OPTIONS, step_option, with_ts_options

SMALLEST_FRACTION = 2.0**-12
"""Δt below which no retry is made, over the nominal one (``-ts_adapt_dt_min`` overrides it)."""

LARGEST_FRACTION = 0.1
"""Largest Δt of an adaptive run over its length (``-ts_adapt_dt_max`` overrides it)."""

FINER = 0.2
"""Part of Δt down to which a step that makes energy is halved before an impact is taken to be why."""

FINEST = 0.02
"""The same under the midpoint rule, whose steps keep angular momentum over an impact, if they find a way."""

FAR = 20.0
"""Skins of a search through which a vertex goes in a step, above which halvings do not resolve an impact."""

FOLLOWED, FOLLOWED_OF_RUN = 0.02, 1e-4
"""Parts of a search's skin that vertices go in a step, and of the run, below which automatic steps do not
become shorter for the error of an impact: it may be followed into ever smaller parts of the gap.
"""

MOST_STEPS, MOST_STATES = 1e8, 1e6
"""Beyond them a run would never end, or fill any disk."""

SMALLEST_ADAPTED = 1e-6
"""Smallest Δt of an adaptive run over the largest (``-ts_adapt_dt_min`` overrides it)."""


@dataclass
class StepReport:
    """One accepted step; ``left`` [m] is what more Newton iterations would move."""

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
    left: float = math.inf


def _positive(name: str, seconds: float) -> float:
    """A time [s] from PETSc's options, or from the scene and then positive anyway."""
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
        Where wall time is charged.
    mesh : Mesh, optional
        The scene's on rank 0, where it stands already.
    land : sequence of float
        Further times [s] on which a step shall end.

    Attributes
    ----------
    scene : Scene
        With the integrator and the kind of steps that PETSc's options chose.
    problem : Problem
    time : float
        [s]
    step_number : int
    roundoff : float
        Most that round-off may make of the norm [N] of the residual.
    totals : dict of str to int
        Newton and linear iterations, and rejected attempts, of all steps.
    stability : dict
        Of a static analysis: what summary.json says of the last equilibrium.
    failure : Failure or None
        Why the last step could not be taken.
    notes : list of str
        What the user should know: mesh repairs, changed linear solver, …
    earlier_notes : int
        How many of them are of the run that a checkpoint is of.

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
        land: Sequence[float] = (),
    ) -> None:
        self.comm, self.scene, self._mesh, self._land = comm, scene, mesh, list(land)
        self.phases = phases or Phases()
        COMPILATION.begins, COMPILATION.ends = self.phases.begin_compilation, self.phases.end_compilation
        self._filled = fill_gaps(scene.petsc)
        try:
            check_options()
            self.scene = with_ts_options(scene)
            self._set_up(self.scene)
        except BaseException:
            self._take_back_options()
            raise

    def _set_up(self, scene: Scene) -> None:
        self.problem: Problem = build_problem(self.comm, scene, self.phases, self._mesh)
        self.notes, self.earlier_notes = list(self.problem.outline.notes), 0
        outline, system = self.problem.outline, self.problem.system
        check_size(self.problem.points.n_unknowns)
        with self.phases("solve"):
            floor = residual_roundoff(system, outline.reach)
            if not math.isfinite(floor):
                raise InputError(
                    "stiffness times size overflows; give smaller numbers or another unit of length",
                    file=scene.source,
                    key="material",
                )
            self.stepper = Stepper(scene, system, self.problem.surface, outline.spacing, floor)
        self.roundoff = floor
        ts = self.stepper.ts
        self.max_steps = ts.getMaxSteps()
        self.control = self._control(
            _positive(f"-{step_option()}", petsc_number(step_option(), ts.getTimeStep())),
            _positive("-ts_max_time", petsc_number("ts_max_time", ts.getMaxTime())),
        )
        self._check_length(self.control)
        self.time, self.step_number = 0.0, 0
        self.local_error = LocalError(system) if scene.time.adaptive else None
        self.estimated_error = 0.0
        self.compression = CompressionWatch(self.problem)
        self._told: set[str] = set()
        self.stability: dict[str, Any] = {}
        if scene.time.analysis == "static":
            self.stability = Stability(reason="the end is not reached").content
        self.totals = {"newton_iterations": 0, "linear_iterations": 0, "rejected": 0}
        self._repeated: dict[str, int] = {}
        self._least = math.inf
        self.failure: Failure | None = None
        self._tried: list[FailedAttempt] = []
        self.stepper.start(0.0, 0)
        if self.problem.points.n_edges_global and not self.stepper.settle_edges(floor):
            self.notes.append("the moments on the edges of the start shape do not balance")
        for term in system.active.elastic:
            if term.registration.element_vertices:  # friction, which knows of no way before the start
                term.initialise(system.x)
        self._equilibrium: Equilibrium | None = None
        if scene.time.static:
            sizes = outline.spacing, outline.size, floor
            self._equilibrium = Equilibrium(system, self.stepper, scene.solver, *sizes)
        self._usual = system.integrator
        self.ledger = Ledger(system)
        self.guard = EnergyGuard(system) if system.integrator.dynamic else None

    def _control(self, step: float, end: float) -> StepControl:
        """Plan of the steps: fixed, by a tolerance, or of a load factor."""
        time, every = self.scene.time, self.scene.output.every
        # the end of the run is found within a fraction of Δt, which must not be the whole of it
        largest = LARGEST_FRACTION * end if time.adaptive else min(step, end)
        largest = _positive("-ts_adapt_dt_max", min(largest, petsc_number("ts_adapt_dt_max", largest)))
        smallest = (SMALLEST_ADAPTED if time.adaptive else SMALLEST_FRACTION) * largest
        smallest = _positive("-ts_adapt_dt_min", petsc_number("ts_adapt_dt_min", smallest))
        stops = [*events(self.scene), *self._land]
        if time.analysis == "static":
            most = petsc_number("ts_adapt_dt_max", end)
            return LoadControl(largest, end, stops, smallest, most)
        if time.adaptive:
            return ToleranceControl(step, largest, end, every, stops, smallest)
        return StepControl(largest, end, every, stops, smallest)

    def _check_length(self, control: StepControl) -> None:
        """Refuse what would never end."""
        time, every = self.scene.time, self.scene.output.every
        if time.analysis == "static":  # an increment grows while it is easy
            return
        steps = control.end / control.step
        if steps > MOST_STEPS:
            names = [f"-{name}" for name in ("ts_adapt_dt_max", *STEP_OPTIONS, "ts_max_time") if is_set(name)]
            self._refuse_length(f"{steps:.3g} steps", MOST_STEPS, control.step, [*names, "time.step"][0])
        states = steps if every is None else control.end / every
        if states > MOST_STATES:
            step = control.step if every is None else every
            self._refuse_length(f"{states:.3g} states", MOST_STATES, step, "output.every")

    def _refuse_length(self, count: str, most: float, step: float, key: str) -> None:
        raise InputError(
            f"{step:g} s makes {count} in {self.control.end:g} s; at most {most:g} are made: give more",
            file=None if key.startswith("-") else self.scene.source,
            key=key,
        )

    @property
    def budget(self) -> Budget:
        """Energies and works up to the present state."""
        return self.ledger.budget

    @property
    def finished(self) -> bool:
        """Whether the end of the scene, or ``-ts_max_steps``, is reached."""
        return self.at_end or self.step_number >= self.max_steps

    @property
    def at_end(self) -> bool:
        """Whether the end of the scene is reached."""
        return self.control.is_end(self.time)

    def step(self) -> StepReport:
        """One accepted step, retried with a smaller Δt where needed.

        Raises
        ------
        SolverError
            If even the smallest Δt fails; the state is that before the step.
        """
        started = clock.perf_counter() - COMPILATION.seconds
        system, n = self.problem.system, self.problem.points.n_owned
        x_before, v_before = system.x, system.v
        newton = linear = rejected = halvings = 0
        self._tried = []
        system.integrator = self._usual
        if not self._usual.iterates and system.has_friction_pairs:
            system.integrator = LaggedBackwardEuler()
        while True:
            end = self.control.next_end(self.time)
            past, past_error = system.integrator.memory(), self.estimated_error
            past_slope = self.local_error.memory() if self.local_error is not None else None
            with self.phases("solve"):
                self.stepper.follow_integrator()
                attempt = (self._equilibrium or self.stepper).attempt(self.time, end)
            newton += attempt.newton_iterations
            linear += attempt.linear_iterations
            if not attempt.converged:
                if not self._find_way(attempt, end - self.time):
                    self._recover(attempt, end)
            else:
                accurate = self._accurate(v_before[:n], end - self.time)
                if accurate and self._keeps_energy(x_before, v_before, end):
                    break
                system.state.set(x_before[:n], v_before[:n])
                system.integrator.restore(*past)
                self.stepper.start(self.time, self.step_number)
                if accurate:
                    self.estimated_error = past_error
                    if self.local_error is not None and past_slope is not None:
                        self.local_error.restore(*past_slope)
                    assert self.guard is not None
                    # not under the midpoint rule, which keeps angular momentum
                    last = halvings == HALVINGS - 1
                    impact = not system.integrator.exact_work and self._take_impact(
                        end - self.time, self.guard.words, last=last
                    )
                    if not impact:
                        self._lessen(end - self.time, halvings)
                        halvings += 1
            rejected += 1
        if system.integrator is not self._usual:
            by_end = system.integrator.order == 1
            system.integrator = self._usual
            self._usual.restart()
            if by_end:  # before velocities jumped at the end, over which stiff damping would accelerate much
                rate = (system.stage_velocity - v_before[:n]) / (end - self.time)
                moves = system.prescribed.free & (system.mass[:, None] > 0.0)
                self._usual.set_acceleration(np.where(moves, rate, 0.0))
            if self.local_error is not None:
                self.local_error.restart()
        if self._equilibrium is not None and self.control.is_end(end):
            with self.phases("solve"):
                settled = self._equilibrium.settle(self.time, end)
            newton += settled.newton_iterations
            linear += settled.linear_iterations
            self.stability = settled.stability.content
            if settled.note:
                self.notes.append(settled.note)
        self.control.succeeded(newton)
        dt, self.time = end - self.time, end
        self.step_number += 1
        with self.phases("balance"):
            if self.guard is None:
                self.ledger.record(x_before[:n])
            when = f"step {self.step_number} ({self._now()})"
            note = self.compression.check(when, reported="compression" in self._told)
        if note:
            self._tell_once("compression", note)
        if attempt.at_roundoff and "roundoff" not in self._told:
            self._tell_of_roundoff(attempt.residual)
        if self.stepper.stopped_by:
            self._tell_once(
                "option",
                f"{when}: {self.stepper.stopped_by} stopped Newton's method at a residual of "
                f"{attempt.residual:.2g} N, short of solver.force_tolerance",
            )
        for term in system.active.elastic:
            entry = term.registration
            if entry.state or entry.edge_state or entry.element_vertices:
                term.accept(system.x, system.active.frozen[term])
        system.set_references(self.time)
        self.stepper.monitor()
        seconds = clock.perf_counter() - COMPILATION.seconds - started
        took = newton, linear, rejected, attempt.residual, seconds
        for name, number in zip(self.totals, took, strict=False):
            self.totals[name] += int(number)
        stretch = self.compression.smallest, self.compression.largest
        return StepReport(self.step_number, self.time, dt, *took, *stretch, attempt.left)

    def _tell_once(self, of: str, note: str) -> None:
        """Note something unless the run has been told of it, which checkpoints keep."""
        if of not in self._told:
            self._told.add(of)
            self.notes.append(note)

    def _tell_of_roundoff(self, residual: float) -> None:
        """Say once that a residual [N] cannot be made as small as the scene asks; collective."""
        loads = float(np.sum(self.problem.system.applied.force**2))
        driving = math.sqrt(self.comm.allreduce(loads))
        if residual > self.scene.solver.force_tolerance * driving > 0.0:
            self._tell_once(
                "roundoff",
                f"step {self.step_number} ({self._now()}) ended at round-off: double precision leaves a "
                f"residual of {residual:.2g} N at this stiffness, {residual / driving:.1g} of the loads",
            )

    def _now(self) -> str:
        """The present time, or load factor, in words."""
        moves = self.problem.system.integrator.dynamic
        return f"t = {self.time:g} s" if moves else f"load factor {self.time:g}"

    def _accurate(self, v_before: Array, dt: float) -> bool:
        """Whether the step just taken keeps its share of the tolerance."""
        control = self.control
        if self.local_error is None or not isinstance(control, ToleranceControl):
            return True
        size = self.problem.outline.size
        error = self.local_error.of(v_before, dt) / size
        share = (self.scene.time.tolerance or 0.0) * dt / control.end
        least = self._shortest_over_impacts()
        stands = control.judge(dt, error / share, self.problem.system.integrator.order, least)
        if stands:
            self.local_error.record_step(v_before, dt)
            self.estimated_error += error
            if error > share:
                where = "of those that follow impacts " if least > control.smallest else ""
                self._tell_once(
                    "error",
                    f"step {self.step_number + 1} (t = {self.time:g} s): time.tolerance is not reached with "
                    f"the smallest Δt = {dt:.3g} s {where}(-ts_adapt_dt_min)",
                )
        return stands

    def _shortest_over_impacts(self) -> float:
        """Δt [s] below which automatic steps are not shortened for their error where something touches; 0
        where nothing does, or ``-ts_adapt_dt_min`` is given; collective.
        """
        system = self.problem.system
        if not system.has_active_pairs or is_set("ts_adapt_dt_min"):
            return 0.0
        return min(FOLLOWED * self._time_through_skin(), FOLLOWED_OF_RUN * self.control.end)

    def _time_through_skin(self) -> float:
        """Time [s] in which the fastest vertex goes through the skin of a search for contact; collective."""
        system = self.problem.system
        fastest = float(self.comm.allreduce(np.abs(system.v).max(initial=0.0), MPI.MAX))
        return min(term.skin for term in system.active.limiting) / max(fastest, 1e-300)

    def _keeps_energy(self, x_before: Array, v_before: Array, end: float) -> bool:
        """Whether the step just taken made no energy."""
        if self.guard is None:
            return True
        system = self.problem.system
        with self.phases("balance"):
            kept = self.ledger.kept()
            after = self.ledger.record(x_before[: system.points.n_owned])
            balance = self.guard.balance(x_before, v_before, kept[0], after, self.ledger.works)
            # by shorter steps, and at last by backward Euler where that keeps what the integrator keeps
            strict = not system.integrator.exact_work or end - self.time > FINER * self.control.step
            stands = self.guard.stands(balance, strict=strict)
            if not stands:
                self.ledger.take_back(kept)
            return stands

    def _find_way(self, attempt: Attempt, dt: float) -> bool:
        """Let another integrator repeat a step of dt [s] in which something would pass; whether one does.

        The midpoint rule and generalised-α go on from their stage to the end of the step, with small gaps
        through what held the sheet at the stage. BDF2, of second order, too, has its stage at the end. Where
        some halvings of Δt resolve the impact it loses more energy than they do.
        """
        system, usual = self.problem.system, self._usual
        if system.integrator is usual and attempt.words.startswith(MEETS):
            ends, far = system.stage.offset == system.dt, dt > FAR * self._time_through_skin()
            if ends or self.scene.time.adaptive or not far:
                return self._take_impact(dt, "finds no way")
            from lyra_petsc.stepping.integrators.bdf2 import Bdf2  # of use for nothing else

            system.integrator = Bdf2()
            self._tell_of_impact("finds no way", "bdf2")
            return True
        if system.integrator is usual or system.integrator.order == 1:
            return False
        system.integrator = usual
        return self._take_impact(dt, "finds no way")

    def _take_impact(self, dt: float, why: str, *, last: bool = False) -> bool:
        """Let backward Euler repeat a short step that failed where something touches; whether it does.

        Neither a formula for smooth motions nor one linear solve holds over an impact. Automatic steps are
        short where they do not become shorter over impacts, or at the ``last`` halving.
        """
        system, usual = self.problem.system, self._usual
        if self.scene.time.adaptive:
            long = not last and dt > 2.0 * self._shortest_over_impacts()
        else:
            long = dt > (FINEST if usual.exact_work else FINER) * self.control.step
        if long or usual.name == "beuler" or not usual.dynamic or not system.has_active_pairs:
            return False
        if system.integrator is not usual and system.integrator.order == 1:
            system.integrator = usual  # nor did that help
            return False
        system.integrator = LaggedBackwardEuler() if usual.lagged_loads else BackwardEuler()
        self._tell_of_impact(why, "backward Euler")
        return True

    def _tell_of_impact(self, why: str, by: str) -> None:
        """Say once by which integrator such steps are repeated."""
        self._tell_once(
            "impact" if by == "backward Euler" else f"impact {by}",
            f"step {self.step_number + 1} ({self._now()}): {self._usual.name} {why} where something touches; "
            f"such steps are repeated by {by}",
        )

    def _lessen(self, dt: float, halvings: int) -> None:
        """Halve a step that made energy, or give up; the state is that before it."""
        assert self.guard is not None
        where, scheme = f"step {self.step_number + 1} ({self._now()})", self.scene.time.scheme
        if halvings >= HALVINGS or not self.control.shorten(dt, first=halvings == 0):
            raise SolverError(
                f"{where}: {scheme} {self.guard.words}, even with Δt = {dt:.3g} s; "
                f"the state at {self._now()} is kept; try {self.guard.instead}",
                collective=True,
            )
        if self.guard.gains.repeated == 1:
            self.notes.append(
                f"{where}: {scheme} {self.guard.words} with Δt = {dt:.3g} s; such steps are repeated with "
                f"half of it (energy_balance in summary.json has their number); try {self.guard.instead}"
            )

    def _recover(self, attempt: Attempt, end: float) -> None:
        self._tried.append(FailedAttempt.of(attempt, end - self.time, self.stepper.preset))
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
        if in_vain or self.stepper.stopped_by or not self.control.failed():
            self.failure = self._explain(attempt, end)
            raise SolverError(self.failure.sentence, collective=True, details=self.failure.lines)
        why = attempt.words or "no solution was found"
        if attempt.stuck and attempt.stuck.snes_reason == PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT:
            why += f" ({self._iterations_key} {self.stepper.snes.getTolerances()[3]})"
        self._repeated[why] = self._repeated.get(why, 0) + 1
        self._least = min(self._least, self.control.factor * self.control.step)

    @property
    def _iterations_key(self) -> str:
        """Where the limit of Newton's iterations stands."""
        return "-snes_max_it" if is_set("snes_max_it") else "solver.max_iterations"

    @property
    def note_of_repeats(self) -> str:
        """How many attempts so far were repeated with a smaller step, and why; nothing if none was."""
        if not self._repeated:
            return ""
        times = sum(self._repeated.values())
        often = sorted(self._repeated.items(), key=lambda each: -each[1])
        reasons = "; ".join(f"{why}: {count} times" if count > 1 else f"{why}: once" for why, count in often)
        what, unit = ("Δt", " s") if self.problem.system.integrator.dynamic else ("increment", "")
        note = f"{times} {'attempt was' if times == 1 else 'attempts were'} repeated with a smaller {what}, "
        note += f"down to {self._least:.3g}{unit} ({reasons})"
        if self.scene.time.adaptive or not self.problem.system.integrator.dynamic:
            return note
        planned = math.ceil(self.time / self.control.step * (1.0 - 1e-9))
        return f"{note}; {self.step_number} steps were taken where {planned} of the full Δt would do"

    def _explain(self, attempt: Attempt, end: float) -> Failure:
        """Why the last attempt at a step failed; collective."""
        problem, scene, stuck = self.problem, self.scene, attempt.stuck
        assert stuck is not None
        system, outline, stepper = problem.system, problem.outline, self.stepper
        diagnosis = diagnose(
            problem.points, problem.membrane, system.held, stuck, system.x, system.mass, problem.tags
        )
        near = worst_pair(system)
        between_sheets = near is not None and not near.obstacle
        room = [more_room(near, scene)] if near is not None and near.blocks else []
        now = Circumstances(
            dt=end - self.time,
            nominal=self.control.step,
            spacing=outline.spacing,
            floor=self.roundoff,
            max_iterations=stepper.snes.getTolerances()[3],
            iterations_key=self._iterations_key,
            linear_iterations=stepper.ksp.getTolerances()[3],
            preconditioner=stepper.ksp.getPC().getType(),
            ranks=self.comm.size,
        )
        return Failure(
            step=self.step_number + 1,
            time=self.time,
            dt=now.dt,
            static=not system.integrator.dynamic,
            kind=trouble(diagnosis, stuck),
            tried=self._tried,
            diagnosis=diagnosis,
            advice=[
                *([f"a smaller {stepper.stopped_by}, or none"] if stepper.stopped_by else []),
                # forces grow without bounds where parts would pass, whatever the numbers of the scene
                *(room or advice(diagnosis, stuck, scene, now)),
            ],
            sources=outline.sources,
            stuck=stuck,
            near=near,
            obstacle=nearest_obstacle(system) if between_sheets else None,
        )

    def memory(self) -> dict[str, Any]:
        """What a checkpoint must hold beside positions and velocities to go on as if never stopped."""
        equilibrium = self._equilibrium
        return {
            "time": self.time,
            "step": self.step_number,
            "budget": self.ledger.memory()[1],
            "totals": dict(self.totals),
            "stability": self.stability,
            "repeated": dict(self._repeated),
            "least": self._least if self._repeated else None,
            "notes": list(self.notes),
            "told": sorted(self._told),
            **self.control.memory(),
            "estimated_error": self.estimated_error,
            "integrator": self._numbers(),
            **self.stepper.memory(self.time)[1],
            **({} if equilibrium is None else {"equilibrium": equilibrium.memory(self.time)[1]}),
            "energy": None if self.guard is None else self.guard.memory(),
            "late_starts": sorted(self.problem.system.reference.late),
        }

    def _numbers(self) -> dict[str, float]:
        numbers = self.problem.system.integrator.memory()[1]
        return numbers if self.local_error is None else numbers | self.local_error.memory()[1]

    def arrays(self) -> dict[str, Array]:
        """Arrays of rows (n_owned, 3) that a checkpoint must hold beside positions and velocities."""
        arrays = dict(self.problem.system.integrator.memory()[0])
        arrays |= self.ledger.memory()[0] | self.stepper.memory(self.time)[0]
        if self._equilibrium is not None:
            arrays |= self._equilibrium.memory(self.time)[0]
        if self.local_error is not None:
            arrays |= self.local_error.memory()[0]
        return arrays

    def resume(
        self,
        memory: Mapping[str, Any],
        arrays: Mapping[str, Array],
        edges: Mapping[str, Array] = MappingProxyType({}),
        elements: Mapping[str, tuple[Ints, Array]] = MappingProxyType({}),
    ) -> None:
        """Go on from a state already put into ``problem.system`` (x and v of owned rows)."""
        system = self.problem.system
        system.state.update_ghosts()
        term_memory.restore_fixed(system, edges, elements)
        self.time, self.step_number = float(memory["time"]), int(memory["step"])
        # loads and handles that a changed scene lets start before now start here; the others have started
        system.set_references(self.time)
        system.hold_targets(self.time)
        refuse_contact(system, self.scene, f"at {self._now()}")
        self.ledger.restore(arrays, memory["budget"])
        self.control.restore(memory)
        if self._equilibrium is not None:
            self._equilibrium.restore(arrays, memory.get("equilibrium", {}), self.time)
        self.estimated_error = float(memory["estimated_error"])
        system.integrator.restore(arrays, memory["integrator"])
        if self.guard is not None and memory.get("energy"):  # older ones have none
            same = memory.get("scheme") == self.scene.time.scheme
            self.guard.restore(memory["energy"], same=same)
        if self.local_error is not None:
            self.local_error.restore(arrays, memory["integrator"])
        term_memory.restore_changing(system, arrays, elements)
        self.stepper.restore(arrays, memory, self.time, self.step_number)
        self.totals |= {name: int(number) for name, number in memory.get("totals", {}).items()}
        self.stability = self.stability and memory.get("stability", self.stability)
        self._repeated = {str(why): int(count) for why, count in memory.get("repeated", {}).items()}
        self._least = math.inf if memory.get("least") is None else float(memory["least"])
        self._told |= set(memory.get("told", ()))
        earlier = [str(note) for note in memory.get("notes", ())]
        self.earlier_notes = len(earlier)
        self.notes[:] = [*earlier, *(note for note in self.notes if note not in earlier)]

    def destroy(self) -> None:
        """Free all PETSc and MPI objects, take back the scene's PETSc options; collective."""
        self.stepper.destroy()
        self.problem.discretisation.destroy()
        self._take_back_options()

    def _take_back_options(self) -> None:
        for name in self._filled:
            PETSc.Options().delValue(name)
