"""Bending with one unknown on every edge: directors, whose angles with the triangles make a curvature.

An edge carries a director (``midedge_shape``), which stands for the sheet's normal in its middle. Per
triangle of rest area A, with rest lengths l_i and rest normals m_i of the edges in material axes::

    κ = −Σ_i T(α_i − ᾱ_i) (l_i / A) (m_x², m_y², 2 m_x m_y)_i
    energy = ½ A (κ − κ̄)ᵀ D (κ − κ̄)

κ = (κ11, κ22, 2 κ12) is positive where the sheet bends towards its normal; ᾱ are the angles of the rest
shape, κ̄ is the material's rest curvature and D its stiffness [N·m]. T is the tangent of angles up to 45° and
grows less beyond, where other edges than its own feel less of it (``midedge_shape``). As κ is linear in the
three T the energy is a quadratic form of theirs. The director's angle has no mass: it is where moments
balance, which makes edges of one, two or more triangles alike. A triangle's stencil is its own corners and
edges.

Sources: constant curvatures from rotations of the edges are Morley's plate (Aeronautical Quarterly 19 (1968)
149-169); on curved sheets Grinspun, Gingold, Reisman & Zorin, Computing discrete shape operators on general
meshes, Eurographics 2006; as a Hellan-Herrmann-Johnson method with the moments eliminated Neunteufel &
Schöberl, Computers & Structures 225 (2019) 106109.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.select import select_vertices
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.values import AXES
from lyra_petsc.terms import midedge_energy, midedge_mesh
from lyra_petsc.terms.hinge_energy import fading_limit
from lyra_petsc.terms.membrane import Membrane
from lyra_petsc.terms.midedge_mesh import CREASED
from lyra_petsc.terms.midedge_shape import (
    Frames,
    against,
    carried,
    carry,
    directions,
    directors,
    largest_angle,
    some_perpendicular,
    tangents,
    tangents_at,
    unit,
)
from lyra_petsc.terms.remembered import Remembered, unwritable
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import LARGEST_TURN, Elastic, Offsets, Term, UpcomingStep

AnyInts = NDArray[np.int32] | NDArray[np.int64]

STEEPEST = np.radians(89.95)
"""Angle of a director at the start from which on a scene is refused: rounding would tell which way it is
folded."""

(NO_FRICTION,) = unwritable(np.empty((0, 2)))
FLAT = np.empty((0, 3))
"""In place of tangents without energy that are all 0."""
UPRIGHT = np.empty((0, 3, 2))
"""In place of cos ᾱ and sin ᾱ of angles that are all 0."""

CANCELLED = 1e-4
"""Length of a sum of unit normals below which rounding would tell its direction."""


class Edges(NamedTuple):
    """The edges of this rank's triangles, each once.

    Attributes
    ----------
    places : (n,) int32
        Of their unknowns in the flat form of arrays over local rows.
    ends : (n, 2) int32
        Local rows of their vertices; directors turn about the way from the first to the second.
    length : (n,)
        At rest [m].
    of_triangles : (E, 3) int32
        The edge opposite each corner.
    """

    places: NDArray[np.int32]
    ends: NDArray[np.int32]
    length: Array
    of_triangles: NDArray[np.int32]


class MidEdge(Elastic):
    """The bending energy of all triangles.

    Parameters
    ----------
    elements : Elements
        Stencil (E, 3), edges (E, 3) opposite the corners; data ``stiffness`` (E, 6) of the tangents [N·m],
        ``rest`` (E, 3) tangents without energy, ``tilt`` (E, 3, 2) cos ᾱ and sin ᾱ, ``sign`` (E, 3) int8 1
        where the triangle runs along an edge, else −1, ``length`` (E, 3) of the edges [m], ``tangent`` and
        ``director`` (E, 3, 3) directions of edges and directors before the start, ``material`` (E, 2, 2) the
        ways from the first corner to the others in material axes [m], ``triangle`` (E,) int32 numbers in the
        mesh, ``height`` (E,) the smallest [m], ``limit`` (E,) of |n|² [m⁴], ``damping`` (E,) [s].
    """

    def __init__(self, elements: Elements) -> None:
        data = elements.data
        super().__init__(elements.without("tangent", "director", "length", "rest", "tilt", "height"))
        assert self.edges is not None
        places, first, index = np.unique(self.edges, return_index=True, return_inverse=True)
        triangle, side = np.divmod(first, 3)
        ends = np.stack([self.stencil[triangle, (side + k) % 3] for k in (1, 2)], axis=1)
        against = data["sign"].ravel()[first] < 0
        ends[against] = ends[against, ::-1]
        index = index.reshape(-1, 3).astype(np.int32)
        self.of_edges = Edges(places, ends, data["length"].ravel()[first], index)
        self.frames = Frames(*(data[name].reshape(-1, 3)[first] for name in ("tangent", "director")))
        rest = data["rest"] if data["rest"].any() else FLAT
        self._tilt = tilt_of(data)
        self._constants = data["stiffness"], rest, data["limit"], NO_FRICTION
        self._bent: Remembered[Array] | None = None
        self._bent_of: Frames | None = None
        self._at_end: Frames | None = None  # which have followed already
        self._membrane: Membrane | None = None  # of the same triangles

    def connect(self, terms: Iterable[Term]) -> None:
        membrane = next((term for term in terms if isinstance(term, Membrane)), None)
        if membrane is not None and np.array_equal(membrane.stencil, self.stencil):
            self._membrane, self.stencil = membrane, membrane.stencil
            own, theirs = self.elements.without("material"), membrane.elements
            self.elements = replace(own, stencil=theirs.stencil)
            numbers = own.data["triangle"]
            if np.array_equal(numbers, theirs.index) and np.array_equal(own.index, theirs.index):
                data = {**own.data, "triangle": theirs.index}
                self.elements = replace(self.elements, index=theirs.index, data=data)

    @property
    def _material(self) -> Array:
        """The ways (E, 2, 2) from the first corner to the others in material axes [m]."""
        if self._membrane is None:
            return self.elements.data["material"]
        return np.linalg.inv(self._membrane.elements.data["inverse"]).transpose(0, 2, 1)

    @property
    def _steepest(self) -> Array:
        """Largest squared gradient (E,) [1/m²] of a barycentric coordinate: one over the smallest height²."""
        if self._membrane is None:
            inverse = np.linalg.inv(self._material.transpose(0, 2, 1))
        else:
            inverse = self._membrane.elements.data["inverse"]
        (a, b), (c, d) = inverse.transpose(1, 2, 0)
        largest: Array = np.maximum(a * a + b * b, c * c + d * d)
        return np.maximum(largest, (a + c) ** 2 + (b + d) ** 2)

    # -- frames ------------------------------------------------------------------------------------

    def begin(self, x: Array) -> None:
        self.frames = self._carried(self.frames, x)

    def freeze(self, step: UpcomingStep) -> Frames:
        return self.frames

    def accept(self, x: Array, frozen: Frames) -> None:
        if frozen is not self._at_end:
            self.forget()  # by other frames directors are others
            frozen = self._carried(frozen, x)
        self.frames = frozen

    def frames_at_end(self, x: Array, frozen: Frames) -> Frames:
        self._at_end = self._carried(frozen, x)
        return self._at_end

    @property
    def edge_stiffness(self) -> Array:
        diagonal = self.elements.data["stiffness"][:, [0, 3, 5]]
        sums = np.bincount(self.of_edges.of_triangles.ravel(), diagonal.ravel())
        return np.asarray(sums / self.of_edges.length**2)

    def nearer(self, x: Array, frozen: Frames, held: Mask) -> Frames | None:
        places, ends, *_ = self.of_edges
        far = np.empty(len(ends), dtype=bool)
        if not against(x, ends, frozen.tangent, far):
            return None
        far &= ~held.ravel()[places]
        if not far.any():
            return None
        tangent = self._tangents(x)
        found = Frames(frozen.tangent.copy(), frozen.across.copy())
        found.across[far] = carried(Frames(frozen.tangent[far], frozen.across[far]), tangent[far])
        found.tangent[far] = tangent[far]
        return found

    def followed(
        self, x: Array, way: Array, frozen: Frames, along: Array | None = None
    ) -> tuple[Ints, Array]:
        places, _, length, edges = self.of_edges
        linear = way.ravel()[places] / length
        far = np.abs(linear) > LARGEST_TURN if along is None else np.ones(len(places), dtype=bool)
        along = way if along is None else along
        if not far.any():
            return np.empty(0, dtype=np.int64), np.empty(0)
        chosen = np.flatnonzero(far[edges].any(axis=1))
        number, sign = edges[chosen], self.elements.data["sign"][chosen]
        y = x + along
        y.ravel()[places] = x.ravel()[places]  # unknowns as they were
        before, after = self._directors(x, frozen)[number], self._directors(y, frozen)[number]
        corners, moved = x[self.stencil[chosen]], way[self.stencil[chosen]]
        angle, normal, square, e = _angles(corners, before)
        turned, _, left, _ = _angles(y[self.stencil[chosen]], after)
        height = np.sum(moved * normal[:, None, :], axis=2)
        size = np.sqrt(square)[:, None] * np.linalg.norm(e, axis=2)
        with np.errstate(divide="ignore", invalid="ignore"):
            expected = -np.einsum("eij,ekj,ek->ei", e, e, height) / size
            spins = _spins(sign[:, :, None] * frozen.tangent[number], e)
            expected += np.sum(spins * (moved[:, [2, 0, 1]] - moved[:, [1, 2, 0]]), axis=2)
            turn = np.remainder(turned - angle + np.pi, 2.0 * np.pi) - np.pi
        weight = np.minimum(np.minimum(square, left) / self._constants[2][chosen], 1.0)[:, None]
        weight = np.where(np.isfinite(turn) & np.isfinite(expected), weight, 0.0)

        def mean(values: Array) -> Array:
            values = np.where(weight > 0.0, weight * sign * values, 0.0)
            sums = np.bincount(number.ravel(), values.ravel(), len(places))
            return np.divide(sums, total, out=np.zeros(len(places)), where=total > 0.0)[far]

        total = np.bincount(number.ravel(), weight.ravel(), len(places))
        bends = np.clip(linear[far] + mean(expected), -LARGEST_TURN, LARGEST_TURN)
        return places[far], length[far] * (bends - mean(turn))

    def anew(self, x: Array) -> Array:
        """Take frames that know nothing but the shape; unknowns (n,) of directors amid their triangles."""
        tangent = self._tangents(x)
        base = some_perpendicular(tangent)
        self.frames = Frames(tangent, base)
        mean = mean_directors(x, self.stencil, self.of_edges.of_triangles, len(tangent), self._tilt)
        angle = np.arctan2(np.sum(np.cross(tangent, base) * mean, axis=1), np.sum(base * mean, axis=1))
        return np.asarray(self.of_edges.length * np.nan_to_num(angle))

    def _carried(self, frames: Frames, x: Array) -> Frames:
        # in one piece: once they are others, an array larger than either finds room where they were
        tangent, across = np.empty((2, len(self.of_edges.ends), 3))
        directions(x, self.of_edges.ends, tangent)
        carry(*frames, tangent, across)
        return Frames(tangent, across)

    def _tangents(self, x: Array) -> Array:
        tangent = np.empty((len(self.of_edges.ends), 3))
        directions(x, self.of_edges.ends, tangent)
        return tangent

    def edge_state(self) -> dict[str, Array]:
        tangent, across = self.frames
        base = some_perpendicular(tangent)
        side = np.sum(np.cross(tangent, base) * across, axis=1)
        return {"frame": np.arctan2(side, np.sum(base * across, axis=1))}

    def restore_edges(self, state: Mapping[str, Array], x: Array) -> None:
        tangent = self._tangents(x)
        base, angle = some_perpendicular(tangent), state["frame"][:, None]
        self.frames = Frames(tangent, np.cos(angle) * base + np.sin(angle) * np.cross(tangent, base))

    @property
    def areas(self) -> Array:
        """Of the triangles (E,) at rest [m²]."""
        return areas(self._material)

    @property
    def edge_indices(self) -> Ints:
        return self.of_edges.places.astype(np.int64)

    def moment(self, force: Array, edges: Ints, x: Array, frozen: Frames) -> Array:
        """Moment (3,) [N·m] of forces (n,) [N] on the unknowns of these edges, beside that at their ends.

        Their work in a rotation, in which φ turns by ω · t − γ · (ω × e), is that of this moment.
        """
        tail, head = self.of_edges.ends[edges].T
        tangent, start = unit(x[head] - x[tail]), frozen.tangent[edges]
        about = (tangent + start) / (1.0 + np.sum(tangent * start, axis=1, keepdims=True))
        return (force * self.of_edges.length[edges]) @ about

    # -- energy ------------------------------------------------------------------------------------

    def bent(self, x: Array, frames: Frames) -> Array:
        """Tangents of directors (E, 4), as by ``midedge_shape.tangents``."""
        if self._bent is None or self._bent_of is not frames:
            self._bent_of = frames
            self._bent = Remembered(lambda at: self._computed(at, frames))
        return self._bent(x)

    def forget(self) -> None:
        self._bent = self._bent_of = None

    def _computed(self, x: Array, frames: Frames) -> Array:
        tangent = np.empty((self.n_elements, 4))
        director = self._directors(x, frames)
        tangents(x, self.stencil, self.of_edges.of_triangles, director, self._tilt, tangent)
        return tangent

    def _directors(self, x: Array, frames: Frames) -> Array:
        angle = x.ravel()[self.of_edges.places]
        angle /= self.of_edges.length
        # all at once: NumPy's are several at a time where the processor can
        cosine, sine = np.cos(angle), np.sin(angle, out=angle)
        out = np.empty((len(angle), 3))
        directors(x, self.of_edges.ends, *frames, cosine, sine, out)
        return out

    def energies(self, x: Array, frozen: Frames) -> Array:
        return self.all_energies(x, frozen, self.n_owned)

    def all_energies(self, x: Array, frozen: Frames, n: int) -> Array:
        """Energy [J] of the first n triangles of this rank, (n,)."""
        out = np.empty(n)
        midedge_energy.energies(self.bent(x, frozen), *self._constants, out)
        return out

    def add_gradient(self, x: Array, frozen: Frames, out: Array) -> None:
        numbers = self.stencil, self.of_edges.of_triangles, self.edges, self.elements.data["sign"]
        bent = frozen.tangent, self.bent(x, frozen), *self._constants
        midedge_energy.add_gradient(x, *numbers, *bent, self.of_edges.length, out)

    def add_hessian(
        self,
        x: Array,
        frozen: Frames,
        blend: float,
        weight: Array,
        offsets: Mapping[str, Offsets],
        values: Array,
        predicted: tuple[Array, Array] | None = None,
    ) -> None:
        numbers = self.of_edges.of_triangles, self.elements.data["sign"]
        bent = frozen.tangent, self.bent(x, frozen), *self._constants, self.of_edges.length
        at = offsets[f"{self.name} vertices"], offsets[self.name]
        midedge_energy.add_hessian(x, self.stencil, blend, *numbers, *bent, weight, *at, values)

    def largest_turn(self, way: Array) -> float:
        return float(largest_angle(way.ravel(), self.of_edges.places, self.of_edges.length))

    def force_scale(self, size: float) -> Array:
        stiffness = self.elements.data["stiffness"]
        return (stiffness[:, 0] + stiffness[:, 3] + stiffness[:, 5]) * size * self._steepest

    def curvatures(self, x: Array, frozen: Frames) -> Array:
        """κ11, κ22, κ12 [1/m] of all triangles of this rank in material axes, with that at rest, (E, 3).

        The angle of a crease at rest is no curvature.
        """
        found, tilt = self.bent(x, frozen)[:, :3].copy(), self._tilt
        if len(tilt):
            smooth = tilt[..., 0] > np.cos(CREASED)
            found[smooth] += tilt[..., 1][smooth] / tilt[..., 0][smooth]
        of_tangents = curvatures_of_tangents(self._material)
        curvature: Array = np.einsum("eki,ei->ek", of_tangents, found)
        curvature[:, 2] *= 0.5
        return curvature


def areas(material: Array) -> Array:
    """Areas (n,) [m²] of triangles whose corners are ``material`` (n, 2, 2) [m] from the first."""
    return 0.5 * np.abs(np.linalg.det(material))


def _outward(material: Array) -> tuple[Array, Array]:
    """Normals (n, 3, 2) of the edges opposite the corners in material axes, and their lengths (n, 3) [m]."""
    one, two = material[:, 0], material[:, 1]
    side = np.stack([two - one, -two, one], axis=1)
    size: Array = np.linalg.norm(side, axis=2)
    return np.stack([side[..., 1], -side[..., 0]], axis=2) / size[..., None], size


def curvatures_of_tangents(material: Array) -> Array:
    """κ11, κ22, 2 κ12 [1/m] of each tangent T_i, (n, 3, 3)."""
    normal, size = _outward(material)
    x, y = normal[..., 0], normal[..., 1]
    weight = (size / areas(material)[:, None])[:, None, :]
    return -np.stack([x * x, y * y, 2.0 * x * y], axis=1) * weight


def normals_of(x: Array, triangles: AnyInts) -> Array:
    """Unit normals (n, 3) of triangles (n, 3)."""
    a, b, c = (x[triangles[:, k]] for k in range(3))
    return unit(np.cross(b - a, c - a))


def _angles(corners: Array, director: Array) -> tuple[Array, Array, Array, Array]:
    """α (n, 3) of directors (n, 3, 3) of triangles (n, 3, 3); normals, |2A|² [m⁴], edges (n, 3, 3)."""
    edges = corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]]
    normal = np.cross(edges[:, 1], edges[:, 2])
    square = np.sum(normal * normal, axis=1)
    normal = unit(normal)
    side = np.sum(director * np.cross(unit(edges), normal[:, None, :]), axis=2)
    return np.arctan2(side, np.sum(director * normal[:, None, :], axis=2)), normal, square, edges


def _spins(frame: Array, edges: Array) -> Array:
    """γ [1/m] of edges (n, 3, 3) [m], as ``midedge_shape.spin``."""
    square = np.sum(edges * edges, axis=2, keepdims=True)
    found: Array = np.cross(edges, frame) / (
        square + np.sqrt(square) * np.sum(frame * edges, axis=2, keepdims=True)
    )
    return found


def tilt_of(data: Mapping[str, Array]) -> Array:
    """cos ᾱ and sin ᾱ (E, 3, 2) of elements, or nothing where all sheets are flat at rest."""
    return data["tilt"] if data["tilt"][..., 1].any() else UPRIGHT


def mean_directors(
    x: Array, triangles: AnyInts, number: AnyInts, n_edges: int, tilt: Array, most: float = np.inf
) -> Array:
    """Means (n_edges, 3) of the directors without energy of the triangles that have an edge, ``number``
    (F, 3) of it: of their unit normals, turned about the edge by ᾱ.

    Where they cancel each other, as in a fold of 180° or a cross, and where there are more than ``most``,
    that of the first triangle.
    """
    ways = np.repeat(normals_of(x, triangles)[:, None, :], 3, axis=1)
    if len(tilt):
        along = unit(x[triangles[:, [2, 0, 1]]] - x[triangles[:, [1, 2, 0]]])
        ways = tilt[..., :1] * ways + tilt[..., 1:] * np.cross(along, ways)
    ways, edges = ways.reshape(-1, 3), number.ravel()
    total: Array = np.stack([np.bincount(edges, ways[:, i], n_edges) for i in range(3)], axis=1)
    found, first, count = np.unique(edges, return_index=True, return_counts=True)
    lost = (np.linalg.norm(total[found], axis=1) < CANCELLED) | (count > most)
    total[found[lost]] = ways[first[lost]]
    return unit(total)


def edge_numbers(rest: RestShape, triangles: Ints) -> tuple[Ints, NDArray[np.int8]]:
    """Of triangles (F, 3) the edges opposite corners; 1 where they run from the lesser vertex, else −1."""
    tail, head = triangles[:, [1, 2, 0]], triangles[:, [2, 0, 1]]
    n = rest.mesh.n_vertices
    keys = rest.edges[:, 0] * n + rest.edges[:, 1]
    number = np.searchsorted(keys, np.minimum(tail, head) * n + np.maximum(tail, head))
    return number, np.where(tail < head, 1, -1).astype(np.int8)


def elements(rest: RestShape) -> Elements:
    """All triangles that bend by this model, with their constants (rank 0).

    Raises
    ------
    InputError
        Where the start shape is folded by 180° and the rest shape is not.
    """
    chosen = np.flatnonzero(rest.bends_with("midedge"))
    mesh, triangles = rest.mesh, rest.mesh.triangles[chosen]
    number, sign = edge_numbers(rest, triangles)
    edges, n_edges = rest.edges, len(rest.edges)
    material = np.linalg.inv(rest.inverse[chosen]).transpose(0, 2, 1)  # x1 − x0, x2 − x0
    size, area = _outward(material)[1], rest.area[chosen]
    curvature = curvatures_of_tangents(material)
    stiffness = np.array([shell.plate_matrix for shell in rest.shells])[rest.shell_of[chosen]]
    form = area[:, None, None] * np.einsum("eki,ekl,elj->eij", curvature, stiffness, curvature)
    rest.notes += midedge_mesh.narrow(rest, chosen, number, size, area)
    rest.notes += midedge_mesh.corners(rest, chosen, number, size, area)
    # the two faces of a seam may have edges of different lengths
    count = np.bincount(number.ravel(), minlength=n_edges)
    length = np.bincount(number.ravel(), size.ravel(), n_edges) / np.maximum(count, 1)

    surface = ~mesh.flat_rest[chosen]
    angle = np.zeros_like(size)  # at rest
    if surface.any():
        # where walls meet on both sides of a third one they go on straight
        director = mean_directors(mesh.rest, triangles[surface], number[surface], n_edges, UPRIGHT, 2)
        _mirror(director, rest, triangles, number, mesh.rest)
        angle[surface] = _angles_of(mesh.rest, triangles[surface], director[number[surface]])
        rest.notes += midedge_mesh.coarse(rest, chosen, number, size, curvature, angle)
    tilt = np.stack([np.cos(angle), np.sin(angle)], axis=2)
    at_rest = np.zeros_like(size)
    curved = np.array([shell.rest_curvature or (0.0, 0.0, 0.0) for shell in rest.shells]) * [1.0, 1.0, 2.0]
    if curved.any():
        at_rest[:] = np.linalg.solve(curvature, curved[rest.shell_of[chosen]][:, :, None])[:, :, 0]
        _check_curved(at_rest, rest, chosen, size)
    director = mean_directors(mesh.positions, triangles, number, n_edges, tilt)
    _mirror(director, rest, triangles, number, mesh.positions)
    director = director[number]
    _check(_angles_of(mesh.positions, triangles, director) - angle, number, edges, rest)
    ends: Array = mesh.positions[edges[number]]
    data = {
        "stiffness": np.stack([form[:, i, j] for i in range(3) for j in range(i, 3)], axis=1),
        "rest": at_rest,
        "tilt": tilt,
        "sign": sign,
        "length": length[number],
        "tangent": unit(ends[:, :, 1] - ends[:, :, 0]),
        "director": director,
        "material": material,
        "triangle": chosen.astype(np.int32),
        "height": 2.0 * area / size.max(axis=1),
        "limit": fading_limit(area),
        "damping": rest.per_triangle("damping")[chosen],
    }
    return Elements(triangles, data, edges=number)


def _mirror(director: Array, rest: RestShape, triangles: Ints, number: Ints, x: Array) -> None:
    """Turn directors (n_edges, 3) at positions x into the symmetry planes of handles in which edges lie.

    Such a plane is given at the start; on the rest shape it lies to each triangle as it does there.
    """
    mesh = rest.mesh
    for handle, each in enumerate(rest.scene.handles):
        if each.symmetry is None:
            continue
        held = select_vertices(mesh, each, key=f"handles[{handle}]", file=rest.scene.source)
        ends = triangles[:, [[1, 2], [2, 0], [0, 1]]]
        face, side = np.nonzero(np.isin(ends, held).all(axis=2))
        edges, corners = number[face, side], ends[face, side]

        def axes(at: Array, face: Ints = face, corners: Ints = corners) -> Array:
            """Edge, direction in the triangle normal to it, and normal, (n, 3, 3)."""
            normal, along = normals_of(at, triangles[face]), unit(at[corners[:, 1]] - at[corners[:, 0]])
            return np.stack([along, np.cross(normal, along), normal], axis=1)

        start, here = axes(mesh.positions), axes(x)
        plane = np.einsum("eik,ei->ek", here, start[:, :, AXES.index(each.symmetry)])
        inside = unit(np.cross(plane, here[:, 0]))
        towards = np.sum(inside * director[edges], axis=1, keepdims=True)
        director[edges] = np.where(towards < 0.0, -inside, inside)


def _angles_of(x: Array, triangles: Ints, director: Array) -> Array:
    """α (n, 3) [rad] of directors (n, 3, 3) on the edges opposite the corners of triangles (n, 3)."""
    return _angles(x[triangles], director)[0]


def _check(angle: Array, number: Ints, edges: Ints, rest: RestShape) -> None:
    """Refuse edges at which the start shape is folded by nearly 180° from the rest shape."""
    turned = np.abs(np.remainder(angle.ravel() + np.pi, 2.0 * np.pi) - np.pi)
    steep = np.flatnonzero(~(turned < STEEPEST))
    if len(steep):
        a, b = edges[number.ravel()[steep[0]]]
        raise InputError(
            f"the start shape is folded by 179.9° or more at the edge of vertices {a} and {b}, the rest "
            "shape is not, and bending_model: midedge cannot tell to which side; open the fold (or, where "
            "sheets meet, turn one over), or take bending_model: hinge",
            file=rest.scene.source,
            key="mesh",
        )


def _check_curved(at_rest: Array, rest: RestShape, chosen: Ints, size: Array) -> None:
    """Refuse triangles ``chosen`` with edges ``size`` (n, 3) [m] that have no energy where directors, with
    tangents at_rest (n, 3), lie beyond 180°.
    """
    most, least = np.abs(at_rest).max(axis=1), float(tangents_at(np.array(np.pi)))
    worst = int(most.argmax())
    if most[worst] > least:
        raise InputError(
            f"turns triangle {chosen[worst]} by more than 180° against its edges, of up to "
            f"{size[worst].max():.3g} m, which no edge can; take a mesh finer by "
            f"{most[worst] / least:.2g}, or less curvature",
            file=rest.scene.source,
            key=f"material[{rest.shell_of[chosen[worst]]}].rest_curvature",
        )


def coarse_elements(rest: RestShape) -> Elements:
    """Hinges between the same triangles."""
    from lyra_petsc.terms import bending  # where all bending is by edges nothing else needs it

    return bending.elements(rest, "midedge")


def make(elements: Elements, scene: Scene, mass: Array) -> MidEdge:
    """The term on one rank."""
    return MidEdge(elements)
