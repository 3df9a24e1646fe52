"""A term of the tests whose stencils change: near vertices repel each other.

Per pair of vertices at a distance r below d: energy = k (d − r)³ / 3.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.protocols import LimitsStep, Place, Stateful, TermState
from lyra_petsc.terms.registry import Registration, Role
from lyra_petsc.terms.rest import RestShape

DISTANCE, STIFFNESS = 0.08, 4.0e3
"""d [m] and k [N/m²]."""


class Repulsion(Stateful, LimitsStep):
    """Springs between vertices nearer than `DISTANCE`, and a count of the steps in which each is repelled."""

    skin = 0.02
    search_distance = DISTANCE + skin

    def __init__(self, n_vertices: int) -> None:
        super().__init__(Elements(np.empty((0, 2), dtype=np.int32)))
        self._touched = np.zeros((n_vertices, 3))

    def _pairs(self, x: Array) -> tuple[Array, Array, Array]:
        """Unit vectors (E, 3) from the second vertex to the first, distances (E,) and d − r, at least 0."""
        vector = x[self.stencil[:, 0]] - x[self.stencil[:, 1]]
        distance = np.linalg.norm(vector, axis=1)
        return vector / distance[:, None], distance, np.maximum(DISTANCE - distance, 0.0)

    def neighbours(self, x: Array, dx: Array, numbers: Ints, triangles: Ints) -> tuple[Ints, Ints]:
        """Pairs of points, the one with the smaller number first."""
        near = ((x[:, None] - x[None]) ** 2).sum(axis=2) < self.search_distance**2
        one, other = np.nonzero(near & (numbers[:, None] < numbers[None]))
        return np.column_stack([one, other]), np.empty((len(one), 0), dtype=np.int64)

    def energies(self, x: Array, frozen: None) -> Array:
        energy: Array = STIFFNESS / 3.0 * self._pairs(x)[2] ** 3
        return energy[: self.n_owned]

    def add_gradient(self, x: Array, frozen: None, out: Array) -> None:
        unit, _, overlap = self._pairs(x)
        force = STIFFNESS * overlap[:, None] ** 2 * unit
        np.add.at(out, self.stencil[:, 0], -force)
        np.add.at(out, self.stencil[:, 1], force)

    def hessians(self, x: Array, frozen: None, lo: int, hi: int, blend: float, out: Array) -> None:
        unit, distance, overlap = (part[lo:hi] for part in self._pairs(x))
        along = unit[:, :, None] * unit[:, None, :]
        across = -(1.0 - blend) * STIFFNESS * overlap**2 / distance
        block = (2.0 * STIFFNESS * overlap)[:, None, None] * along + across[:, None, None] * (
            np.eye(3) - along
        )
        out[:, 0, 0], out[:, 1, 1] = block, block
        out[:, 0, 1], out[:, 1, 0] = -block, -block

    def force_scale(self, size: float) -> Array:
        return np.full(self.n_elements, 2.0 * STIFFNESS * DISTANCE * size)

    def largest_step(self, x: Array, dx: Array, frozen: None) -> float:
        longest = float(np.linalg.norm(dx, axis=1).max(initial=0.0))
        return 0.5 * DISTANCE / max(longest, 0.5 * DISTANCE)

    def acts(self, x: Array, frozen: None) -> bool:
        return bool((self._pairs(x)[2] > 0.0).any())

    def accept(self, x: Array, frozen: None) -> None:
        near = self.stencil[self._pairs(x)[2] > 0.0].ravel()
        self._touched[np.unique(near[near < len(self._touched)])] += 1.0

    def initialise(self, x: Array) -> None:
        self._touched[:] = 0.0

    def state(self) -> dict[str, TermState]:
        return {"touched": TermState(Place.VERTEX, self._touched)}

    def restore(self, values: Mapping[str, Array], x: Array) -> None:
        self._touched = values["touched"].copy()

    def history(self, x: Array, frozen: None) -> dict[str, float]:
        nearest = self._pairs(x)[1].min(initial=np.inf)
        return {"pairs": float(self.n_owned), "nearest": float(nearest)}


def elements(rest: RestShape) -> None:
    """No elements before the vertices move."""


def make(elements: None, scene: Scene, mass: Array) -> Repulsion:
    return Repulsion(len(mass))


REPULSION = Registration(
    "repulsion",
    lambda scene, shells: True,
    Role.ELASTIC,
    "repulsion_energy",
    {"pairs": "sum", "nearest": "min"},
    neighbours=True,
    module_name=__name__,
)
