"""Pairs of a vertex and a triangle, or of two edges: named arrays of one length, from search to friction."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints, Mask, unwritable

Rows = NDArray[np.int32] | NDArray[np.int64]
"""Local rows of vertices."""


class NearPairs(NamedTuple):
    """The pairs that a search finds.

    Attributes
    ----------
    vertices : (E, 4)
        Numbers of the vertices; for points of obstacles that of the pair's first vertex of a sheet.
    kind, obstacle : (E,)
        Kind (`contact_pairs`), and number of the obstacle, −1 between sheets.
    obstacle_points : (E, 4)
        ~number of points of obstacles, 0 for vertices of sheets.
    surroundings : (E,)
        Code of the triangle's sides and corners (`surface_shares`).
    stiffness, narrowing : (E,)
        Factors of the barrier's stiffness, and by which its gap is smaller, in units of 1 / `AREA_UNITS`.
    """

    vertices: Ints
    kind: Ints
    obstacle: Ints
    obstacle_points: Ints
    surroundings: Ints
    stiffness: Ints
    narrowing: Ints


class BarrierPairs(NamedTuple):
    """Near pairs with the constants of their barriers.

    Attributes
    ----------
    vertices, kind, obstacle : (E, 4), (E,), (E,)
        As in `NearPairs`.
    points : (E, 4)
        Local rows of vertices, and ~number of points of obstacles.
    offset, gap : (E,)
        Distance [m] at which the gap is closed, and the gap [m]: images in symmetry planes and narrow places
        have less.
    stiffness : (E,)
        k [N/m].
    scale : (E,)
        Distance less thickness [m] over the distance less offset.
    shares : (E, 6)
        Of the sides and corners of a triangle (`surface_shares`).
    coordinate : (E,)
        Largest coordinate [m] of the obstacle's points and offset.
    """

    vertices: Ints
    kind: Ints
    obstacle: Ints
    points: Ints
    offset: Array
    gap: Array
    stiffness: Array
    scale: Array
    shares: Array
    coordinate: Array

    @property
    def geometry(self) -> tuple[Ints, Ints, Array, Array]:
        """Kinds, points, offsets and gaps: arguments of kernels."""
        return self.kind, self.points, self.offset, self.gap


class Contacts(NamedTuple):
    """The near pairs with a contact force that this rank counts.

    For a vertex of a sheet, pairs with the same nearest vertices are one contact.

    Attributes
    ----------
    pair : (m,)
        Numbers of the near pairs.
    rows, sheet_beta, beta : (m, 4)
        Local rows of the vertices, their coefficients β, 0 for points of obstacles, and those of all points:
        the vector between the nearest points is Σ β_i p_i.
    normal : (m, 3)
        Unit normals towards the first simplex.
    force, distance : (m,)
        Normal force [N], > 0, and distance less offset [m].
    obstacle : (m,)
        Number of the obstacle, −1 between sheets.
    points : (m, 4)
        Of the near pairs, as in `BarrierPairs`.
    """

    pair: Ints
    rows: Ints
    sheet_beta: Array
    beta: Array
    normal: Array
    force: Array
    distance: Array
    obstacle: Ints
    points: Ints


class FrictionPairs(NamedTuple):
    """Contacts with friction: what identifies them, their elastic slip, and where it counts from.

    Attributes
    ----------
    key : (E, 10)
        Numbers of the four nearest vertices, kind, obstacle, and ~number of the obstacle's points (0 for
        vertices of sheets): the same pair has the same key in every state.
    vertices : (E, 4)
        Numbers of all vertices of the triangle, or of both edges.
    slip : (E, 3)
        Elastic slip [m].
    slides : (E,)
        Whether the pair slid in the last step.
    beta : (E, 4)
        As `Contacts.sheet_beta`.
    tangents : (E, 2, 3)
        Unit vectors perpendicular to the normal and to each other.
    gradients : (E, 2, 4, 3)
        Gradients of the relative displacement along ``tangents`` with respect to the vertices' positions.
    start : (E, 2)
        Sum of the products [m] of gradients and positions where the slip is the elastic one.
    contact_point : (E, 3)
        Where an obstacle is touched [m]; 0 between sheets.
    force, factor, stiffness : (E,)
        Normal force [N], factor of friction (`friction_pairs.LEVER`), and k of the barrier [N/m].
    """

    key: Ints
    vertices: Ints
    slip: Array
    slides: Mask
    beta: Array
    tangents: Array
    gradients: Array
    start: Array
    contact_point: Array
    force: Array
    factor: Array
    stiffness: Array

    @property
    def obstacle(self) -> Ints:
        """Number of the obstacle, −1 between sheets, (E,)."""
        return self.key[:, 5]

    @property
    def body_points(self) -> Ints:
        """~number of the obstacle's points, 0 for vertices of sheets, (E, 4)."""
        return self.key[:, 6:]

    def along(self, vectors: Array) -> Array:
        """Tangential components (E, 2) of vectors (E, 3)."""
        components: Array = np.einsum("eck,ek->ec", self.tangents, vectors)
        return components

    def displacement(self, dx: Array) -> Array:
        """Relative displacements (E, 2) along the tangents, where the four vertices move by dx (E, 4, 3)."""
        components: Array = np.einsum("ecik,eik->ec", self.gradients, dx)
        return components

    def pulls(self, friction: Array) -> Array:
        """Forces (E, 4, 3) [N] on the vertices by a friction (E, 2) [N] along the tangents."""
        forces: Array = np.einsum("ec,ecik->eik", friction, self.gradients)
        return forces


