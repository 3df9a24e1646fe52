"""Energies of the state and works of the steps, as in the energy identity of backward Euler::

Δ(kinetic + potential) = −½ ‖Δv‖²_M − Δt vᵀ D v + bracket + work of handles and loads
bracket = E(x_{n+1}) − E(x_n) − ∇E(x_{n+1})·Δx   (≤ 0 where E is convex)
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
from lyra_petsc.terms.protocols import Dissipates, GlobalSums, MovingTargets, PullsHandles
from lyra_petsc.terms.term import Load

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
    moving_before, moving : float
        Energies of the terms with moving targets at both ends.
    external, obstacle_work : float
        Work of handles, springs and loads without a potential; the part of it by moving obstacles.
    obstacle_work_at_start : float
        The latter by the forces of contact at the start of the step.
    heat, damping_heat, fabric_heat : float
        Heat of all dampers; of material damping, and of friction within the fabric.
    inertia : float
        ½ ‖Δv‖²_M of a step of backward Euler, with the velocities that solve it.
    early : float
        What the external work would be more if gas were let in before the sheet moves, as in the identity.
    """

    before: Budget
    after: Budget
    moving_before: float
    moving: float
    external: float
    obstacle_work: float
    obstacle_work_at_start: float
    heat: float
    damping_heat: float
    fabric_heat: float
    inertia: float
    early: float = 0.0

    @property
    def change(self) -> float:
        """Change of all energies."""
        return self.after.total - self.before.total

    @property
    def bracket(self) -> float:
        """The bracket of backward Euler's identity: what works, heat and ½ ‖Δv‖²_M leave of the change."""
        return self.change + self.heat - self.external - self.early + self.inertia


def _work_of(force: Array, x_before: Array, x: Array) -> float:
    """Work [J] of forces (n, 3) [N] over x - x_before, in parts to save memory."""
    x, parts = x[: len(force)], (slice(lo, lo + ROWS) for lo in range(0, len(force), ROWS))
    return sum(float(np.vdot(force[rows], x[rows] - x_before[rows])) for rows in parts)


def varying_force(equations: StageEquations, x: Array, v: Array, time: float) -> Array:
    """Force (n_local, 3) [N] of the loads that change in time at a time [s] of the step, with positions and
    velocities x, v (n_local, 3).
    """
    step, force = equations.targets_at(time, x), np.zeros_like(x)
    for term in equations.active.varying:
        if isinstance(term, Load):
            term.add_force(step, force)
        else:
            term.add_gradient(v, term.freeze(step), against := np.zeros_like(x))
            force -= against
    return force


def _work_besides_stage(equations: StageEquations, x_before: Array) -> float:
    """Work [J] of the loads that change in time, in the step from x_before (n_owned, 3) [m], by the mean of
    both ends less that by their values at the stage, which backward Euler's identity has.
    """
    step, at = equations.step, equations.evaluated
    if not equations.active.varying or equations.integrator.order == 1:
        return 0.0
    start, end, stage = (
        varying_force(equations, at.x, at.v, t) for t in (step.start, step.end, step.at_stage)
    )
    moved = equations.x[: len(x_before)] - x_before
    more = (0.5 * (start + end) - stage)[: len(moved)]
    return float(np.vdot(more, np.where(step.prescribed.free, moved, 0.0)))


def _obstacle_works(equations: StageEquations, x_before: Array) -> tuple[float, float]:
    """Work [J] of contact from outside on this rank's elements in the step from x_before (n_owned, 3): of the
    impulses at its end, and of moving obstacles by their forces at its start, or at its end.
    """
    step, impulses = equations.step, equations.contact_end.impulses.work
    at_start = at_end = impulses
    for term in equations.active.obstacles if step.in_contact else ():
        x = equations.points.extended(x_before)
        at_start += term.work(x, step.start, step.start, step.end)
        at_end += term.work(equations.evaluated.x, step.end, step.start, step.end)
    return at_start, at_end


def _move_targets_to_end(equations: StageEquations) -> float:
    """Put moving targets at the end of the step; the change [J] of the energy of this rank's terms."""
    step, active = equations.step, equations.active
    if step.ends_at_stage or not (active.moving or active.external):
        return 0.0
    frozen = active.with_targets(step.frozen, equations.targets_at(step.end))
    equations.change(frozen=frozen)
    return active.moving_energy(equations.x, frozen) - active.moving_energy(equations.x, step.frozen)


