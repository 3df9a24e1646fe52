"""Coulomb friction of all pairs in contact; its potential in a step is that of ``friction_pairs``.

Pairs, their normals and normal forces are those of the last accepted state; a pair that goes on keeps the
elastic part of its way, so that what sticks does not creep.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene, coefficients
from lyra_petsc.terms import friction_pairs
from lyra_petsc.terms.contact import HALFWAY, ContactBarrier
from lyra_petsc.terms.contact_pairs import EDGE_EDGE
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Elastic, UpcomingStep

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

ELASTIC = 0.01
"""Part of the gap that a pair which sticks may go before it slides, at most."""


class Pairs(NamedTuple):
    """Pairs in contact at an accepted state.

    Attributes
    ----------
    key : (E, 11)
        Whether others count it, numbers of the vertices, kind, obstacle, its points: what tells a pair from
        others; ascending.
    beta : (E, 4)
        0 for obstacles' points.
    normal, start, slip, foot : (E, 3)
        Unit normals, Σ β_i x_i, elastic part of the way so far, where an obstacle is touched [m].
    force : (E,)
        Normal force [N].
    slid : (E,)
        Whether it slid in the last step.
    """

    key: Ints
    beta: Array
    normal: Array
    start: Array
    slip: Array
    foot: Array
    force: Array
    slid: Mask

    @property
    def vertices(self) -> Ints:
        """Global numbers (E, 4)."""
        return self.key[:, 1:5]

    @property
    def obstacle(self) -> Ints:
        """(E,), −1 of sheets."""
        return self.key[:, 6]


class ObstacleMoves(NamedTuple):
    """How obstacles move in a step.

    Attributes
    ----------
    stage, end : list of (3, 3) and (3,)
        Rotation and translation [m] of each from the start of the step to its stage and its end.
    places : (m, 3)
        Their points and normals at its end.
    """

    stage: list[tuple[Array, Array]]
    end: list[tuple[Array, Array]]
    places: Array


def _no_pairs() -> Pairs:
    three = np.empty((0, 3))
    nothing = np.empty((0, 11), dtype=np.int64), np.empty((0, 4)), three, three, three, three
    return Pairs(*nothing, np.empty(0), np.empty(0, dtype=np.bool_))


class CoulombFriction(Elastic):
    """Friction in a step.

    Parameters
    ----------
    scene : Scene
    n_vertices : int
        That this rank owns.
    """

    def __init__(self, scene: Scene, n_vertices: int) -> None:
        assert scene.contact is not None
        self._common = coefficients(scene.contact.friction)
        self._heat = np.zeros((n_vertices, 3))
        self._pairs = _no_pairs()
        self.stale = False
        super().__init__(Elements(np.empty((0, 4), dtype=np.int32), {"what": np.empty((0, 1))}))

    def set_up(self, contact: ContactBarrier) -> None:
        """Know the contact whose pairs rub."""
        self._contact = contact
        each = [*(obstacle.friction for obstacle in contact.obstacles.each), self._common]
        self._coefficients = np.array(each)
        self._on_obstacles = np.zeros((len(contact.obstacles.each), 6))  # in the last step
        self._stiffest = HALFWAY * contact.barrier.stiffness

    def take(self, elements: Elements) -> None:
        super().take(elements)
        self._number = number = elements.data["what"][:, 0].astype(np.int64)
        self._taken = p = self._pairs  # the next ones are known before their elements are
        if not len(number):
            number = np.empty(0, dtype=np.int64)
            self._limit = self._spring = np.empty(0)
        else:
            static, kinetic = self._coefficients[p.obstacle[number]].T
            self._limit = np.where(p.slid[number], kinetic, static) * p.force[number]
            self._spring = np.maximum(self._stiffest, self._limit / (ELASTIC * self._contact.barrier.gap))
        self._beta, self._normal = p.beta[number], p.normal[number]
        self._slip = p.slip[number]
        self._moved: list[tuple[Array, Array]] | None = None  # what the starts are of
        self._start = p.start[number]

    # -- pairs -------------------------------------------------------------------------------------

    def known(self) -> tuple[Ints, Ints]:
        self.stale = False
        vertices = self._pairs.vertices
        return vertices, np.arange(len(vertices))[:, None]

    def _renew(self, x: Array, places: Array) -> None:
        """Take the pairs that touch at positions x (n_local, 3) and obstacles' points."""
        contact, old = self._contact, self._pairs
        beta, normal, force, met = contact.touching(x, places)
        points, stencil = contact.points[met], contact.stencil[met]
        sheet = points >= 0
        # in this order contact's pairs are sorted
        order = [met >= contact.n_owned, contact.number[met], contact.kind[met], contact.obstacle[met]]
        key = np.column_stack([*order, np.where(sheet, 0, points)])
        beta = np.where(sheet, beta, 0.0)
        start = np.einsum("ei,eik->ek", beta, x[stencil])
        side = beta.sum(axis=1)[:, None]  # 1 or −1 where the other side is an obstacle
        foot = np.where(np.abs(side) > 0.5, start * side, 0.0)
        slip, slid = np.zeros((len(met), 3)), np.zeros(len(met), dtype=np.bool_)
        if len(old.key) and len(met):
            same = np.empty(len(met), dtype=np.int64)
            friction_pairs.find(key, old.key, same)
            went = same >= 0
            slip[went], slid[went] = old.slip[same[went]], old.slid[same[went]]
            slip -= np.sum(slip * normal, axis=1, keepdims=True) * normal
        self._pairs = Pairs(key, beta, normal, start, slip, foot, force, slid)
        self.stale = True

    def take_pairs(self, x: Array, frozen: ObstacleMoves) -> None:
        self._renew(x, frozen.places)

    def element_state(self) -> tuple[Ints, Array]:
        """Vertices of counted pairs; their kind, obstacle, its points, slip [m], and whether they slid."""
        p = self._pairs
        counted = p.key[:, 0] == 0
        values = np.column_stack([p.key[:, 5:], p.slip, p.slid]).astype(np.float64)
        return p.vertices[counted], values[counted]

    def restore_elements(self, vertices: Ints, values: Array, own: range) -> None:
        vertices, what = vertices.copy(), values[:, :6].astype(np.int64)
        slip, edges, sheets = values[:, 6:9].copy(), what[:, 0] == EDGE_EDGE, what[:, 1] < 0
        # edges are named in the order of the present numbers
        for rows, first in ((edges, 0), (edges & sheets, 2)):
            turned = rows & (vertices[:, first] > vertices[:, first + 1])
            vertices[turned, first : first + 2] = vertices[turned, first : first + 2][:, ::-1]
        vertices[edges & ~sheets, 2:] = vertices[edges & ~sheets, :1]
        swapped = edges & sheets & (vertices[:, 0] > vertices[:, 2])
        vertices[swapped], slip[swapped] = vertices[swapped][:, [2, 3, 0, 1]], -slip[swapped]
        elsewhere = (vertices[:, 0] < own.start) | (vertices[:, 0] >= own.stop)
        key = np.column_stack([elsewhere, vertices, what])
        order = np.lexsort(key.T[::-1])
        # `take_pairs` finds the rest
        self._pairs = _no_pairs()._replace(key=key[order], slip=slip[order], slid=values[order, 9] > 0.5)

    # -- a step ------------------------------------------------------------------------------------

    def freeze(self, step: UpcomingStep) -> ObstacleMoves:
        obstacles = self._contact.obstacles
        stage, end = obstacles.moved(step.start, step.at), obstacles.moved(step.start, step.end)
        return ObstacleMoves(stage, end, obstacles.at(step.end))

    def _state(self, moved: list[tuple[Array, Array]]) -> tuple[NDArray[Any], ...]:
        """What the kernels take, with obstacles moved so."""
        if self._moved is not moved:
            p, number = self._taken, self._number
            start, side = p.start[number], self._beta.sum(axis=1)
            for obstacle, (rotation, translation) in enumerate(moved):
                mine = p.obstacle[number] == obstacle
                foot = p.foot[number][mine]
                start[mine] += side[mine, None] * (foot @ rotation.T + translation - foot)
            self._moved, self._start = moved, start
        return self.stencil, self._beta, self._normal, self._start, self._slip, self._spring, self._limit

    def energies(self, x: Array, frozen: ObstacleMoves) -> Array:
        out = np.empty(self.n_owned)
        friction_pairs.energies(x, *self._state(frozen.stage), out)
        return out

    def add_gradient(self, x: Array, frozen: ObstacleMoves, out: Array) -> None:
        friction_pairs.add_gradient(x, *self._state(frozen.stage), out)

    def hessians(self, x: Array, frozen: ObstacleMoves, lo: int, hi: int, blend: float, out: Array) -> None:
        friction_pairs.hessians(x, *self._state(frozen.stage), lo, blend, out)

    def force_scale(self, size: float) -> Array:
        return self._spring * size

    def accept(self, x: Array, frozen: ObstacleMoves) -> None:
        heat, slides = np.empty(self.n_elements), np.empty(self.n_elements, dtype=np.bool_)
        state = self._state(frozen.end)
        self._on_obstacles = self._forces(x, state)
        friction_pairs.slide(x, *state, heat, slides)
        first = self.stencil[: self.n_owned, 0]
        np.add.at(self._heat[:, 0], first, heat[: self.n_owned])
        self._taken.slip[self._number], self._taken.slid[self._number] = self._slip, slides
        self._renew(x, frozen.places)

    def _forces(self, x: Array, state: tuple[NDArray[Any], ...]) -> Array:
        """Force [N] on each obstacle and its torque [N m] about the origin by the owned pairs, (count, 6)."""
        number = self._taken.obstacle[self._number][: self.n_owned]
        out = np.zeros((len(self._contact.obstacles.each), 6))
        for obstacle in np.unique(number[number >= 0]):
            of, pull = np.flatnonzero(number == obstacle), np.zeros_like(x)
            friction_pairs.add_gradient(x, *(part[of] for part in state), pull)
            out[obstacle] = *pull.sum(axis=0), *np.cross(x, pull).sum(axis=0)
        return out

    def obstacle_forces(self, x: Array, frozen: ObstacleMoves, count: int) -> Array:
        return self._on_obstacles

    def state(self) -> dict[str, Array]:
        return {"friction_work": self._heat}

    def restore(self, state: Mapping[str, Array]) -> None:
        self._heat = state["friction_work"].copy()

    def history(self, x: Array, frozen: ObstacleMoves) -> Mapping[str, float]:
        return {"friction_work": float(self._heat[:, 0].sum())}


def elements(rest: RestShape) -> None:
    """There are none before anything touches."""


def make(elements: None, scene: Scene, mass: Array) -> CoulombFriction:
    """The term on one rank; `CoulombFriction.set_up` must follow."""
    return CoulombFriction(scene, len(mass))
