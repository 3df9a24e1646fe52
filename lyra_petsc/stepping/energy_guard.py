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

Backward Euler has an identity instead, in which W is the work of the forces at the end of the step::

    Δ(T + U + V) + D − W = −½ ‖Δv‖²_M + bracket        bracket = U(x_{n+1}) − U(x_n) − ∇U(x_{n+1})·Δx

so that it gains energy only where U is not convex. Its steps are judged by the smaller of the two gains: if
air brakes a sheet within a step, the force at its start times the displacement exceeds the work by far.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.energy_balance import Budget, Works
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.state import kinetic_energy, resized
from lyra_petsc.terms.registry import Role
from lyra_petsc.terms.term import Elastic, UpcomingStep

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

ROUND_OFF = 10.0 * float(np.finfo(np.float64).eps)
"""Relative round-off of a sum of energies."""


@dataclass
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


@dataclass(frozen=True)
class Balance:
    """Energy balance of a step [J], the same on every rank.

    Attributes
    ----------
    gain : float
        G.
    work, heat : float
        W, D.
    potential_before, potential : float
        V at both ends of the step.
    stored_before, stored : float
        T + U at both ends, with the coordinates that handles drive. These energies, V and W are those of the
        observer who moves with the initial velocity.
    inertia, bracket : float
        ½ ‖Δv‖²_M, and this plus the change of energy that the work of the stage's forces does not explain.
    noise : float
        Round-off of the gain.
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


class EnergyGuard:
    """Judges the steps of a motion; collective, and the same on all ranks.

    Parameters
    ----------
    system : StageEquations
    drift : (3,)
        The scene's initial velocity [m/s].
    """

    def __init__(self, system: StageEquations, drift: Sequence[float]) -> None:
        self._system = system
        elastic = system.active.elastic
        self._targets = [t for t in elastic if t.moving or t.registration.role is Role.CONSTRAINT]
        self._plain = [term for term in elastic if term not in self._targets]
        self._weights = [load for load in system.active.loads if load.registration.energy]
        self._forces = [load for load in system.active.loads if not load.registration.energy]
        self._pull: tuple[float, Array] | None = None
        self._next_pull: tuple[float, Array] | None = None
        self._stiffness: float | None = None
        self.gains = GuardState()
        self._drift = np.array(drift)

    # -- a step ------------------------------------------------------------------------------------

    def balance(self, x0: Array, v0: Array, before: Budget, after: Budget, works: Works) -> Balance:
        """Balance of the step just taken from x0, v0 (n_local, 3), by the energies before and after it and
        its works; collective.
        """
        system = self._system
        layout, n = system.points, system.points.n_owned
        if system.discretisation.stencils_change:  # ghosts may have changed in the step
            x0, v0 = resized(x0, n, layout.n_local), resized(v0, n, layout.n_local)
            for values in (x0, v0):
                layout.update_ghosts(values)
        x1, v1, at = system.x, system.v, system.prescribed.indices
        change = kinetic_energy(system.mass, v1[:n] - v0[:n])
        moved = x1[:n] - x0[:n]
        moved[: layout.n_vertices] -= system.dt * self._drift
        works, extra_heat = self._with_least_heat(x0, x1, works)
        # kinetic energies of prescribed coordinates, which the budget includes
        driven = [0.5 * float(np.vdot(system.mass.take(at // 3), v.take(at) ** 2)) for v in (v0, v1)]
        work = self._load_work(x0, v0, x1, v1, moved)
        work += self._handle_work(x0, x1, moved, works)
        targets = self._target_energies(x0, x1)
        largest = max(float(x1.max(initial=0.0)), -float(x1.min(initial=0.0)))
        # rounded positions at both ends of a step differ in energy, and in velocity
        stiff = (self._stiffness_sum + float(system.mass.sum()) / system.dt**2) * largest**2
        local = (*driven, change, work, *targets, works.target_energy, stiff, extra_heat)
        sums = [float(value) for value in layout.global_sum(*local)]
        driven0, driven1, change, work, elastic, by_targets, *springs, moving, stiff, extra_heat = sums
        work += by_targets
        drift0, drift1, pushed, lifted, by_drift = self._of_drift(x0, v0, v1)
        work += by_drift
        kinetic = (after.kinetic - driven1) - (before.kinetic - driven0) - pushed
        potential0, potential1 = before.potential - lifted * system.t0, after.potential - lifted * system.t1
        elastic += after.elastic - before.elastic - moving
        heat = works.heat + extra_heat
        gain = kinetic + elastic + potential1 - potential0 + heat - work
        energy = after.kinetic - drift1 + after.elastic + springs[1]
        energy_before = before.kinetic - drift0 + before.elastic + springs[0]
        sizes = energy + energy_before + before.kinetic + after.kinetic
        sizes += abs(work) + abs(heat) + abs(before.potential) + abs(after.potential)
        noise = ROUND_OFF * (sizes + math.sqrt(2.0 * abs(energy) * stiff) + ROUND_OFF * stiff)
        unexplained = after.total - before.total + heat - works.external
        return Balance(
            gain=gain,
            work=work,
            heat=heat,
            potential_before=potential0,
            potential=potential1,
            stored_before=energy_before,
            stored=energy,
            inertia=change,
            bracket=unexplained + change,
            noise=noise,
        )

    def _of_drift(self, x0: Array, v0: Array, v1: Array) -> tuple[float, float, float, float, float]:
        """What the drift adds in a step from x0 and v0 to v1 (n_local, 3); collective.

        Kinetic energy [J] at both ends, its change in free coordinates, power [W] against the weight, and the
        work [J] of targets and obstacles, by the mean of their forces at both ends, to be subtracted.
        """
        if not self._drift.any():
            return 0.0, 0.0, 0.0, 0.0, 0.0
        system, drift, mass = self._system, self._drift, self._system.mass
        x1, rows = system.x, slice(0, system.points.n_vertices)
        momenta = [float((mass @ (v[: len(mass)] - 0.5 * drift)) @ drift) for v in (v0, v1)]
        change = np.where(system.prescribed.free, (v1 - v0)[: len(mass)], 0.0)
        lifted = sum(load.potential(x0 + drift) - load.potential(x0) for load in self._weights)
        force = np.zeros_like(x1)
        near = [term for term in self._plain if term.detects_collisions]
        for x, time in ((x0, system.t0), (x1, system.t1)):
            both = [term for term in (*self._targets, *near) if not term.slips]
            for term, frozen in self._frozen(both, time, x).items():
                term.add_gradient(x, frozen, force)
        stage = np.zeros_like(x1)
        for term in system.active.changing:
            if term.slips:  # by the force at the stage, which the impulses complete
                term.add_gradient(system.stage_positions, system.active.frozen[term], stage)
        force += 2.0 * stage
        by_targets = 0.5 * system.dt * float(force[rows].sum(axis=0) @ drift)
        if system.contact_impulses:
            by_targets += system.dt * float(system.contact_impulses.loads[:, :3].sum(axis=0) @ drift)
        sums = system.points.global_sum(*momenta, float((mass @ change) @ drift), lifted, by_targets)
        first, last, pushed, lifted, by_targets = map(float, sums)
        return first, last, pushed, lifted, by_targets

    def _with_least_heat(self, x0: Array, x1: Array, works: Works) -> tuple[Works, float]:
        """Works with the damping forces of uniform motion from x0 to x1 (n_local, 3), and the heat [J] of
        that motion on this rank, less the heat in ``works``.
        """
        system = self._system
        if not system.damping.active or system.integrator.order == 1 or system.integrator.moves_uniformly:
            return works, 0.0
        moved = x1 - x0
        # at the middle, the displacements of a rotation cause no strain
        force = system.damping.product_at(0.5 * (x0 + x1), moved / system.dt)
        heat = float(np.vdot(force, moved[: len(force)]))
        return replace(works, damping=force.take(system.prescribed.indices)), heat - works.damping_heat

    def _frozen(self, terms: Iterable[Elastic], at: float, x: Array) -> dict[Elastic, Any]:
        """Per-step data of terms, with their targets at time ``at`` [s] of the step."""
        system = self._system
        step = UpcomingStep(system.t0, system.t1, at, x, system.reference.at)
        return {term: term.freeze(step) for term in terms}

    def _target_energies(self, x0: Array, x1: Array) -> tuple[float, float, float, float]:
        """Energies [J] of this rank's terms with targets: their change, the work of the targets' motion, and
        the energy of springs at both ends.
        """
        system, rise, springs = self._system, 0.0, [0.0, 0.0]
        work = system.contact_impulses.work if system.contact_impulses else 0.0
        for term in system.active.pushing:
            for x, time in ((x0, system.t0), (x1, system.t1)):
                work += 0.5 * term.work(x, time, system.t0, system.t1)
        turning = [t for t in self._targets if t.n_elements and t not in system.active.pushing]
        first = self._frozen(turning, system.t0, x0)
        last = self._frozen(turning, system.t1, x1)
        for term in turning:
            frozen = first[term], last[term]
            before, after = (float(term.energies(x, f).sum()) for x, f in zip((x0, x1), frozen, strict=True))
            rise += after - before
            work += term.work_of_targets((x0, x1), frozen)
            if not term.registration.energy:
                springs = [springs[0] + before, springs[1] + after]
        return rise, work, springs[0], springs[1]

    def _load_work(self, x0: Array, v0: Array, x1: Array, v1: Array, moved: Array) -> float:
        """Work [J] of wind and of loads without a potential on this rank's free coordinates, by the mean of
        the forces at both ends of the step.
        """
        system = self._system
        if not (self._forces or system.active.viscous):
            return 0.0
        t0, t1 = system.t0, system.t1
        force = np.zeros_like(x1)
        for x, v in ((x0, v0), (x1, v1)):
            for load in self._forces:
                if load.is_follower or x is x1:
                    load.add_force(x, t0, t1, force)
                    if not load.is_follower:
                        load.add_force(x, t0, t1, force)
            wind = np.zeros_like(force)
            for term in system.active.viscous:
                term.add_gradient(v, term.freeze(UpcomingStep(t0, t1, t0, x, system.reference.at)), wind)
            force -= wind
        free = np.where(system.prescribed.free, moved, 0.0)
        return 0.5 * float(np.vdot(force[: len(free)], free))

    def _handle_work(self, x0: Array, x1: Array, moved: Array, works: Works) -> float:
        """Work [J] of exact handles on this rank, by the mean of the reactions to the sheet's forces and
        weight at both ends of the step.
        """
        system, self._next_pull = self._system, None
        at = system.prescribed.indices
        displacement = moved.take(at)
        if not displacement.any():  # max_gain handles stand still
            return 0.0
        n = system.points.n_owned
        if self._pull is None or self._pull[0] != system.t0:
            self._pull = system.t0, system.gradient_of(self._plain, x0)
        self._next_pull = system.t1, system.gradient_of(self._plain, x1)
        force = 0.5 * (self._pull[1] + self._next_pull[1]).take(at)
        targets = np.zeros_like(x1)
        for time, x in ((system.t0, x0), (system.t1, x1)):
            for term, frozen in self._frozen(self._targets, time, x).items():
                term.add_gradient(x, frozen, targets)
        weight = np.zeros_like(x1)
        for load in self._weights:
            load.add_force(x1, system.t0, system.t1, weight)
        force += 0.5 * targets[:n].take(at) - weight[:n].take(at) + works.damping
        if system.contact_impulses:
            force += system.contact_impulses.handle_force
        return float(np.vdot(force, displacement))

    @property
    def _stiffness_sum(self) -> float:
        """Sum [N/m] of the stiffnesses of this rank's elements."""
        if self._stiffness is None:
            self._stiffness = sum(float(each.sum()) for each in self._system.objective.stiffnesses.values())
        return self._stiffness

    # -- the verdict -------------------------------------------------------------------------------

    def accept(self, step: Balance) -> bool:
        """Whether the step is accepted; if so, it is recorded. The same on all ranks; collective."""
        new = self._updated(step)
        over = self._system.integrator.gain_window
        # a step without a gain of its own would not improve the mean if it were shorter
        of_step = min(math.fsum(new.recent[-over:]) / min(over, len(new.recent)), new.recent[-1])
        of_steps = max(new.total, math.fsum(new.recent))
        self._judged = of_step, of_steps, new.scale
        impact = self._system.has_active_pairs and self._system.integrator.order > 1
        max_gain, max_sum = (IMPACT_GAIN, IMPACT_SUM) if impact else (LARGEST_GAIN, LARGEST_SUM)
        accepted = of_step <= max(max_gain * new.scale, step.noise)
        # repeating a step without a gain would not reduce the sum
        accepted &= of_steps <= max(max_sum * new.scale, new.noise) or new.recent[-1] <= step.noise
        accepted = bool(self._system.points.comm.bcast(accepted, root=0))
        if accepted:
            self.gains, self._pull = new, self._next_pull
        else:
            self.gains.repeated += 1
        return accepted

    @property
    def _is_backward_euler(self) -> bool:
        """Whether the integrator is backward Euler, which has the identity."""
        return self._system.integrator.name == "beuler"

    def _updated(self, step: Balance) -> GuardState:
        """State of the guard after accepting a step."""
        old = self.gains
        start = step.potential_before if old.start is None else old.start
        judged = step.gain
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
            recent=_append_gain(old.recent, judged, self._system.integrator.gain_window)[-RECENT:],
            repeated=old.repeated,
            noise=old.noise + step.noise,
        )

    # -- messages ----------------------------------------------------------------------------------

    @property
    def message(self) -> str:
        """The gain of the step judged last."""
        of_step, of_steps, scale = self._judged
        if not (math.isfinite(scale) and math.isfinite(of_step)):
            return "makes energy without bounds"
        share, what = of_step / scale, ""
        if share <= LARGEST_GAIN and of_steps > of_step:
            share, what = of_steps / scale, " in the steps so far"
        return f"makes {100.0 * share:.2g} % of the energy at work out of nothing{what}"

    @property
    def remedy(self) -> str:
        """Advice for a message: another integrator, or a change of steps, damping or mesh."""
        name = self._system.integrator.name
        other = ALTERNATIVES.get(name)
        if other:
            return f"time.integrator: {other}"
        return "a smaller time.step, more material.damping, or a finer mesh where the sheet buckles"

    def content(self) -> dict[str, Any]:
        """Entry of summary.json: energies as fractions of the scale, which is in J."""
        gains, scale = self.gains, self.gains.scale or 1.0
        found: dict[str, Any] = {
            "scale": gains.scale,
            "numerical_dissipation": gains.lost / scale,
            "numerical_gain": gains.won / scale,
            "repeated": gains.repeated,
        }
        if self._is_backward_euler:
            found["identity"] = {
                "velocity_changes": gains.inertia / scale,
                "bracket": gains.bracket / scale,
            }
        return found

    # -- checkpoints -------------------------------------------------------------------------------

    def saved_state(self) -> dict[str, Any]:
        """Entry of a checkpoint."""
        return asdict(self.gains)

    def restore(self, saved: Mapping[str, Any], *, same: bool) -> None:
        """Restore a `saved_state`; without its gains if the integrator is another (not ``same``)."""
        self.gains = GuardState(**saved)
        if not same:
            self.gains.total, self.gains.recent = 0.0, []


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
