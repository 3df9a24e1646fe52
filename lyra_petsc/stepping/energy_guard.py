"""Energy guard: rejects steps in which the integrator creates energy.

The gain of a step is ::

    G = Δ(T + U + V) + D − W

with the kinetic energy T of the free coordinates, all elastic energies U (springs and clamps too), the
potential V of gravity, the heat D of material damping and the work W of handles, loads and wind.

W is computed by the trapezoidal rule: half the sum of the forces at both ends of the step, wind and pressure
with the geometry there, times the displacement. (With the integrator's own forces, at its stage, a run that
blows up balances, too.) The work of a moving target is the change of stored energy by its motion, averaged
over both ends, which for springs is the same rule. If the velocity of the integrator's stage is not Δx/Δt, D
is the heat of uniform motion between the ends, with the geometry at its middle. It is the smallest heat that
any motion makes; after a start from rest, the heat at the stage is several times as large. G is compared with
the scale ::

    S = largest value so far of T + U + |V − V₀| + Σ|W| + ΣD

whose T includes the coordinates that handles drive: if these start gently, little else moves at first. T, V
and W are those of an observer who moves with the scene's initial velocity: a sheet whose surroundings drift
along with it is judged as one at rest. (Another observer finds another G, as the trapezoidal rule does not
give the change of momentum.) G < 0 is numerical dissipation, which is allowed and summed up.

Of loads that change in time by Δf at fixed positions and velocities, the trapezoidal rule leaves
Δt |Δf · Δv|/12 open, the difference to the integral for a velocity that is linear in time: at the start of a
ramp half of W. A gain within that is none.

Backward Euler has an identity instead, in which W is the work of the forces at the end of the step::

    Δ(T + U + V) + D − W = −½ ‖Δv‖²_M + bracket        bracket = U(x_{n+1}) − U(x_n) − ∇U(x_{n+1})·Δx

so that it gains energy only where U is not convex. Its steps are judged by the smaller of the two gains: if
air brakes a sheet within a step, the force at its start times the displacement exceeds the work by far.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.energy_balance import EnergyBalance, varying_force
from lyra_petsc.stepping.newton.force_scales import ROUNDOFF
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.protocols import MovingTargets
from lyra_petsc.terms.term import Elastic

LARGEST_GAIN = 0.01
"""Gain of a step over S above which the step is repeated."""

LARGEST_SUM = 0.05
"""Sum of the gains since the start, or of the last `RECENT` steps, over S, above which a step is repeated."""

IMPACT_GAIN, IMPACT_SUM = 1e-3, 0.01
"""The same bounds for integrators of second order during contact, where backward Euler can take over."""

RECENT = 20
"""Number of last steps whose gains are summed."""

ALTERNATIVES = {"midpoint": "bdf2", "alpha2": "bdf2", "bdf2": "beuler", "semi-implicit": "beuler"}
"""The integrator to recommend in place of one that creates energy."""


@dataclass(frozen=True)
class Gain:
    """Gain of a step and what it consists of [J], the same on every rank.

    Attributes
    ----------
    gain : float
        G.
    work, heat : float
        W, D.
    potential_before, potential : float
        V at both ends of the step.
    stored_before, stored : float
        T + U at both ends, with the coordinates that handles drive.
    inertia, bracket : float
        ½ ‖Δv‖²_M, and this plus the change of energy that the work of the stage's forces does not explain.
    noise : float
        Round-off of the gain.
    doubt : float
        Part of the work that the trapezoidal rule leaves open.
    """

    gain: float
    work: float
    heat: float
    potential_before: float
    potential: float
    stored_before: float
    stored: float
    inertia: float
    bracket: float
    noise: float
    doubt: float = 0.0


class StepEndState(NamedTuple):
    """One end of a step: x, v (n_local, 3) at a time [s], and the terms' data with their targets there."""

    x: Array
    v: Array
    time: float
    frozen: dict[Elastic, Any]


