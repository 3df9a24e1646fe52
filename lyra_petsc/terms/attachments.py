"""Attachments: springs between two points of the sheets, at vertices or inside triangles.

    energy = ½ k (|d| − L)²,   d = Σ w_i x_i

d is the vector between the points, a sum over the vertices on which they depend. A spring whose force is
above its breaking force at the end of a step is gone for good.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.attached_points import attached_points
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.protocols import Dissipates, Event, Place, TellsEvents, TermState, WritesTable
from lyra_petsc.terms.rest import RestShape


class AttachmentSprings(Dissipates, TellsEvents, WritesTable):
    """The springs of all attachments.

    Parameters
    ----------
    elements : Elements
        Stencil (E, n), different vertices; data ``weight`` (E, n), ``k`` (E,) [N/m], ``length`` (E,) [m],
        ``breaks_at`` (E,) [N], ``attachment`` (E,) number of the attachment.
    count : int
        Number of attachments of the scene.

    Attributes
    ----------
    broken : (E,)
        1 for springs that are gone, else 0.
    """

    table = "attachments.csv"
    table_columns = ("name", "holding", "distance", "fx", "fy", "fz", "tension")
    table_units = ("", "", "m", "N", "N", "N", "N")

    def __init__(self, elements: Elements, count: int) -> None:
        super().__init__(elements)
        data = elements.data
        self._weight, self._k, self._length = data["weight"], data["k"], data["length"]
        self._breaks_at, self._number = data["breaks_at"], data["attachment"].astype(np.int64)
        self._count = count
        self.broken: Array = np.zeros(self.n_elements)

    def _springs(self, x: Array) -> tuple[Array, Array, Array]:
        """Distances |d| (E,) [m], directions (E, 3) of d, and tensions (E,) [N]."""
        d = np.zeros((self.n_elements, 3))
        for weight, vertex in zip(self._weight.T, self.stencil.T, strict=True):
            d += weight[:, None] * x[vertex]
        # ghosts are judged as their owner does: not by a norm, whose order of sums may differ
        distance = np.sqrt(d[:, 0] * d[:, 0] + d[:, 1] * d[:, 1] + d[:, 2] * d[:, 2])
        direction = np.divide(d, distance[:, None], out=np.zeros_like(d), where=distance[:, None] > 0.0)
        return distance, direction, (1.0 - self.broken) * self._k * (distance - self._length)

    def _breaks(self, tension: Array) -> Any:
        return np.abs(tension) > self._breaks_at

    def energies(self, x: Array, frozen: Any = None) -> Array:
        return (0.5 * self._springs(x)[2] ** 2 / self._k)[: self.n_owned]

    def add_gradient(self, x: Array, frozen: Any, out: Array) -> None:
        _, direction, tension = self._springs(x)
        pull = tension[:, None] * direction
        np.add.at(out, self.stencil, self._weight[:, :, None] * pull[:, None, :])

    def hessians(self, x: Array, frozen: Any, lo: int, hi: int, convexity: float, out: Array) -> None:
        distance, direction, tension = (values[lo:hi] for values in self._springs(x))
        k, weight = (1.0 - self.broken[lo:hi]) * self._k[lo:hi], self._weight[lo:hi]
        # a spring without length has the Hessian k of ½ k |d|², also where d = 0
        across = np.divide(tension, distance, out=k.copy(), where=distance > 0.0)
        across = np.where(self._length[lo:hi] > 0.0, across, k)
        across = np.where(across < 0.0, (1.0 - convexity) * across, across)
        block = (k - across)[:, None, None] * direction[:, :, None] * direction[:, None, :]
        block += across[:, None, None] * np.eye(3)
        np.einsum("ea,eb,eij->eabij", weight, weight, block, out=out)

    def force_scale(self, size: float) -> Array:
        return np.asarray(self._k * size)

    # -- breaking ----------------------------------------------------------------------------------

    def initialise(self, x: Array) -> None:
        self.broken = np.zeros(self.n_elements)

    def accept(self, x: Array, frozen: Any = None) -> None:
        self.broken = np.maximum(self.broken, self._breaks(self._springs(x)[2]))

    def heat(self, x: Array, frozen: Any = None) -> float:
        tension = self._springs(x)[2]
        gone = self._breaks(tension)[: self.n_owned]
        return float(np.sum((0.5 * tension**2 / self._k)[: self.n_owned][gone]))

    def events(self, x: Array, frozen: Any = None) -> list[Event]:
        tension = self._springs(x)[2]
        gone = np.flatnonzero(self._breaks(tension)[: self.n_owned])
        force, number = np.abs(tension[gone]), self._number[gone]
        largest = {n: force[number == n].max() for n in np.unique(number).tolist()}
        return [
            Event(f"attachment {n}", force, f"attachments[{n}] breaks at {force:.4g} N")
            for n, force in largest.items()
        ]

    def state(self) -> dict[str, TermState]:
        return {"broken": TermState(Place.ELEMENT, self.broken[:, None])}

    def restore(self, values: Mapping[str, Array], x: Array) -> None:
        self.broken = values["broken"][:, 0].copy()

    def table_rows(self, x: Array, frozen: Any = None) -> list[tuple[float | str, ...]]:
        """Of each attachment how many springs hold, their points' mean distance, the force on the points of
        ``from``, and the sum of the magnitudes of the springs' forces.
        """
        distance, direction, tension = (values[: self.n_owned] for values in self._springs(x))
        counts = np.ones(self.n_owned), 1.0 - self.broken[: self.n_owned]
        entries = np.column_stack([*counts, distance, -tension[:, None] * direction, np.abs(tension)])
        sums = np.zeros((self._count, entries.shape[1]))
        np.add.at(sums, self._number[: self.n_owned], entries)
        sums = self.over_ranks(sums.ravel()).reshape(sums.shape)
        sums[:, 2] /= sums[:, 0]
        return [(f"attachment{n}", *row) for n, row in enumerate(sums[:, 1:].tolist())]


def _padded(vertices: Ints, weights: Array, width: int, triangles: Ints) -> tuple[Ints, Array]:
    """The vertices of an element with further ones of no weight, ``width`` different ones, next to them."""
    padded = vertices
    while len(padded) < width:
        beside = np.setdiff1d(triangles[np.isin(triangles, padded).any(axis=1)], padded)
        more = beside if len(beside) else np.setdiff1d(triangles, padded)
        padded = np.concatenate([padded, more[: width - len(padded)]])
    return padded, np.concatenate([weights, np.zeros(width - len(weights))])


def elements(rest: RestShape) -> Elements:
    """The springs of all attachments (rank 0)."""
    scene = rest.scene
    attached = attached_points(scene, rest.mesh)
    width = max(len(vertices) for points in attached for vertices in points.vertices)
    stencils: list[Ints] = []
    data: dict[str, list[Any]] = {name: [] for name in ("weight", "k", "length", "breaks_at", "attachment")}
    first: dict[tuple[int, ...], int] = {}
    for number, (attachment, points) in enumerate(zip(scene.attachments, attached, strict=True)):
        for vertices, weights, distance in zip(*points, strict=True):
            key = tuple(vertices.tolist())
            if first.setdefault(key, number) != number:
                raise InputError(
                    f"joins points that attachments[{first[key]}] joins, too; give one attachment with the "
                    "sum of the stiffnesses",
                    key=f"attachments[{number}]",
                    file=scene.source,
                )
            length = distance if attachment.length == "start" else attachment.length
            breaks_at = np.inf if attachment.breaks_at is None else attachment.breaks_at
            if (force := attachment.stiffness * abs(distance - length)) > breaks_at:
                raise InputError(
                    f"must be above the force of the start, {force:.4g} N; length: start makes that zero",
                    key=f"attachments[{number}].breaks_at",
                    file=scene.source,
                )
            stencil, weight = _padded(vertices, weights, width, rest.mesh.triangles)
            stencils.append(stencil)
            data["weight"].append(weight)
            data["k"].append(attachment.stiffness)
            data["length"].append(length)
            data["breaks_at"].append(breaks_at)
            data["attachment"].append(float(number))
    return Elements(np.array(stencils), {name: np.array(values) for name, values in data.items()})


def make(elements: Elements, scene: Scene, mass: Array) -> AttachmentSprings:
    """The term on one rank."""
    return AttachmentSprings(elements, len(scene.attachments))
