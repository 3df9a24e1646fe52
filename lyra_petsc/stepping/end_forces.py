"""Works by the mean of the forces at both ends of a step, and the energy that a step gains beyond them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.energy_balance import EnergyBalance
from lyra_petsc.stepping.newton.force_scales import ROUNDOFF
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.term import Elastic, Load


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
        self._springs = [term for term in equations.active.external if not term.registration.of_contact]
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
        work, rise = self._friction_works(ends)
        work += self._load_work(ends, moved) + self._handle_work(ends, moved, damping)
        if self._drift.any():
            work += equations.step.dt * float(self._force_of_targets(ends) @ self._drift)
        doubt = self._doubt(ends) if equations.active.varying else 0.0
        # rounded positions at both ends of a step differ in energy, and in velocity
        largest = max(float(x1.max(initial=0.0)), -float(x1.min(initial=0.0)))
        stiff = (self._stiffness_sum + float(equations.mass.sum()) / equations.step.dt**2) * largest**2
        energies = *self._energies(ends[0]), *self._energies(ends[1])
        sums = layout.global_sum(*energies, work, rise, stiff, uniform_heat, doubt).tolist()
        free0, all0, potential0, free1, all1, potential1, work, rise, stiff, warm, doubt = sums
        work += 0.5 * (account.moved_at_start + account.moved)
        before, after = account.before, account.after
        rise += after.elastic - before.elastic
        more = warm - account.damping_heat if uniform else 0.0
        heat = account.heat + more
        energy0, energy1 = all0 + before.elastic, all1 + after.elastic
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

    def _friction_works(self, ends: tuple[StepEndState, StepEndState]) -> tuple[float, float]:
        """Work [J] of obstacles that move along the sheet, and change of the energy that friction stores."""
        work, rise = 0.0, 0.0
        for term in self._equations.active.sliding:
            energies = [float(term.energies(end.x, end.frozen[term]).sum()) for end in ends]
            rise += energies[1] - energies[0]
            work += term.work_of_targets(*zip(*((end.x, end.frozen[term]) for end in ends), strict=True))
        return work, rise

    def _force_of_targets(self, ends: tuple[StepEndState, StepEndState]) -> Array:
        """Force (3,) [N] of the sheet on targets and obstacles in the step."""
        equations, force, sliding = self._equations, np.zeros_like(ends[0].x), self._equations.active.sliding
        for end in ends:
            for term in equations.active.targets:
                term.add_gradient(end.x, end.frozen[term], force)
            for term in equations.active.barriers:
                term.add_gradient(end.x, term.freeze(equations.targets_at(end.time, end.x)), force)
        force *= 0.5
        for term in sliding:  # by the force at the stage, which the impulses complete
            term.add_gradient(equations.evaluated.x, equations.step.frozen[term], force)
        total: Array = force[: equations.points.n_vertices].sum(axis=0)
        total += equations.contact_end.impulses.loads[:, :3].sum(axis=0)
        return total

    def _load_work(self, ends: tuple[StepEndState, StepEndState], moved: Array) -> float:
        """Work [J] of springs, wind and loads without a potential on this rank's free coordinates."""
        equations, n = self._equations, len(moved)
        forces = [load for load in equations.active.loads if not load.registration.energy]
        if not (forces or self._springs or equations.active.viscous):
            return 0.0
        force, against = np.zeros_like(ends[1].x), np.zeros_like(ends[1].x)
        for end in ends:
            for load in forces:
                load.add_force(equations.targets_at(end.time, end.x), force)
            for spring in self._springs:
                spring.add_gradient(end.x, end.frozen[spring], against)
        force = (force - against)[:n]
        if equations.active.viscous:
            start = self._start.get("wind")
            force -= self._wind(ends[0], n) if start is None else start
            self._end["wind"] = wind = self._wind(ends[1], n)
            force -= wind
        free = np.where(equations.step.prescribed.free, moved, 0.0)
        return 0.5 * float(np.vdot(force, free))

    def _varying_force(self, end: StepEndState, time: float) -> Array:
        """Force (n_local, 3) [N] at an end of the step of the loads that change in time, at a time [s]."""
        step, force, against = (
            self._equations.targets_at(time, end.x),
            np.zeros_like(end.x),
            np.zeros_like(end.x),
        )
        for term in self._equations.active.varying:
            if isinstance(term, Load):
                term.add_force(step, force)
            else:
                term.add_gradient(end.v, term.freeze(step), against)
        return force - against

    def _doubt(self, ends: tuple[StepEndState, StepEndState]) -> float:
        """Δt Δf · Δv/12 [J] of this rank's free coordinates, Δf the change of the loads in time alone."""
        equations, (start, end) = self._equations, ends
        before, after = (self._varying_force(end, time) for time in (start.time, end.time))
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
        """Work [J] of exact handles on this rank, by the reactions to the sheet's forces and weight;
        collective.
        """
        equations, step = self._equations, self._equations.step
        at = step.prescribed.indices
        displacement = moved.take(at)
        if not any(equations.points.global_max(bool(displacement.any()))):
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