class EndForces:
    """Works by the mean of the forces at both ends of a step, for an observer with the initial velocity;
    collective.

    Parameters
    ----------
    equations : StageEquations
    drift : (3,)
        The initial velocity [m/s].
    """

    def __init__(self, equations: StageEquations, drift: Sequence[float]) -> None:
        self._equations = equations
        elastic = equations.active.elastic
        self._targets = [*equations.active.moving, *equations.active.external]
        self._plain = [term for term in elastic if term not in self._targets]
        self._weights = [load for load in equations.active.loads if load.registration.energy]
        self._drift = np.array(drift)
        # forces at the start of the step, if known as those at the end of the last, and at its end: gradients
        # of ``_plain``, and forces of the wind
        self._start: dict[str, Array] = {}
        self._end: dict[str, Array] = {}

    def keep_end(self) -> None:
        """The present step is accepted: the next starts where it ends."""
        self._start = self._end

    def forget(self) -> None:
        """The next step starts from another state."""
        self._start = {}

    def gain(self, x0: Array, v0: Array, ledger: EnergyBalance) -> Gain:
        """Gain of the step just taken from x0, v0 (n_local, 3), whose account the ledger has."""
        equations, layout = self._equations, self._equations.points
        if equations.discretisation.stencils_change:  # ghosts may have changed in the step
            x0, v0 = (layout.extended(values) for values in (x0, v0))
        ends = self._at(x0, v0, equations.step.start), self._at(equations.x, equations.v, equations.step.end)
        x1, n, self._end = equations.x, layout.n_owned, {}
        moved = x1[:n] - x0[:n]
        moved[: layout.n_vertices] -= equations.step.dt * self._drift
        account, damping, uniform_heat = ledger.account, ledger.damping, 0.0
        if uniform := self._moves_otherwise:
            # at the middle, the displacements of a rotation cause no strain
            force = equations.damping.product_at(0.5 * (x0 + x1), (x1 - x0) / equations.step.dt)
            damping = force.take(equations.step.prescribed.indices)
            uniform_heat = float(np.vdot(force, (x1 - x0)[: len(force)]))
        work, *of_targets = self._target_works(ends)
        work += self._load_work(ends, moved) + self._handle_work(ends, moved, damping)
        doubt = self._doubt(ends) if equations.active.varying else 0.0
        # rounded positions at both ends of a step differ in energy, and in velocity
        largest = max(float(x1.max(initial=0.0)), -float(x1.min(initial=0.0)))
        stiff = (self._stiffness_sum + float(equations.mass.sum()) / equations.step.dt**2) * largest**2
        energies = *self._energies(ends[0]), *self._energies(ends[1])
        sums = layout.global_sum(*energies, work, *of_targets, stiff, uniform_heat, doubt).tolist()
        free0, all0, potential0, free1, all1, potential1, work, rise, springs0, springs1 = sums[:10]
        stiff, warm, doubt = sums[10:]
        work += 0.5 * (account.obstacle_work_at_start + account.obstacle_work)
        before, after = account.before, account.after
        rise += (after.elastic - account.moving) - (before.elastic - account.moving_before)
        more = warm - account.damping_heat if uniform else 0.0
        heat = account.heat + more
        energy0, energy1 = all0 + before.elastic + springs0, all1 + after.elastic + springs1
        sizes = energy0 + energy1 + before.kinetic + after.kinetic + abs(work) + abs(heat)
        sizes += abs(before.potential) + abs(after.potential)
        return Gain(
            gain=free1 - free0 + rise + potential1 - potential0 + heat - work,
            work=work,
            heat=heat,
            potential_before=potential0,
            potential=potential1,
            stored_before=energy0,
            stored=energy1,
            inertia=account.inertia,
            bracket=account.bracket + more,
            noise=ROUNDOFF * (sizes + math.sqrt(2.0 * abs(energy1) * stiff) + ROUNDOFF * stiff),
            doubt=abs(doubt),
        )

    def _at(self, x: Array, v: Array, time: float) -> StepEndState:
        """The end of the step with x, v (n_local, 3) at ``time`` [s]."""
        upcoming = self._equations.targets_at(time, x)
        return StepEndState(x, v, time, {term: term.freeze(upcoming) for term in self._targets})

    def _energies(self, end: StepEndState) -> tuple[float, float, float]:
        """Kinetic energy [J] of this rank's free coordinates, and of all, and V."""
        equations, x = self._equations, end.x
        at, square = equations.step.prescribed.indices, np.square(end.v[: len(equations.mass)] - self._drift)
        driven, whole = (
            np.vdot(equations.mass.take(at // 3), square.take(at)),
            np.sum(equations.mass @ square),
        )
        if self._drift.any():
            x = x - end.time * self._drift
        potential = sum(load.potential(x) for load in self._weights)
        return 0.5 * float(whole - driven), 0.5 * float(whole), potential

    @property
    def _moves_otherwise(self) -> bool:
        """Whether velocities other than those of uniform motion between the ends damp the material."""
        integrator = self._equations.integrator
        return self._equations.damping.active and integrator.order > 1 and not integrator.moves_uniformly

    def _target_works(self, ends: tuple[StepEndState, StepEndState]) -> tuple[float, float, float, float]:
        """Work [J] of the motion of targets relative to the observer, change of the energies of this rank's
        terms with targets, and energy of springs at both ends.
        """
        equations, rise, work, springs = self._equations, 0.0, 0.0, [0.0, 0.0]
        sliding, obstacles = equations.active.sliding, equations.active.obstacles
        for term in self._targets:
            if term in obstacles:
                continue
            if isinstance(term, MovingTargets) and term.is_stiff:
                (at0, pull0), (at1, pull1) = (term.targets(end.x, end.frozen[term]) for end in ends)
                work += 0.5 * float(np.vdot(pull0 + pull1, at1 - at0))
                continue
            # by positions at both ends, and targets at both
            table = [[float(term.energies(end.x, at.frozen[term]).sum()) for at in ends] for end in ends]
            (before, later), (earlier, after) = table
            rise += after - before
            if term in sliding:
                work += sliding[0].work_of_targets(
                    (ends[0].x, ends[1].x), (ends[0].frozen[term], ends[1].frozen[term])
                )
            else:  # the change of energy at fixed positions, averaged over both ends
                work += 0.5 * (later - before + after - earlier)
            if not term.registration.energy:
                springs = [springs[0] + before, springs[1] + after]
        if self._drift.any():
            work += equations.step.dt * float(self._force_of_targets(ends) @ self._drift)
        return work, rise, springs[0], springs[1]

    def _force_of_targets(self, ends: tuple[StepEndState, StepEndState]) -> Array:
        """Force (3,) [N] of the sheet on targets and obstacles in the step."""
        equations, force, sliding = self._equations, np.zeros_like(ends[0].x), self._equations.active.sliding
        barriers = [term for term in equations.active.of_contact if term not in sliding]
        for end in ends:
            for term in self._targets:
                if not term.registration.of_contact:
                    term.add_gradient(end.x, end.frozen[term], force)
            for term in barriers:
                term.add_gradient(end.x, term.freeze(equations.targets_at(end.time, end.x)), force)
        force *= 0.5
        for term in sliding:  # by the force at the stage, which the impulses complete
            term.add_gradient(equations.evaluated.x, equations.step.frozen[term], force)
        total: Array = force[: equations.points.n_vertices].sum(axis=0)
        total += equations.contact_end.impulses.loads[:, :3].sum(axis=0)
        return total

    def _load_work(self, ends: tuple[StepEndState, StepEndState], moved: Array) -> float:
        """Work [J] of wind and of loads without a potential on this rank's free coordinates."""
        equations, n = self._equations, len(moved)
        forces = [load for load in equations.active.loads if not load.registration.energy]
        if not (forces or equations.active.viscous):
            return 0.0
        force = np.zeros_like(ends[1].x)
        for load in forces:
            for end in ends:
                load.add_force(equations.targets_at(end.time, end.x), force)
        force = force[:n]
        if equations.active.viscous:
            start = self._start.get("wind")
            force -= self._wind(ends[0], n) if start is None else start
            self._end["wind"] = wind = self._wind(ends[1], n)
            force -= wind
        free = np.where(equations.step.prescribed.free, moved, 0.0)
        return 0.5 * float(np.vdot(force, free))

    def _doubt(self, ends: tuple[StepEndState, StepEndState]) -> float:
        """Δt Δf · Δv/12 [J] of this rank's free coordinates, Δf the change of the loads in time alone."""
        equations, (start, end) = self._equations, ends
        before, after = (varying_force(equations, end.x, end.v, time) for time in (start.time, end.time))
        free = equations.step.prescribed.free
        gained = np.where(free, (end.v - start.v)[: len(free)], 0.0)
        return equations.step.dt / 12.0 * float(np.vdot((after - before)[: len(free)], gained))

    def _wind(self, end: StepEndState, n: int) -> Array:
        """Gradient (n, 3) [N] of the wind's potential."""
        equations, out = self._equations, np.zeros_like(end.x)
        step = equations.targets_at(end.time, end.x)
        for term in equations.active.viscous:
            term.add_gradient(end.v, term.freeze(step), out)
        return out[:n]

    def _handle_work(self, ends: tuple[StepEndState, StepEndState], moved: Array, damping: Array) -> float:
        """Work [J] of exact handles on this rank, by the reactions to the sheet's forces and weight."""
        equations, step = self._equations, self._equations.step
        at = step.prescribed.indices
        displacement = moved.take(at)
        if not displacement.any():
            return 0.0
        start = self._start.get("pull")
        if start is None:
            start = equations.forces.sum(self._plain, ends[0].x, step.frozen)
        here = equations.here()
        self._end["pull"] = pull = equations.forces.sum(self._plain, here.x, here.frozen)
        targets, weight = np.zeros_like(ends[1].x), np.zeros_like(ends[1].x)
        for end in ends:
            for term in self._targets:
                term.add_gradient(end.x, end.frozen[term], targets)
        for load in self._weights:
            load.add_force(equations.targets_at(step.end), weight)
        force = 0.5 * ((start + pull).take(at) + targets.ravel()[at]) - weight.ravel()[at] + damping
        force += equations.contact_end.impulses.handle_force
        return float(np.vdot(force, displacement))

    @cached_property
    def _stiffness_sum(self) -> float:
        """Sum [N/m] of the stiffnesses of this rank's elements."""
        return sum(float(stiffness.sum()) for stiffness in self._equations.forces.stiffnesses.values())


@dataclass(frozen=True)
class GuardState:
    """State of the guard between steps; energies in J.

    Attributes
    ----------
    start : float or None
        V₀; None before the first step.
    scale : float
        S.
    total : float
        Sum of the gains since the start.
    lost, won : float
        Sums of the negative gains, as a positive number, and of the positive ones.
    work, heat : float
        Σ|W|, ΣD.
    inertia, bracket : float
        Sums Σ ½ ‖Δv‖²_M and of the brackets in backward Euler's identity.
    recent : list of float
        Gains of the last steps, the newest last, after `_append_gain`.
    repeated : int
        Number of rejected attempts.
    noise : float
        Sum of the round-off of the gains.
    """

    start: float | None = None
    scale: float = 0.0
    total: float = 0.0
    lost: float = 0.0
    won: float = 0.0
    work: float = 0.0
    heat: float = 0.0
    inertia: float = 0.0
    bracket: float = 0.0
    recent: list[float] = field(default_factory=list)
    repeated: int = 0
    noise: float = 0.0


class EnergyGuard:
    """Judges the steps of a motion; collective, and the same on all ranks.

    Parameters
    ----------
    equations : StageEquations
    drift : (3,)
        The scene's initial velocity [m/s].
    """

    def __init__(self, equations: StageEquations, drift: Sequence[float]) -> None:
        self._equations = equations
        self._forces = EndForces(equations, drift)
        self.gains = GuardState()

    def accept(self, x0: Array, v0: Array, ledger: EnergyBalance) -> bool:
        """Whether the step just taken from x0, v0 (n_local, 3), whose account the ledger has, is accepted; if
        so, it is recorded.
        """
        return self.judge(self._forces.gain(x0, v0, ledger))

    def forget_end(self) -> None:
        """The next step does not start where the last has ended."""
        self._forces.forget()

    def judge(self, step: Gain) -> bool:
        """Whether a step with this gain is accepted; if so, it is recorded."""
        new = self._updated(step)
        over = self._equations.integrator.gain_window
        # a step without a gain of its own would not improve the mean if it were shorter
        of_step = min(math.fsum(new.recent[-over:]) / min(over, len(new.recent)), new.recent[-1])
        of_steps = max(new.total, math.fsum(new.recent))
        self._judged = of_step, of_steps, new.scale
        impact = self._equations.has_active_pairs and self._equations.integrator.order > 1
        max_gain, max_sum = (IMPACT_GAIN, IMPACT_SUM) if impact else (LARGEST_GAIN, LARGEST_SUM)
        accepted = of_step <= max(max_gain * new.scale, step.noise)
        # repeating a step without a gain would not reduce the sum
        accepted &= of_steps <= max(max_sum * new.scale, new.noise) or new.recent[-1] <= step.noise
        accepted = not any(self._equations.points.global_max(not accepted))  # the same on all ranks
        if accepted:
            self.gains = new
            self._forces.keep_end()
        else:
            self.gains = replace(self.gains, repeated=self.gains.repeated + 1)
        return accepted

    @property
    def _is_backward_euler(self) -> bool:
        """Whether the integrator is backward Euler, which has the identity."""
        return self._equations.integrator.name == "beuler"

    def _updated(self, step: Gain) -> GuardState:
        """State of the guard after accepting a step."""
        old = self.gains
        start = step.potential_before if old.start is None else old.start
        judged = step.gain - min(max(step.gain, 0.0), step.doubt)
        if self._is_backward_euler:
            judged = min(judged, step.bracket - step.inertia)
        work, heat = old.work + abs(step.work), old.heat + step.heat
        return GuardState(
            start=start,
            scale=max(
                old.scale,
                step.stored_before + abs(step.potential_before - start),
                step.stored + abs(step.potential - start) + work + heat,
            ),
            total=old.total + judged,
            lost=old.lost + max(0.0, -step.gain),
            won=old.won + max(0.0, step.gain),
            work=work,
            heat=heat,
            inertia=old.inertia + step.inertia,
            bracket=old.bracket + step.bracket,
            recent=_append_gain(old.recent, judged, self._equations.integrator.gain_window)[-RECENT:],
            repeated=old.repeated,
            noise=old.noise + step.noise,
        )

    @property
    def message(self) -> str:
        """The gain of the step judged last."""
        of_step, of_steps, scale = self._judged
        if not (math.isfinite(scale) and math.isfinite(of_step)):
            return "makes energy without bounds"
        share, period = of_step / scale, ""
        if share <= LARGEST_GAIN and of_steps > of_step:
            share, period = of_steps / scale, " in the steps so far"
        return f"makes {100.0 * share:.2g} % of the energy at work out of nothing{period}"

    @property
    def remedy(self) -> str:
        """Advice for a message: another integrator, or a change of steps, damping or mesh."""
        name = self._equations.integrator.name
        other = ALTERNATIVES.get(name)
        if other:
            return f"time.integrator: {other}"
        return "a smaller time.step, more material.damping, or a finer mesh where the sheet buckles"

    def content(self) -> dict[str, Any]:
        """Entry of summary.json: energies as fractions of the scale, which is in J."""
        gains, scale = self.gains, self.gains.scale or 1.0
        content: dict[str, Any] = {
            "scale": gains.scale,
            "numerical_dissipation": gains.lost / scale,
            "numerical_gain": gains.won / scale,
            "repeated": gains.repeated,
        }
        if self._is_backward_euler:
            content["identity"] = {
                "velocity_changes": gains.inertia / scale,
                "bracket": gains.bracket / scale,
            }
        return content

    def saved_state(self) -> dict[str, Any]:
        """Entry of a checkpoint."""
        return asdict(self.gains)

    def restore(self, saved: Mapping[str, Any], *, same: bool) -> None:
        """Restore a `saved_state`; without its gains if the integrator is another (not ``same``)."""
        self.gains = GuardState(**saved)
        if not same:
            self.gains = replace(self.gains, total=0.0, recent=[])


def _append_gain(recent: list[float], gain: float, window: int) -> list[float]:
    """Gains of the last steps and a new one, balanced against the losses of the last ``window`` steps.

    Schemes of several steps give back in one step what they have taken in others; both must leave the list of
    recent gains together.
    """
    gains = list(recent)
    for i in range(len(gains) - 1, max(len(gains) - window, -1), -1):
        returned = min(max(gain, 0.0), max(-gains[i], 0.0))
        gains[i], gain = gains[i] + returned, gain - returned
    return [*gains, gain]
