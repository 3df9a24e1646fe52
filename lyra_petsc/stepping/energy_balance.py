"""Energies of the state and the work done in a step, as in the energy identity of backward Euler::

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
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.state import kinetic_energy
from lyra_petsc.terms.term import HandleTerm

REDUCTIONS = {"sum": MPI.SUM, "min": MPI.MIN, "max": MPI.MAX}

ROWS = 1 << 13
"""Rows whose works are computed together."""

ENERGIES = ("membrane_energy", "bending_energy", "potential_energy")
"""Columns of history.csv that energies of registered terms are added to; others come after these."""


@dataclass
class Budget:
    """Energies [J] at a state, and cumulative works [J] up to it.

    ``external_work`` is that of handles, springs and loads other than gravity, ``dissipation`` that of
    material damping, of friction within the fabric and of impacts; ``more`` are the energies of terms with a
    column of their own.
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
class Works:
    """What a step did, by the forces at its stage.

    Attributes
    ----------
    external, heat : float
        Work [J] of handles, springs and loads without a potential, and of what damps.
    moving : float
        By how much the energy [J] of this rank's terms with moving targets is more than before the step.
    damping : (m,)
        Force [N] of material damping at the prescribed unknowns.
    damped : float
        Heat [J] of material damping on this rank.
    """

    external: float
    heat: float
    moving: float
    damping: Array
    damped: float


def _work(force: Array, x_before: Array, x: Array) -> float:
    """Of forces (n, 3) [N] on the way to x; there is no room for all of the ways."""
    x, parts = x[: len(force)], (slice(lo, lo + ROWS) for lo in range(0, len(force), ROWS))
    return sum(float(np.vdot(force[rows], x[rows] - x_before[rows])) for rows in parts)