AnyPairs = TypeVar("AnyPairs", NearPairs, Contacts, FrictionPairs)


def chosen(pairs: AnyPairs, rows: Any) -> AnyPairs:
    """Some of the pairs."""
    return type(pairs)(*(values[rows] for values in pairs))


def joined(parts: Sequence[AnyPairs]) -> AnyPairs:
    """The pairs of all parts, of which there is at least one, one after another."""
    return type(parts[0])(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def no_near_pairs() -> NearPairs:
    """No pairs."""
    one, four = np.empty(0, dtype=np.int64), np.empty((0, 4), dtype=np.int64)
    return NearPairs(four, one, one, four, one, one, one)


def new_friction_pairs(key: Ints, vertices: Ints, slip: Array, slides: Mask) -> FrictionPairs:
    """Pairs of which the other arrays are 0."""
    shapes = (4,), (2, 3), (2, 4, 3), (2,), (3,), (), (), ()
    return FrictionPairs(key, vertices, slip, slides, *(np.zeros((len(key), *shape)) for shape in shapes))


def no_friction_pairs() -> FrictionPairs:
    """No pairs."""
    key, vertices = (np.empty((0, n), dtype=np.int64) for n in (10, 4))
    return new_friction_pairs(key, vertices, np.empty((0, 3)), np.empty(0, dtype=np.bool_))


class ActivePairs(NamedTuple):
    """Pairs nearer than the gap; of those with the same nearest vertices only one.

    Attributes
    ----------
    lower_bound : (E,)
        Lower bound of the distance less offset [m] of every pair, exact below the gap.
    pair, weight, owned_weight, beta, energy, derivatives : (m, …)
        Data of the active pairs, as `contact_pairs.find_active` writes them.
    """

    lower_bound: Array
    pair: Ints
    weight: Array
    owned_weight: Array
    beta: Array
    energy: Array
    derivatives: Array

    @property
    def square(self) -> Array:
        """|g|² [m²], (m,)."""
        g = self.derivatives[:, :3]
        square: Array = np.einsum("mk,mk->m", g, g)
        return square

    @property
    def stiffness(self) -> Array:
        """b″ times the mollifier [N/m], (m,)."""
        return self.derivatives[:, 5] * self.derivatives[:, 4] * self.square

    @property
    def forces(self) -> tuple[Ints, Array, Array, Array]:
        """The arguments of kernels: pair, weight, β and derivatives."""
        return self.pair, self.weight, self.beta, self.derivatives


@dataclass(frozen=True, eq=False)
class ActiveAt:
    """The active pairs at the positions of an evaluation, found when they are first needed.

    Attributes
    ----------
    set_number : int
        Another one for each set of near pairs, of which `ActivePairs.pair` are numbers.
    find : callable
    """

    set_number: int
    find: Callable[[], ActivePairs]

    @cached_property
    def pairs(self) -> ActivePairs:
        """The pairs."""
        return self.find()


_EMPTY = np.empty(0)
_EMPTY_ROWS = np.empty(0, dtype=np.int64), _EMPTY, _EMPTY, np.empty((0, 4)), _EMPTY, np.empty((0, 6))
NO_PAIRS = ActivePairs(*unwritable(_EMPTY, *_EMPTY_ROWS))