def _early_work(equations: StageEquations) -> float:
    """What the work on this rank's enclosed volumes is more if gas is let in before and after the sheet
    moves, up to and from the stage, than if it is let in as the sheet moves (trapezoidal rule).

    The pressure of gas that is let in falls at once as the sheet gives way.
    """
    step, terms = equations.step, [t for t in equations.active.targets if isinstance(t, GlobalSums)]
    early = 0.0
    for term in terms:
        start, end = (term.freeze(equations.targets_at(time)) for time in (step.start, step.end))
        (at_start, before, to_end), (from_start, after, at_end) = (
            [float(term.energies(x, frozen).sum()) for frozen in (start, step.frozen[term], end)]
            for x in (step.x, equations.x)
        )
        early += before - at_start + at_end - after - 0.5 * (to_end - at_start + at_end - from_start)
    return early


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
        self._reactions = self.damping = np.zeros(len(self._at))
        self._ends: tuple[Array, list[tuple[Array, Array]]] | None = None
        if not equations.integrator.dynamic:
            still = np.zeros((equations.points.n_owned, 3))
            self._ends = (
                self._external_forces(equations.forces.parts(equations.at(equations.x, equations.v), still))[
                    0
                ],
                self._moving_targets(),
            )
        self._stiff = self._moving_targets(stiff=True)
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
                moving += energy if isinstance(term, MovingTargets) and not term.is_stiff else 0.0
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
        self.budget, self._moving_energy = account.after, account.moving
        self._stiff = self._moving_targets(stiff=True)

    def record(self, x_before: Array) -> None:
        """`enter` the account of the step just taken from x_before (n_owned, 3)."""
        self.enter(self.account_of(x_before))

    def account_of(self, x_before: Array) -> StepAccount:
        """The account of the step just taken from x_before (n_owned, 3)."""
        equations = self._equations
        move_frames_to_end(equations)
        external, self.damping, damped = self._external_forces(equations.forces_at_stage())
        at_start, by_obstacles = _obstacle_works(equations, x_before)
        by_targets = equations.step.moving_energy + by_obstacles
        if self._ends is not None:  # the stage of a load step is at its end: take the mean of both ends
            pull, targets = self._ends
            self._ends = external, self._moving_targets()
            external = 0.5 * (external + pull)
            by_targets = by_obstacles + sum(
                0.5 * float(np.vdot(pull + pull0, at - at0))
                for (at0, pull0), (at, pull) in zip(targets, self._ends[1], strict=True)
            )
        early = _early_work(equations) if self._ends is None else 0.0
        at_stage = self._moving_targets(equations.evaluated.x, stiff=True)
        by_targets += _move_targets_to_end(equations)
        if self._ends is None:
            moved = zip(self._stiff, at_stage, self._moving_targets(stiff=True), strict=True)
            by_targets += sum(float(np.vdot(pull, at - at0)) for (at0, _), (_, pull), (at, _) in moved)
        work = _work_of(external, x_before, equations.x) + by_targets
        work += _work_besides_stage(equations, x_before)
        del external  # to save memory
        here = equations.here()
        fabric = sum(term.heat(here.x, here.frozen[term]) for term in equations.active.dissipating)
        impacts = equations.contact_end.impulses.heat
        inertia = kinetic_energy(
            equations.mass, equations.evaluated.v[: len(equations.mass)] - equations.step.v_h
        )
        before, moving_before = self.budget, self._moving_energy
        local = work, damped, fabric, impacts, by_obstacles, at_start, inertia, early
        energies, moving, sums = self._measured(here, *local)
        work, damped, fabric, impacts, by_obstacles, at_start, inertia, early = sums
        if self._ends is None:  # a handle does work on the sheet through targets that move with it
            work -= moving_before + early
        heat = damped + fabric + impacts
        after = Budget(
            **energies, external_work=before.external_work + work, dissipation=before.dissipation + heat
        )
        works = work, by_obstacles, at_start
        self.account = StepAccount(
            before, after, moving_before, moving, *works, heat, damped, fabric, inertia, early
        )
        return self.account

    def _moving_targets(self, x: Array | None = None, *, stiff: bool = False) -> list[tuple[Array, Array]]:
        """The moving targets, and the forces on them, by term, at positions x (n_local, 3) or those of the
        state; of ``stiff`` terms alone, or of all.
        """
        terms, x = self._equations.active.targets, self._equations.x if x is None else x
        return [
            term.targets(x, self._equations.step.frozen[term]) for term in terms if term.is_stiff >= stiff
        ]

    def _external_forces(self, parts: Iterable[tuple[str, Array]]) -> tuple[Array, Array, float]:
        """From the parts of the residual F: forces (n_owned, 3) [N] of handles, springs, friction and loads
        without a potential; forces (m,) of damping at the prescribed unknowns; heat [J] of damping.
        """
        equations = self._equations
        self._at = at = equations.step.prescribed.indices
        self._reactions, damping, heat = np.zeros(len(at)), np.zeros(len(at)), 0.0
        self._reactions += equations.contact_end.impulses.handle_force
        weight, here = np.zeros((equations.points.n_local, 3)), equations.targets_at(equations.step.at_stage)
        for load in equations.active.loads:
            if load.registration.energy:  # loads with a potential do no external work
                load.add_force(here, weight)
        external = -weight[: equations.points.n_owned]
        for name, part in parts:
            self._reactions += part.take(at)
            if name in ("loads", "springs", "friction", "wind"):
                external -= part
            elif name == "damping":
                damping = part.take(at)
                heat = equations.step.dt * float(np.vdot(equations.evaluated.v[: len(equations.mass)], part))
            del part  # to save memory before the next part is computed
        equations.step.prescribed.overwrite(external, external.take(at) + self._reactions)
        return external, damping, heat

    def saved_state(self) -> tuple[dict[str, Array], dict[str, Any]]:
        """Arrays (n_owned, 3) and numbers of a checkpoint."""
        return ({} if self._ends is None else {"pull": self._ends[0]}), asdict(self.budget)

    def restore(self, arrays: Mapping[str, Array], budget: Mapping[str, Any]) -> None:
        """Restore works from a checkpoint; energies are measured at the present state."""
        self.budget = Budget(**{**budget, "more": {}})
        self._stiff = self._moving_targets(stiff=True)
        if self._ends is not None:
            self._ends = arrays["pull"], self._moving_targets()
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