class Ledger:
    """Keeps the budget over the steps; collective.

    Attributes
    ----------
    budget : Budget
    works : Works
        Of the last step.
    """

    works: Works

    def __init__(self, system: StageEquations) -> None:
        self._system = system
        named = dict.fromkeys(term.registration.energy for term in system.active.elastic)
        self._more = [name for name in named if name not in (*ENERGIES, "")]
        self.budget = Budget()
        self._at, self._reactions = system.prescribed.indices, np.zeros(len(system.prescribed.indices))
        self._moving = 0.0
        self._pull: Array | None = None
        self._targets: list[tuple[Array, Array]] = []
        if not system.integrator.dynamic:
            self._pull, self._targets = self._external(system.forces_now())[0], self._turning()
        self.measure()

    @property
    def reaction(self) -> Array:
        """Force (n_owned, 3) [N] of exact handles on the sheet in the last step; 0 in free coordinates."""
        out = np.zeros((self._system.points.n_owned, 3))
        np.put(out, self._at, self._reactions)
        return out

    def measure(self) -> Budget:
        """Energies of the present state into the budget."""
        system = self._system
        n = system.points.n_owned
        columns = [*ENERGIES, *self._more]
        local = np.zeros(len(columns) + 1)
        local[-1] = kinetic_energy(system.mass, system.v[:n])
        self._moving = 0.0
        for term in system.active.elastic:
            entry = term.registration
            if entry.energy:
                frozen = system.active.frozen[term]
                energy = float(term.energies(system.x, frozen).sum()) - term.heat(system.x, frozen)
                local[columns.index(entry.energy)] += energy
                self._moving += energy if term.moving and not term.pushes else 0.0
        for load in system.active.loads:
            if load.registration.energy:
                local[columns.index(load.registration.energy)] += load.potential(system.x)
        budget, sums = self.budget, [float(value) for value in system.points.global_sum(*local)]
        budget.membrane, budget.bending, budget.potential = sums[:3]
        budget.more, budget.kinetic = dict(zip(self._more, sums[3:-1], strict=True)), sums[-1]
        system.forget_directors()  # the next step has other frames
        return budget

    def kept(self) -> tuple[Budget, float]:
        """What `take_back` needs to forget the steps from here on."""
        return replace(self.budget, more=dict(self.budget.more)), self._moving

    def take_back(self, kept: tuple[Budget, float]) -> None:
        """Forget what was recorded since; the step is repeated."""
        self.budget, self._moving = kept

    def record(self, x_before: Array) -> Budget:
        """Add the works of the step just accepted: its stage's forces times the way from x (n_owned, 3)."""
        system = self._system
        system.move_frames_to_end()
        external, damping, damped = self._external(system.forces_at_stage())
        # targets that move with a handle let it work on the sheet
        if self._pull is None:
            turned = system.moving_energy_before - self._moving
        else:  # the way to an equilibrium has no stage in its middle
            external, self._pull = 0.5 * (external + self._pull), external
            before, self._targets = self._targets, self._turning()
            turned = sum(
                0.5 * float(np.vdot(pull + pull0, at - at0))
                for (at0, pull0), (at, pull) in zip(before, self._targets, strict=True)
            )
        turned += system.obstacle_work() + system.move_targets_to_end()
        local = np.array([_work(external, x_before, system.x) + turned, damped])
        local[1] += sum(term.heat(system.x, system.active.frozen[term]) for term in system.active.sheet)
        local[1] += system.contact_impulses.heat if system.contact_impulses else 0.0
        del external  # energies need the room
        work, heat = system.points.global_sum(*local)
        self.budget.external_work += float(work)
        self.budget.dissipation += float(heat)
        moving = self._moving
        self.measure()
        self.works = Works(float(work), float(heat), self._moving - moving, damping, damped)
        return self.budget

    def _turning(self) -> list[tuple[Array, Array]]:
        """Targets that move with handles, and the pull on them, of each term that has some."""
        active, x = self._system.active, self._system.x
        return [term.targets(x, active.frozen[term]) for term in active.moving if not term.pushes]

    def _external(self, parts: Iterable[tuple[str, Array]]) -> tuple[Array, Array, float]:
        """Forces (n_owned, 3) [N] of handles, springs and loads without a potential, of the parts of F; those
        of damping at the prescribed unknowns (m,), and its heat [J].
        """
        system = self._system
        self._at = at = system.prescribed.indices
        self._reactions, damping, heat = np.zeros(len(at)), np.zeros(len(at)), 0.0
        if system.contact_impulses:
            self._reactions += system.contact_impulses.handle_force
        weight = np.zeros((system.points.n_local, 3))
        for load in system.active.loads:
            if load.registration.energy:  # it has a potential, and does no work from outside
                load.add_force(system.x, 0.0, 0.0, weight)
        external = weight[: system.points.n_owned]
        external *= -system.applied.factor
        for name, part in parts:
            self._reactions += part.take(at)
            if name in ("loads", "springs", "wind"):
                external -= part
            elif name == "damping":
                damping = part.take(at)
                heat = system.dt * float(np.vdot(system.stage_velocity, part))
            del part  # the next needs the room
        system.prescribed.overwrite(external, external.take(at) + self._reactions)
        return external, damping, heat

    def memory(self) -> tuple[dict[str, Array], dict[str, Any]]:
        """Arrays (n_owned, 3) and numbers to go on with after a restart."""
        return ({} if self._pull is None else {"pull": self._pull}), asdict(self.budget)

    def restore(self, arrays: Mapping[str, Array], budget: Mapping[str, Any]) -> None:
        """Go on with a memory: works are its, energies those of the present state."""
        for name, value in budget.items():
            if name != "more":
                setattr(self.budget, name, float(value))
        if self._pull is not None:  # an older checkpoint holds none
            self._pull, self._targets = arrays.get("pull", self._pull), self._turning()
        self.measure()

    @property
    def column_names(self) -> list[str]:
        """Columns of history.csv that terms add, in the order of the terms."""
        of_terms = [name for term in self._system.active.elastic for name in term.registration.columns]
        return list(dict.fromkeys([*self._more, *of_terms]))

    def columns(self) -> dict[str, float]:
        """Further columns of history.csv that terms add, by name (the last term wins); collective."""
        system = self._system
        found: dict[str, float] = dict(self.budget.more)
        for term in system.active.elastic:
            reductions = term.registration.columns
            if not reductions:
                continue
            mine = term.history(system.x, system.active.frozen[term])
            for name, how in reductions.items():
                found[name] = float(system.points.comm.allreduce(float(mine[name]), REDUCTIONS[how]))
        return found

    def handle_forces(self, count: int) -> list[Array]:
        """Total force [N] of each of a scene's ``count`` handles in the last step; collective."""
        system = self._system
        local = np.zeros((count, 3))
        for number, forces, _ in system.held.shares(system.t0, system.t1, self.reaction):
            local[number] = forces.sum(axis=0)
        for term in system.active.elastic:
            if isinstance(term, HandleTerm):
                local += term.handle_forces(system.x, system.active.frozen[term], count)
        total = np.empty_like(local)
        system.points.comm.Allreduce(local, total)
        return list(total)

    def obstacle_forces(self, count: int) -> Array:
        """Force [N] of the sheets on each of a scene's ``count`` obstacles, and its torque [N m] about the
        origin, (count, 6), at the end of the last step, and of dashpots in it; collective.
        """
        system, total = self._system, np.zeros((count, 6))
        for term in system.active.elastic:
            found = term.obstacle_forces(system.x, system.active.frozen[term], count)
            if found is not None:
                total += found
        if impulses := system.contact_impulses:
            torque = np.cross(impulses.position, impulses.force)
            np.add.at(total, impulses.obstacle, np.column_stack([impulses.force, torque]))
        system.points.comm.Allreduce(MPI.IN_PLACE, total)
        return total

    def handle_moments(self) -> dict[int, Array]:
        """Moment [N·m] in the last step of each handle that holds slopes, about its mean; collective."""
        system, x = self._system, self._system.stage_positions
        edges, numbers = system.held.edges, system.held.with_slopes
        if edges is None:
            return {}
        frames = system.active.frozen[edges.term]
        local = np.zeros((len(numbers), 10))  # moment about the origin, force, positions, count
        for row, number in zip(local, numbers, strict=True):
            mine = system.held.vertices(number)
            row[6:9], row[9] = x[mine].sum(axis=0), len(mine)
        for number, forces, turning in system.held.shares(system.t0, system.t1, self.reaction):
            if number in numbers:
                row = local[numbers.index(number)]
                row[:3] = np.cross(x[system.held.vertices(number)], forces).sum(axis=0)
                row[:3] += edges.moment(number, turning, x, frames)
                row[3:6] = forces.sum(axis=0)
        total = np.empty_like(local)
        system.points.comm.Allreduce(local, total)
        moments = total[:, :3] - np.cross(total[:, 6:9] / total[:, 9:], total[:, 3:6])
        return dict(zip(numbers, moments, strict=True))
