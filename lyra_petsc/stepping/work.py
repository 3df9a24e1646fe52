"""Energies of the state and the work done in a step, as in the energy identity of backward Euler::

Δ(kinetic + potential) = −½ ‖Δv‖²_M − Δt vᵀ D v + bracket + work of handles and loads
bracket = E(x_{n+1}) − E(x_n) − ∇E(x_{n+1})·Δx   (≤ 0 where E is convex)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.stepping.clamped import clamped_energy
from lyra_petsc.stepping.system import ReducedSystem
from lyra_petsc.terms.term import Pulling

Array = NDArray[np.float64]


@dataclass
class Budget:
    """Energies [J] at a state, and cumulative works [J] up to it.

    ``external_work`` is that of handles, springs and loads other than gravity, ``dissipation`` that of
    material damping.
    """

    kinetic: float = 0.0
    membrane: float = 0.0
    bending: float = 0.0
    potential: float = 0.0
    external_work: float = 0.0
    dissipation: float = 0.0


class Ledger:
    """Keeps the budget over the steps; collective.

    Attributes
    ----------
    budget : Budget
    """

    def __init__(self, system: ReducedSystem) -> None:
        self._system = system
        self.budget = Budget()
        self._at, self._reactions = system.prescribed.at, np.zeros(len(system.prescribed.at))
        self._anchored = 0.0
        self._pull: Array | float = 0.0
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
        names = {"membrane": 1, "bending": 2, "clamp": 2}
        local = np.zeros(4)
        local[0] = 0.5 * float(np.sum(system.mass[:, None] * system.v[:n] ** 2))
        for term in system.elastic:
            if term.name in names:
                energy = float(term.energies(system.x).sum())
                local[names[term.name]] += energy
                if term.name == "clamp":
                    self._anchored = energy
        local[3] = sum(load.potential(system.x) for load in system.loads)
        budget, sums = self.budget, map(float, system.points.summed(*local))
        budget.kinetic, budget.membrane, budget.bending, budget.potential = sums
        return budget

    def record(self, x_before: Array) -> Budget:
        """Add the works of the step just accepted: its stage's forces times the way from x (n_owned, 3)."""
        system = self._system
        parts, self._at = system.forces_at_stage(), system.prescribed.at
        self._reactions = np.sum([part.take(self._at) for part in parts.values()], axis=0)
        external = -parts.pop("loads")
        system.prescribed.put(external, external.take(self._at) + self._reactions)
        for load in system.loads:
            if load.name == "gravity":  # it has a potential, and does no work from outside
                weight = np.zeros_like(external)
                load.add_force(system.x, 0.0, 0.0, weight)
                external -= system.load_factor * weight
        if "wind" in parts:
            external -= parts["wind"]
        if "springs" in parts:
            external -= parts["springs"]
        if not system.scheme.moves:  # the way to an equilibrium has no stage in its middle
            external, self._pull = 0.5 * (external + self._pull), external
        # a clamp's plane turns with its handle, which works on the sheet through it
        turned = system.anchored - self._anchored + self._turn_to_end()
        moved = system.x[: len(x_before)] - x_before
        local = np.array([float(np.vdot(external, moved)) + turned, 0.0])
        if "damping" in parts:
            local[1] = system.dt * float(np.vdot(system.stage_velocity, parts["damping"]))
        del parts, external, moved  # energies need the room
        work, heat = system.points.summed(*local)
        self.budget.external_work += float(work)
        self.budget.dissipation += float(heat)
        return self.measure()

    def _turn_to_end(self) -> float:
        """Let moving targets stand where the step ends; energy [J] that this gives the rank's clamps."""
        system = self._system
        if system.stage.after == system.dt:
            return 0.0
        before = clamped_energy(system.elastic, system.x)
        for term in system.elastic:
            term.prepare(system.t0, system.t1, system.t1)
        return clamped_energy(system.elastic, system.x) - before

    def handle_forces(self, count: int) -> list[Array]:
        """Total force [N] of each of a scene's ``count`` handles in the last step; collective."""
        system = self._system
        local, reaction = np.zeros((count, 3)), self.reaction
        for number in system.held.active(system.t0, system.t1):
            local[number] = reaction[system.held.vertices(number)].sum(axis=0)
        for term in system.elastic:
            if isinstance(term, Pulling):
                local += term.handle_forces(system.x, count)
        total = np.empty_like(local)
        system.points.comm.Allreduce(local, total)
        return list(total)
