"""Energies of the state and works of the steps.

Every work is a force times a displacement, with the force in the middle of the step. Moving targets, or the
gas in a volume, work by the forces on them, ∂E/∂λ, and the change Δλ of their places, or of its amount: these
forces, and those of moving obstacles, are the means of both ends. Forces of handles, loads and dampers are
known at the stage of a step: those in its middle are in line with this stage and the last one. What handles
do to accelerate their own vertices is the change of the kinetic energy of these: where velocities of handles
jump, the force is that of an impact, m Δv / Δt, and force times displacement twice that energy at any Δt.
With an integrator of first order they are those at the stage, for which backward Euler has the identity::

    Δ(kinetic + potential) = −½ ‖Δv‖²_M − Δt vᵀ D v + bracket + work of handles, loads and targets
    bracket = E(x_{n+1}, λ_{n+1}) − E(x_n, λ_n) − ∂E/∂x·Δx − ∂E/∂λ·Δλ at n + 1   (≤ 0 where E is convex)
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.directors import move_frames_to_end
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.state import kinetic_energy
from lyra_petsc.stepping.time_step import Evaluation
from lyra_petsc.terms.energies import ENERGIES
from lyra_petsc.terms.protocols import Dissipates, MovingTargets, PullsHandles

REDUCTIONS = {"sum": MPI.SUM, "min": MPI.MIN, "max": MPI.MAX}

ROWS = 1 << 13
"""Rows whose works are computed together."""


@dataclass(frozen=True)
class Budget:
    """Energies [J] at a state, and cumulative works [J] up to it.

    ``external_work`` is the work of handles, springs and loads other than gravity, ``dissipation`` the heat
    of material damping, of friction within the fabric and of impacts; ``more`` holds the energies of terms
    with their own column.
    """

    kinetic: float = 0.0
    membrane: float = 0.0
    bending: float = 0.0
    potential: float = 0.0
    external_work: float = 0.0
    dissipation: float = 0.0
    more: dict[str, float] = field(default_factory=dict)

    @property
    def elastic(self) -> float:
        """Energy [J] stored in the sheet."""
        return self.membrane + self.bending + sum(self.more.values())

    @property
    def total(self) -> float:
        """All energies [J] of the state."""
        return self.kinetic + self.elastic + self.potential


@dataclass(frozen=True)
class StepAccount:
    """Energies, works and heat [J] of a step, by the forces at its stage; the same on every rank.

    Attributes
    ----------
    before, after : Budget
        At both ends of the step.
    external : float
        Work of handles, springs, loads without a potential, moving targets and obstacles.
    moved_at_start, moved : float
        The part of targets and obstacles, by the forces at the start of the step, and at its end.
    heat, damping_heat, fabric_heat : float
        Heat of all dampers; of material damping, and of friction within the fabric.
    inertia : float
        ½ ‖Δv‖²_M of free coordinates in a step of backward Euler, with the velocities that solve it.
    """

    before: Budget
    after: Budget
    external: float
    moved_at_start: float
    moved: float
    heat: float
    damping_heat: float
    fabric_heat: float
    inertia: float

    @property
    def change(self) -> float:
        """Change of all energies."""
        return self.after.total - self.before.total

    @property
    def bracket(self) -> float:
        """The bracket of backward Euler's identity: what works by the forces at the end, heat and
        ½ ‖Δv‖²_M leave of the change."""
        by_end = self.external + 0.5 * (self.moved - self.moved_at_start)
        return self.change + self.heat - by_end + self.inertia


def _work_of(force: Array, x_before: Array, x: Array) -> float:
    """Work [J] of forces (n, 3) [N] over x - x_before, in parts to save memory."""
    x, parts = x[: len(force)], (slice(lo, lo + ROWS) for lo in range(0, len(force), ROWS))
    return sum(float(np.vdot(force[rows], x[rows] - x_before[rows])) for rows in parts)


@dataclass(frozen=True, eq=False)
class WorkingForces:
    """Forces at the stage of a step.

    Attributes
    ----------
    work, heat : (n_owned, 3)
        Force [N] of handles, but for the inertia of their vertices, of springs, friction and loads without a
        potential; force of material damping.
    ahead : float
        Time [s] from the stage to the end of the step.
    """

    work: Array
    heat: Array
    ahead: float

    def at_middle(self, dt: float, last: WorkingForces) -> WorkingForces:
        """Forces in the middle of a step of dt [s], in line with those of the ``last`` one."""
        part = (0.5 * dt + last.ahead) / (dt - self.ahead + last.ahead)
        work, heat = (
            part * now + (1.0 - part) * before
            for now, before in ((self.work, last.work), (self.heat, last.heat))
        )
        return WorkingForces(work, heat, 0.5 * dt)


def _moved_works(equations: StageEquations, x_before: Array) -> tuple[float, float, float]:
    """Of this rank's moving targets and obstacles in the step from x_before (n_owned, 3): the energy of
    targets at its start, and the works [J] by the forces at its start and at its end.
    """
    step, impulses = equations.step, equations.contact_end.impulses.work
    stored, at_start, at_end = 0.0, impulses, impulses
    targets, obstacles = equations.active.targets, equations.active.obstacles if step.in_contact else ()
    if not (targets or obstacles):
        return stored, at_start, at_end
    x, x_at_end = equations.points.extended(x_before), equations.x
    for term in targets:
        start, end = (term.freeze(equations.targets_at(at)) for at in (step.start, step.end))
        stored += float(term.energies(x, start).sum())
        (before, pull), (after, pull_at_end) = term.targets(x, start), term.targets(x_at_end, end)
        at_start += float(np.vdot(pull, after - before))
        at_end += float(np.vdot(pull_at_end, after - before))
    for term in obstacles:
        at_start += term.work(x, step.start, step.start, step.end)
        at_end += term.work(equations.evaluated.x, step.end, step.start, step.end)
    return stored, at_start, at_end


class EnergyBalance:
    """The ledger: the budget of the present state, and the account of each step; collective.

    Attributes
    ----------
    budget : Budget
    account : StepAccount
        The last one computed.
    damping : (m,)
        Force [N] of material damping at the prescribed unknowns in that step.
    """

    account: StepAccount

    def __init__(self, equations: StageEquations) -> None:
        self._equations = equations
        named = dict.fromkeys(term.registration.energy for term in equations.active.elastic)
        self._columns = [name for name in named if name not in (*ENERGIES, "")]
        self._at = equations.step.prescribed.indices
        self._reactions = np.zeros(len(self._at))
        self._last: WorkingForces | None = None
        if not equations.integrator.dynamic:
            still = np.zeros((equations.points.n_owned, 3))
            at_rest = equations.forces.parts(equations.at(equations.x, equations.v), still)
            self._last = self._working_forces(at_rest)
        self.budget = Budget()
        self.measure()

    @property
    def reaction(self) -> Array:
        """Force (n_owned, 3) [N] of exact handles on the sheet in the last step; 0 in free coordinates."""
        out = np.zeros((self._equations.points.n_owned, 3))
        np.put(out, self._at, self._reactions)
        return out

    def measure(self) -> None:
        """Write the energies of the present state into the budget."""
        self._v = self._equations.v
        entries, self._moving_energy, _ = self._measured(self._equations.here())
        self.budget = replace(self.budget, **entries)

    def enter_outside_change(self) -> None:
        """Enter a change of the state by the program that runs the simulation, as external work."""
        before = self.budget
        self.measure()
        work = before.external_work + self.budget.total - before.total
        self.budget = replace(self.budget, external_work=work)

    def _measured(self, here: Evaluation, *local: float) -> tuple[dict[str, Any], float, list[float]]:
        """Energies of the state, evaluated ``here``, as entries of a `Budget`, the energy of the terms with
        moving targets, and the sums of ``local`` over ranks.
        """
        equations, moving = self._equations, 0.0
        energies = dict.fromkeys([*ENERGIES, *self._columns], 0.0)
        for term in equations.active.elastic:
            if name := term.registration.energy:
                frozen = here.frozen[term]
                energy = float(term.energies(here.x, frozen).sum())
                energy -= term.heat(here.x, frozen) if isinstance(term, Dissipates) else 0.0
                energies[name] += energy
                moving += energy if isinstance(term, MovingTargets) else 0.0
        for load in equations.active.loads:
            if name := load.registration.energy:
                energies[name] += load.potential(equations.x)
        energies["kinetic"] = kinetic_energy(equations.mass, equations.v[: equations.points.n_owned])
        sums = equations.points.global_sum(*energies.values(), moving, *local).tolist()
        every = dict(zip(energies, sums, strict=False))
        more = {name: every.pop(name) for name in self._columns}
        entries = {name.removesuffix("_energy"): energy for name, energy in every.items()} | {"more": more}
        moving, *local_sums = sums[len(energies) :]
        return entries, moving, local_sums

    def enter(self, account: StepAccount) -> None:
        """Take the account of a step that is accepted into the books."""
        self._v = self._equations.v
        self.budget, self._moving_energy, self._last = account.after, self._moving_at_end, self._stage

    def record(self, x_before: Array) -> None:
        """`enter` the account of the step just taken from x_before (n_owned, 3)."""
        self.enter(self.account_of(x_before))

    def account_of(self, x_before: Array) -> StepAccount:
        """The account of the step just taken from x_before (n_owned, 3)."""
        equations, step = self._equations, self._equations.step
        move_frames_to_end(equations)
        forces = self._working_forces(equations.forces_at_stage())
        self.damping, self._stage = forces.heat.take(self._at), None
        if equations.integrator.order > 1 or not equations.integrator.dynamic:
            self._stage = forces
            if self._last and step.dt > 0.0 and not equations.start_acceleration.starts_anew:
                forces = forces.at_middle(step.dt, self._last)
        if not step.ends_at_stage and (equations.active.moving or equations.active.external):
            equations.change(
                frozen=equations.active.with_targets(step.frozen, equations.targets_at(step.end))
            )
        here = equations.here()
        fabric = sum(term.heat(here.x, here.frozen[term]) for term in equations.active.dissipating)
        jump = np.where(step.prescribed.free, equations.evaluated.v[: len(step.v_h)] - step.v_h, 0.0)
        inertia = kinetic_energy(equations.mass, jump)
        works = [_work_of(force, x_before, equations.x) for force in (forces.work, forces.heat)]
        moved = _moved_works(equations, x_before)
        works[0] += self._kinetic_energy_of_handles(equations.v) - self._kinetic_energy_of_handles(self._v)
        impacts = equations.contact_end.impulses.heat
        del forces  # to save memory
        energies, self._moving_at_end, sums = self._measured(here, *works, *moved, fabric, impacts, inertia)
        work, damped, stored, at_start, at_end, fabric, impacts, inertia = sums
        appeared = stored - self._moving_energy  # with targets that begin or cease to act
        at_start, at_end = at_start + appeared, at_end + appeared
        work += 0.5 * (at_start + at_end)
        before, heat = self.budget, damped + fabric + impacts
        after = Budget(
            **energies, external_work=before.external_work + work, dissipation=before.dissipation + heat
        )
        self.account = StepAccount(before, after, work, at_start, at_end, heat, damped, fabric, inertia)
        return self.account

    def _kinetic_energy_of_handles(self, v: Array) -> float:
        """½ Σ m v² [J] of this rank's prescribed unknowns, with velocities v (n_local, 3)."""
        return 0.5 * float(np.vdot(self._equations.mass.take(self._at // 3), np.square(v.take(self._at))))

    def _working_forces(self, parts: Iterable[tuple[str, Array]]) -> WorkingForces:
        """From the parts of the residual F at a stage the forces that do work."""
        equations, step = self._equations, self._equations.step
        self._at = at = step.prescribed.indices
        self._reactions = equations.contact_end.impulses.handle_force + np.zeros(len(at))
        weight, damping = np.zeros((equations.points.n_local, 3)), np.zeros((equations.points.n_owned, 3))
        for load in equations.active.loads:
            if load.registration.energy:  # loads with a potential do no external work
                load.add_force(equations.targets_at(step.at_stage), weight)
        external, inertia = -weight[: equations.points.n_owned], np.zeros(len(at))
        for name, part in parts:
            self._reactions += part.take(at)
            if name in ("loads", "springs", "friction", "wind"):
                external -= part
            elif name == "damping":
                damping = part
            elif name == "inertia":
                inertia = part.take(at)
            del part  # to save memory before the next part is computed
        step.prescribed.overwrite(external, external.take(at) + self._reactions - inertia)
        return WorkingForces(external, damping, step.end - step.at_stage)

    def saved_state(self) -> tuple[dict[str, Array], dict[str, Any]]:
        """Arrays (n_owned, 3) and numbers of a checkpoint."""
        if (last := self._last) is None:
            return {}, asdict(self.budget)
        heat = {"damping": last.heat} if self._equations.damping.active else {}
        return {"pull": last.work} | heat, {**asdict(self.budget), "ahead": last.ahead}

    def restore(self, arrays: Mapping[str, Array], numbers: Mapping[str, Any]) -> None:
        """Restore works from a checkpoint; energies are measured at the present state."""
        works = {**numbers, "more": {}}
        if (ahead := works.pop("ahead", None)) is not None:
            work = arrays["pull"]
            self._last = WorkingForces(work, arrays.get("damping", np.zeros_like(work)), ahead)
        self.budget = Budget(**works)
        self.measure()

    @property
    def column_names(self) -> list[str]:
        """Names of the columns of history.csv that terms add, in the order of the terms."""
        of_terms = [name for term in self._equations.active.elastic for name in term.registration.columns]
        return list(dict.fromkeys([*self._columns, *of_terms]))

    def columns(self) -> dict[str, float]:
        """Columns of history.csv that terms add, by name (the last term wins); collective."""
        equations = self._equations
        columns: dict[str, float] = dict(self.budget.more)
        for term in equations.active.elastic:
            reductions = term.registration.columns
            if not reductions:
                continue
            mine = term.history(equations.x, equations.step.frozen[term])
            for name, how in reductions.items():
                columns[name] = float(equations.points.comm.allreduce(float(mine[name]), REDUCTIONS[how]))
        return columns

    def handle_forces(self, count: int) -> list[Array]:
        """Total force (3,) [N] of each of a scene's ``count`` handles in the last step; collective."""
        equations = self._equations
        local = np.zeros((count, 3))
        for number, forces, _ in equations.held.shares(
            equations.step.start, equations.step.end, self.reaction
        ):
            local[number] = forces.sum(axis=0)
        for term in equations.active.elastic:
            if isinstance(term, PullsHandles):
                local += term.handle_forces(equations.x, equations.step.frozen[term], count)
        total = np.empty_like(local)
        equations.points.comm.Allreduce(local, total)
        return list(total)

    def obstacle_forces(self, count: int) -> Array:
        """Force [N] and torque [N m] about the origin of the sheets on each of a scene's ``count`` obstacles
        in the last step, and sums over contacts of the magnitudes of normal force and friction [N], (count,
        8); collective.
        """
        equations, total = self._equations, np.zeros((count, 8))
        if equations.contact is not None:
            report = equations.contact.report(equations.x, equations.step.frozen)
            total += report.obstacle_loads(equations.contact_end.impulses)[:count]
        equations.points.comm.Allreduce(MPI.IN_PLACE, total)
        return total

    def handle_moments(self) -> dict[int, Array]:
        """Moment [N·m] about its mean of each handle that holds slopes, in the last step; collective."""
        equations, x = self._equations, self._equations.evaluated.x
        edges, numbers = equations.held.edges, equations.held.with_slopes
        if edges is None:
            return {}
        frames = equations.step.frozen[edges.term]
        local = np.zeros((len(numbers), 10))  # moment about the origin, force, positions, count
        for row, number in zip(local, numbers, strict=True):
            mine = equations.held.vertices(number)
            row[6:9], row[9] = x[mine].sum(axis=0), len(mine)
        for number, forces, turning in equations.held.shares(
            equations.step.start, equations.step.end, self.reaction
        ):
            if number in numbers:
                row = local[numbers.index(number)]
                row[:3] = np.cross(x[equations.held.vertices(number)], forces).sum(axis=0)
                row[:3] += edges.moment(number, turning, x, frames)
                row[3:6] = forces.sum(axis=0)
        total = np.empty_like(local)
        equations.points.comm.Allreduce(local, total)
        moments = total[:, :3] - np.cross(total[:, 6:9] / total[:, 9:], total[:, 3:6])
        return dict(zip(numbers, moments, strict=True))
