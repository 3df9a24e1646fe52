"""Bending with one unknown on every edge: curvatures from the angles between directors and triangles.

Every edge has a director (``midedge_shape``), which represents the sheet's normal at its midpoint. Per
triangle of rest area A, with rest lengths l_i and rest normals m_i of the edges in material axes::

    κ = −Σ_i T(α_i − ᾱ_i) (l_i / A) (m_x², m_y², 2 m_x m_y)_i
    energy = ½ A (κ − κ̄)ᵀ D (κ − κ̄)

κ = (κ11, κ22, 2 κ12) is positive where the sheet bends towards its normal; ᾱ are the angles of the rest
shape, κ̄ is the material's rest curvature and D its stiffness [N·m]. T is the tangent of angles up to 45° and
grows more slowly beyond, where its coupling with the other edges is weakened, too (``midedge_shape``). As κ
is linear in the three T the energy is a quadratic form in them. The director's angle has no mass: it takes
the value at which moments balance, whether an edge has one, two or more triangles. A triangle's stencil
consists of its own corners and edges.

Sources: constant curvatures from rotations of the edges are Morley's plate (Aeronautical Quarterly 19 (1968)
149-169); on curved sheets Grinspun, Gingold, Reisman & Zorin, Computing discrete shape operators on general
meshes, Eurographics 2006; as a Hellan-Herrmann-Johnson method with the moments eliminated Neunteufel &
Schöberl, Computers & Structures 225 (2019) 106109.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints, Mask, unwritable
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.select import select_vertices
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.values import AXES
from lyra_petsc.terms.bending import midedge_energy, midedge_mesh
from lyra_petsc.terms.bending.hinge_energy import fading_limit
from lyra_petsc.terms.bending.midedge_mesh import CREASED
from lyra_petsc.terms.bending.midedge_shape import (
    Frames,
    directions,
    directors,
    largest_angle,
    mark_turned_edges,
    some_perpendicular,
    tangents,
    tangents_at,
    transport,
    transported,
    unit,
)
from lyra_petsc.terms.membrane import Membrane
from lyra_petsc.terms.protocols import (
    LARGEST_ROTATION,
    HasDirectors,
    HasGeometry,
    Located,
    Place,
    TermState,
)
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Assembly, Term, UpcomingStep

AnyInts = NDArray[np.int32] | NDArray[np.int64]

LARGEST_FOLD = np.radians(89.95)
"""Angle [rad] of a director at the start from which a scene is refused: the direction of the fold would
depend on round-off."""

(NO_FRICTION,) = unwritable(np.empty((0, 2)))
NO_REST_TANGENTS = np.empty((0, 3))
"""Stands for rest tangents T̄ that are all 0."""
NO_REST_ROTATION = np.empty((0, 3, 2))
"""Stands for cos ᾱ and sin ᾱ of angles that are all 0."""

SMALLEST_SUM = 1e-4
"""Length of a sum of unit normals below which its direction depends on round-off."""


class Edges(NamedTuple):
    """The edges of this rank's triangles, each once.

    Attributes
    ----------
    indices : (n,) int32
        Indices of their unknowns in flattened arrays over local rows, ascending.
    ends : (n, 2) int32
        Local rows of their vertices; directors rotate about the vector from the first to the second.
    length : (n,)
        Rest length [m].
    of_triangles : (E, 3) int32
        Number of the edge opposite each corner of the triangles.
    """

    indices: NDArray[np.int32]
    ends: NDArray[np.int32]
    length: Array
    of_triangles: NDArray[np.int32]


class MidEdge(HasDirectors, HasGeometry):
    """The bending energy of all triangles.

    Parameters
    ----------
    elements : Elements
        Stencil (E, 3), edges (E, 3) opposite the corners; data ``stiffness`` (E, 6) K [N·m], ``rest`` (E, 3)
        T̄, ``rest_rotation`` (E, 3, 2) cos ᾱ and sin ᾱ, ``sign`` (E, 3) int8 1 where the triangle runs along
        an edge, else −1, ``length`` (E, 3) rest lengths of the edges [m], ``direction`` and ``director``
        (E, 3, 3) unit vectors along the edges and directors at the start, ``material`` (E, 2, 2) the vectors
        from the first corner to the others in material axes [m], ``triangle`` (E,) int32 numbers in the mesh,
        ``height`` (E,) smallest height [m], ``limit`` (E,) of |n|² [m⁴] below which the energy fades,
        ``damping`` (E,) [s].

    Attributes
    ----------
    of_edges : Edges
    frames : Frames
        Frames of the edges, as ``freeze`` returns them.
    """

    def __init__(self, elements: Elements) -> None:
        data = elements.data
        super().__init__(
            elements.without("direction", "director", "length", "rest", "rest_rotation", "height")
        )
        assert self.edges is not None
        indices, first, index = np.unique(self.edges, return_index=True, return_inverse=True)
        triangle, side = np.divmod(first, 3)
        ends = np.stack([self.stencil[triangle, (side + k) % 3] for k in (1, 2)], axis=1)
        reverse = data["sign"].ravel()[first] < 0
        ends[reverse] = ends[reverse, ::-1]
        index = index.reshape(-1, 3).astype(np.int32)
        self.of_edges = Edges(indices, ends, data["length"].ravel()[first], index)
        self.frames = Frames(*(data[name].reshape(-1, 3)[first] for name in ("direction", "director")))
        rest = data["rest"] if data["rest"].any() else NO_REST_TANGENTS
        self._rest_rotation = rest_rotation_of(data)
        self._constants = data["stiffness"], rest, data["limit"], NO_FRICTION
        self._end_frames = -1  # the number of those that `frames_at_end` returned
        self._membrane: Membrane | None = None  # if it has the same triangles

    def connect(self, terms: Iterable[Term]) -> None:
        membrane = next((term for term in terms if isinstance(term, Membrane)), None)
        if membrane is not None and np.array_equal(membrane.stencil, self.stencil):
            # arrays that both terms need are shared to save memory
            self._membrane, self.stencil = membrane, membrane.stencil
            own, theirs = self.elements.without("material"), membrane.elements
            self.elements = replace(own, stencil=theirs.stencil)
            numbers = own.data["triangle"]
            if np.array_equal(numbers, theirs.index) and np.array_equal(own.index, theirs.index):
                data = {**own.data, "triangle": theirs.index}
                self.elements = replace(self.elements, index=theirs.index, data=data)

    @property
    def _material(self) -> Array:
        """Vectors (E, 2, 2) from the first corner to the others in material axes [m]."""
        if self._membrane is None:
            return self.elements.data["material"]
        return np.linalg.inv(self._membrane.elements.data["inverse"]).transpose(0, 2, 1)

    @property
    def _largest_squared_gradient(self) -> Array:
        """Largest squared gradient (E,) [1/m²] of a barycentric coordinate: one over the smallest height²."""
        if self._membrane is None:
            inverse = np.linalg.inv(self._material.transpose(0, 2, 1))
        else:
            inverse = self._membrane.elements.data["inverse"]
        (a, b), (c, d) = inverse.transpose(1, 2, 0)
        largest: Array = np.maximum(a * a + b * b, c * c + d * d)
        return np.maximum(largest, (a + c) ** 2 + (b + d) ** 2)

    # -- frames ------------------------------------------------------------------------------------

    def initialise(self, x: Array) -> None:
        self.frames = self._transported(self.frames, x)

    def freeze(self, step: UpcomingStep) -> Frames:
        return self.frames

    def accept(self, x: Array, frozen: Frames) -> None:
        if frozen.number != self._end_frames:
            frozen = self._transported(frozen, x)
        self.frames = frozen

    def frames_at_end(self, x: Array, frozen: Frames) -> Frames:
        frames = self._transported(frozen, x)
        self._end_frames = frames.number
        return frames

    def edge_stiffness(self, weight: Array | None = None) -> Array:
        diagonal = self.elements.data["stiffness"][:, [0, 3, 5]]
        if weight is not None:
            diagonal = weight[:, None] * diagonal
        sums = np.bincount(self.of_edges.of_triangles.ravel(), diagonal.ravel())
        return np.asarray(sums / self.of_edges.length**2)

    def updated_frames(self, x: Array, frozen: Frames, held: Mask) -> Frames | None:
        indices, ends, *_ = self.of_edges
        far = np.empty(len(ends), dtype=bool)
        if not mark_turned_edges(x, ends, frozen.direction, far):
            return None
        far &= ~held.ravel()[indices]
        if not far.any():
            return None
        direction = self._edge_directions(x)[far]
        frames = Frames(frozen.direction.copy(), frozen.reference.copy())
        frames.reference[far] = transported(Frames(frozen.direction[far], frozen.reference[far]), direction)
        frames.direction[far] = direction
        return frames

    def edge_increments(
        self, x: Array, increment: Array, frozen: Frames, displacement: Array | None = None
    ) -> tuple[Ints, Array]:
        indices, _, length, edges = self.of_edges
        rotation = increment.ravel()[indices] / length
        if displacement is None:
            far, displacement = np.abs(rotation) > LARGEST_ROTATION, increment
        else:
            far = np.ones(len(indices), dtype=bool)
        if not far.any():
            return np.empty(0, dtype=np.int64), np.empty(0)
        chosen = np.flatnonzero(far[edges].any(axis=1))
        number, sign = edges[chosen], self.elements.data["sign"][chosen]
        y = x + displacement
        y.ravel()[indices] = x.ravel()[indices]  # vertices move, unknowns of edges do not
        before, after = self._directors(x, frozen)[number], self._directors(y, frozen)[number]
        corners, moved = x[self.stencil[chosen]], increment[self.stencil[chosen]]
        angle, normal, square, e = _director_angles(corners, before)
        angle_after, _, square_after, _ = _director_angles(y[self.stencil[chosen]], after)
        height = np.sum(moved * normal[:, None, :], axis=2)
        size = np.sqrt(square)[:, None] * np.linalg.norm(e, axis=2)
        with np.errstate(divide="ignore", invalid="ignore"):
            # change of α to first order, from ∂α/∂x of ``midedge_energy``, and the real one
            linear = -np.einsum("eij,ekj,ek->ei", e, e, height) / size
            spins = _spins(sign[:, :, None] * frozen.direction[number], e)
            linear += np.sum(spins * (moved[:, [2, 0, 1]] - moved[:, [1, 2, 0]]), axis=2)
            change = np.remainder(angle_after - angle + np.pi, 2.0 * np.pi) - np.pi
        weight = np.minimum(np.minimum(square, square_after) / self._constants[2][chosen], 1.0)[:, None]
        weight = np.where(np.isfinite(change) & np.isfinite(linear), weight, 0.0)

        def mean(values: Array) -> Array:
            """Mean over the triangles of each far edge."""
            values = np.where(weight > 0.0, weight * sign * values, 0.0)
            sums = np.bincount(number.ravel(), values.ravel(), len(indices))
            return np.divide(sums, total, out=np.zeros(len(indices)), where=total > 0.0)[far]

        total = np.bincount(number.ravel(), weight.ravel(), len(indices))
        # directors rotate relative to their triangles as the linear increment says, up to a limit
        relative = np.clip(rotation[far] + mean(linear), -LARGEST_ROTATION, LARGEST_ROTATION)
        return indices[far], length[far] * (relative - mean(change))

    def reset_frames(self, x: Array) -> Array:
        """Choose frames that depend on positions x only.

        Returns the unknowns (n,) [m] of directors that are the means of their triangles' rest directors.
        """
        direction = self._edge_directions(x)
        base = some_perpendicular(direction)
        self.frames = Frames(direction, base)
        edges = self.of_edges.of_triangles
        mean = mean_directors(x, self.stencil, edges, len(direction), self._rest_rotation)
        angle = np.arctan2(np.sum(np.cross(direction, base) * mean, axis=1), np.sum(base * mean, axis=1))
        return np.asarray(self.of_edges.length * np.nan_to_num(angle))

    def _transported(self, frames: Frames, x: Array) -> Frames:
        """Frames parallel transported to the edges' directions at positions x."""
        # in one allocation: once it is freed, an array larger than either fits into its memory
        direction, reference = np.empty((2, len(self.of_edges.ends), 3))
        directions(x, self.of_edges.ends, direction)
        transport(*frames.vectors, direction, reference)
        return Frames(direction, reference)

    def _edge_directions(self, x: Array) -> Array:
        direction = np.empty((len(self.of_edges.ends), 3))
        directions(x, self.of_edges.ends, direction)
        return direction

    def state(self) -> dict[str, TermState]:
        direction, reference = self.frames.vectors
        base = some_perpendicular(direction)
        side = np.sum(np.cross(direction, base) * reference, axis=1)
        return {"frame": TermState(Place.EDGE, np.arctan2(side, np.sum(base * reference, axis=1)))}

    def restore(self, values: Mapping[str, Array], x: Array) -> None:
        direction = self._edge_directions(x)
        base, angle = some_perpendicular(direction), values["frame"][:, None]
        self.frames = Frames(direction, np.cos(angle) * base + np.sin(angle) * np.cross(direction, base))

    @property
    def areas(self) -> Array:
        """Rest areas of the triangles, (E,) [m²]."""
        return areas(self._material)

    @property
    def edge_indices(self) -> Ints:
        return self.of_edges.indices.astype(np.int64)

    def moment(self, force: Array, edges: Ints, x: Array, frozen: Frames) -> Array:
        """Moment (3,) [N·m] of forces (n,) [N] on the unknowns of ``edges`` (n,), but not on their ends.

        It does the same work as these forces in a rotation, in which φ changes by ω · t − γ · (ω × e).
        """
        tail, head = self.of_edges.ends[edges].T
        tangent, start = unit(x[head] - x[tail]), frozen.direction[edges]
        about = (tangent + start) / (1.0 + np.sum(tangent * start, axis=1, keepdims=True))
        return (force * self.of_edges.length[edges]) @ about

    # -- energy ------------------------------------------------------------------------------------

    def compute_geometry(self, x: Array, frozen: Frames) -> Array:
        """Tangents T of directors' angles and |N|² of triangles, (E, 4), by `midedge_shape.tangents`."""
        tangent = np.empty((self.n_elements, 4))
        director = self._directors(x, frozen)
        tangents(x, self.stencil, self.of_edges.of_triangles, director, self._rest_rotation, tangent)
        return tangent

    def _directors(self, x: Array, frames: Frames) -> Array:
        angle = x.ravel()[self.of_edges.indices]
        angle /= self.of_edges.length
        # NumPy's functions of whole arrays use SIMD instructions
        cosine, sine = np.cos(angle), np.sin(angle, out=angle)
        out = np.empty((len(angle), 3))
        directors(x, self.of_edges.ends, *frames.vectors, cosine, sine, out)
        return out

    def energies(self, x: Array, frozen: Frames | Located) -> Array:
        return self.all_energies(x, frozen, self.n_owned)

    def all_energies(self, x: Array, frozen: Frames | Located, n: int) -> Array:
        """Energy [J] of the first n triangles of this rank, (n,)."""
        out = np.empty(n)
        midedge_energy.energies(self.at(x, frozen).geometry, *self._constants, out)
        return out

    def add_gradient(self, x: Array, frozen: Frames | Located, out: Array) -> None:
        numbers = self.stencil, self.of_edges.of_triangles, self.edges, self.elements.data["sign"]
        at = self.at(x, frozen)
        bent = at.frozen.direction, at.geometry, *self._constants
        midedge_energy.add_gradient(x, *numbers, *bent, self.of_edges.length, out)

    def add_hessian(self, x: Array, frozen: Frames | Located, into: Assembly) -> None:
        numbers, at = (self.of_edges.of_triangles, self.elements.data["sign"]), self.at(x, frozen)
        bent = at.frozen.direction, at.geometry, *self._constants, self.of_edges.length
        to = into.offsets[f"{self.name} vertices"], into.offsets[self.name], into.values
        midedge_energy.add_hessian(x, self.stencil, into.convexity, *numbers, *bent, into.weight, *to)

    def largest_rotation(self, increment: Array) -> float:
        return float(largest_angle(increment.ravel(), self.of_edges.indices, self.of_edges.length))

    def force_scale(self, size: float) -> Array:
        stiffness = self.elements.data["stiffness"]
        return (stiffness[:, 0] + stiffness[:, 3] + stiffness[:, 5]) * size * self._largest_squared_gradient

    def curvatures(self, x: Array, frozen: Frames | Located) -> Array:
        """κ11, κ22, κ12 [1/m] of all triangles of this rank in material axes, (E, 3).

        The curvature of the rest shape is included, the angles of its creases are not.
        """
        tangent, rotation = self.at(x, frozen).geometry[:, :3].copy(), self._rest_rotation
        if len(rotation):
            smooth = rotation[..., 0] > np.cos(CREASED)
            tangent[smooth] += rotation[..., 1][smooth] / rotation[..., 0][smooth]
        of_tangents = curvatures_of_tangents(self._material)
        curvature: Array = np.einsum("eki,ei->ek", of_tangents, tangent)
        curvature[:, 2] *= 0.5
        return curvature


def areas(material: Array) -> Array:
    """Areas (n,) [m²] of triangles, from the vectors ``material`` (n, 2, 2) [m] along two sides."""
    return 0.5 * np.abs(np.linalg.det(material))


def _edge_normals(material: Array) -> tuple[Array, Array]:
    """Outward unit normals (n, 3, 2) of the edges in material axes, and their lengths (n, 3) [m]."""
    one, two = material[:, 0], material[:, 1]
    side = np.stack([two - one, -two, one], axis=1)
    size: Array = np.linalg.norm(side, axis=2)
    return np.stack([side[..., 1], -side[..., 0]], axis=2) / size[..., None], size


def curvatures_of_tangents(material: Array) -> Array:
    """Curvatures κ11, κ22, 2 κ12 [1/m] (second axis) for a unit tangent T_i (third axis), (n, 3, 3)."""
    normal, size = _edge_normals(material)
    x, y = normal[..., 0], normal[..., 1]
    weight = (size / areas(material)[:, None])[:, None, :]
    return -np.stack([x * x, y * y, 2.0 * x * y], axis=1) * weight


def normals_of(x: Array, triangles: AnyInts) -> Array:
    """Unit normals (n, 3) of triangles (n, 3)."""
    a, b, c = (x[triangles[:, k]] for k in range(3))
    return unit(np.cross(b - a, c - a))


def _director_angles(corners: Array, director: Array) -> tuple[Array, Array, Array, Array]:
    """Angles α (n, 3) [rad] of the directors (n, 3, 3) of triangles with ``corners`` (n, 3, 3) [m].

    Also the unit normals (n, 3), (2A)² (n,) [m⁴] and the edges (n, 3, 3) [m] of the triangles.
    """
    edges = corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]]
    normal = np.cross(edges[:, 1], edges[:, 2])
    square = np.sum(normal * normal, axis=1)
    normal = unit(normal)
    side = np.sum(director * np.cross(unit(edges), normal[:, None, :]), axis=2)
    return np.arctan2(side, np.sum(director * normal[:, None, :], axis=2)), normal, square, edges


def _spins(frame: Array, edges: Array) -> Array:
    """γ [1/m] of edges (n, 3, 3) [m] as in ``midedge_shape.spin``."""
    square = np.sum(edges * edges, axis=2, keepdims=True)
    along = np.sum(frame * edges, axis=2, keepdims=True)
    return np.asarray(np.cross(edges, frame) / (square + np.sqrt(square) * along))


def rest_rotation_of(data: Mapping[str, Array]) -> Array:
    """cos ᾱ and sin ᾱ (E, 3, 2) of elements; empty if all sheets are flat at rest."""
    return data["rest_rotation"] if data["rest_rotation"][..., 1].any() else NO_REST_ROTATION


def mean_directors(
    x: Array, triangles: AnyInts, number: AnyInts, n_edges: int, rotation: Array, limit: float = np.inf
) -> Array:
    """Unit mean (n_edges, 3) of the triangles' rest directors on each edge.

    A rest director is the triangle's unit normal rotated about the edge by ᾱ; ``rotation`` (F, 3, 2) holds
    cos ᾱ and sin ᾱ, or is empty. Triangles (F, 3) have the edges ``number`` (F, 3). Where rest directors
    cancel, as in a fold of 180° or a cross, and on edges of more than ``limit`` triangles, the rest director
    of the first triangle is taken.
    """
    normals = np.repeat(normals_of(x, triangles)[:, None, :], 3, axis=1)
    if len(rotation):
        along = unit(x[triangles[:, [2, 0, 1]]] - x[triangles[:, [1, 2, 0]]])
        normals = rotation[..., :1] * normals + rotation[..., 1:] * np.cross(along, normals)
    normals, edges = normals.reshape(-1, 3), number.ravel()
    total: Array = np.stack([np.bincount(edges, normals[:, i], n_edges) for i in range(3)], axis=1)
    present, first, count = np.unique(edges, return_index=True, return_counts=True)
    undefined = (np.linalg.norm(total[present], axis=1) < SMALLEST_SUM) | (count > limit)
    total[present[undefined]] = normals[first[undefined]]
    return unit(total)


def edge_numbers(rest: RestShape, triangles: Ints) -> tuple[Ints, NDArray[np.int8]]:
    """Numbers (F, 3) of the edges opposite the corners of triangles (F, 3), and their signs (F, 3).

    A sign is 1 where the triangle runs along the edge from the smaller vertex number, else −1.
    """
    tail, head = triangles[:, [1, 2, 0]], triangles[:, [2, 0, 1]]
    n = rest.mesh.n_vertices
    keys = rest.edges[:, 0] * n + rest.edges[:, 1]
    number = np.searchsorted(keys, np.minimum(tail, head) * n + np.maximum(tail, head))
    return number, np.where(tail < head, 1, -1).astype(np.int8)


def elements(rest: RestShape) -> Elements:
    """All triangles whose material bends by this model, with their constants (rank 0).

    Raises
    ------
    InputError
        If the start shape is folded by 180° at an edge and the rest shape is not, or the rest curvature is
        too large for the mesh.
    """
    chosen = np.flatnonzero(rest.bends_with("midedge"))
    mesh, triangles = rest.mesh, rest.mesh.triangles[chosen]
    number, sign = edge_numbers(rest, triangles)
    edges, n_edges = rest.edges, len(rest.edges)
    material = np.linalg.inv(rest.inverse[chosen]).transpose(0, 2, 1)  # x1 − x0, x2 − x0
    size, area = _edge_normals(material)[1], rest.area[chosen]
    curvature = curvatures_of_tangents(material)
    stiffness = np.array([shell.plate_matrix for shell in rest.shells])[rest.shell_of[chosen]]
    elastic = area * rest.per_triangle("elastic_share")[chosen]
    form = elastic[:, None, None] * np.einsum("eki,ekl,elj->eij", curvature, stiffness, curvature)
    rest.notes += midedge_mesh.narrow_sheet_notes(rest, chosen, number, size, area)
    rest.notes += midedge_mesh.corner_notes(rest, chosen, number, size, area)
    # the edge of a seam may have different lengths in its two triangles
    count = np.bincount(number.ravel(), minlength=n_edges)
    length = np.bincount(number.ravel(), size.ravel(), n_edges) / np.maximum(count, 1)

    surface = ~mesh.flat_rest[chosen]
    angle = np.zeros_like(size)  # ᾱ
    if surface.any():
        # where three or more triangles meet the first one keeps its normal as director
        on_surface = triangles[surface], number[surface]
        director = mean_directors(mesh.rest, *on_surface, n_edges, NO_REST_ROTATION, limit=2)
        _align_with_symmetry(director, rest, triangles, number, mesh.rest)
        angle[surface] = _angles_at(mesh.rest, triangles[surface], director[number[surface]])
        rest.notes += midedge_mesh.coarse_surface_notes(rest, chosen, number, size, curvature, angle)
    if rest.scene.seams:
        sewn = _of_edges(rest, ~np.isnan(rest.seam_angles), 0.5 * rest.seam_angles, np.nan)[number]
        angle = np.where(np.isnan(sewn), angle, sewn)
    rest_rotation = np.stack([np.cos(angle), np.sin(angle)], axis=2)
    rest_tangent = np.zeros_like(size)
    curved = np.array([shell.rest_curvature or (0.0, 0.0, 0.0) for shell in rest.shells]) * [1.0, 1.0, 2.0]
    if curved.any():
        rest_tangent[:] = np.linalg.solve(curvature, curved[rest.shell_of[chosen]][:, :, None])[:, :, 0]
        _check_rest_curvature(rest_tangent, rest, chosen, size)
    director = mean_directors(mesh.positions, triangles, number, n_edges, rest_rotation)
    if rest.scene.creases or rest.scene.seams:
        _release_creases(form, director, rest, chosen, number, rest_rotation)
    _align_with_symmetry(director, rest, triangles, number, mesh.positions)
    director = director[number]
    _check_folds(_angles_at(mesh.positions, triangles, director) - angle, number, edges, rest)
    ends: Array = mesh.positions[edges[number]]
    data = {
        "stiffness": np.stack([form[:, i, j] for i in range(3) for j in range(i, 3)], axis=1),
        "rest": rest_tangent,
        "rest_rotation": rest_rotation,
        "sign": sign,
        "length": length[number],
        "direction": unit(ends[:, :, 1] - ends[:, :, 0]),
        "director": director,
        "material": material,
        "triangle": chosen.astype(np.int32),
        "height": 2.0 * area / size.max(axis=1),
        "limit": fading_limit(area),
        "damping": rest.per_triangle("damping")[chosen],
    }
    return Elements(triangles, data, edges=number)


def _release_creases(
    form: Array, director: Array, rest: RestShape, chosen: Ints, number: Ints, rotation: Array
) -> None:
    """Let triangles ``chosen`` (F,) with edges ``number`` (F, 3) end at creases as at free edges, in place.

    Each of the two triangles at a crease would have a director of its own there, which its forms (F, 3, 3)
    no longer contain (`condense_creases`). The one director (n_edges, 3) that there is turns with the first
    triangle, whose form keeps its square alone, and is without energy in equilibrium.
    """
    first = _first_triangles_at_creases(rest)
    sides = first[number] == chosen[:, None]
    face, side = np.nonzero(sides)
    square = form[face, side, side].copy()
    condense_creases(form, rest, number)
    form[face, side, side] = square
    x, triangles = rest.mesh.positions, rest.mesh.triangles[chosen]
    own = np.where(sides, number, len(rest.edges))
    alone = mean_directors(x, triangles, own, len(rest.edges) + 1, rotation)
    director[number[sides]] = alone[number[sides]]


def _first_triangles_at_creases(rest: RestShape) -> Ints:
    """The first triangle at each edge of the mesh, (n_edges,); −1 for edges that are no creases."""
    return _of_edges(rest, rest.own_bending, rest.hinges.triangles[:, 0], -1)


def _of_edges(rest: RestShape, chosen: Mask, values: NDArray[Any], missing: float) -> NDArray[Any]:
    """The values (H,) of the chosen hinges (H,) on all edges of the mesh, (n_edges,)."""
    keys = rest.edges[:, 0] * rest.mesh.n_vertices + rest.edges[:, 1]
    low, high = np.sort(rest.hinges.vertices[chosen, :2], axis=1).T
    out = np.full(len(rest.edges), missing, dtype=values.dtype)
    out[np.searchsorted(keys, low * rest.mesh.n_vertices + high)] = values[chosen]
    return out


def condense_creases(form: Array, rest: RestShape, number: Ints) -> None:
    """Replace the forms (F, 3, 3) of triangles with edges ``number`` (F, 3) by their least values over the
    directors at creases, in place.
    """
    creased = _first_triangles_at_creases(rest)[number] >= 0
    for triangle in np.flatnonzero(creased.any(axis=1)):
        gone, kept = np.flatnonzero(creased[triangle]), np.flatnonzero(~creased[triangle])
        whole = form[triangle].copy()
        form[triangle] = 0.0
        to_gone = np.linalg.solve(whole[np.ix_(gone, gone)], whole[np.ix_(gone, kept)])
        form[triangle][np.ix_(kept, kept)] = whole[np.ix_(kept, kept)] - whole[np.ix_(kept, gone)] @ to_gone


def _align_with_symmetry(director: Array, rest: RestShape, triangles: Ints, number: Ints, x: Array) -> None:
    """Rotate directors (n_edges, 3) of edges in symmetry planes of handles into these planes, in place.

    A symmetry plane is given in the start shape. At other positions x (the rest shape) it is taken to have
    the same orientation relative to each triangle.
    """
    mesh = rest.mesh
    for index, handle in enumerate(rest.scene.handles):
        if handle.symmetry is None:
            continue
        held = select_vertices(mesh, handle, key=f"handles[{index}]", file=rest.scene.source)
        ends = triangles[:, [[1, 2], [2, 0], [0, 1]]]
        face, side = np.nonzero(np.isin(ends, held).all(axis=2))
        edges, corners = number[face, side], ends[face, side]

        def axes(at: Array, face: Ints = face, corners: Ints = corners) -> Array:
            """Edge, direction in the triangle normal to it, and normal, (n, 3, 3)."""
            normal, along = normals_of(at, triangles[face]), unit(at[corners[:, 1]] - at[corners[:, 0]])
            return np.stack([along, np.cross(normal, along), normal], axis=1)

        start, here = axes(mesh.positions), axes(x)
        plane = np.einsum("eik,ei->ek", here, start[:, :, AXES.index(handle.symmetry)])
        inside = unit(np.cross(plane, here[:, 0]))
        towards = np.sum(inside * director[edges], axis=1, keepdims=True)
        director[edges] = np.where(towards < 0.0, -inside, inside)


def _angles_at(x: Array, triangles: Ints, director: Array) -> Array:
    """Angles α (n, 3) [rad] of directors (n, 3, 3) of the edges of triangles (n, 3) at positions x."""
    return _director_angles(x[triangles], director)[0]


def _check_folds(angle: Array, number: Ints, edges: Ints, rest: RestShape) -> None:
    """Refuse a start shape that is folded by nearly 180° relative to the rest shape at an edge."""
    fold = np.abs(np.remainder(angle.ravel() + np.pi, 2.0 * np.pi) - np.pi)
    folded = np.flatnonzero(~(fold < LARGEST_FOLD))
    if len(folded):
        a, b = edges[number.ravel()[folded[0]]]
        raise InputError(
            f"the start shape is folded by 179.9° or more at the edge of vertices {a} and {b}, the rest "
            "shape is not, and bending_model: midedge cannot tell to which side; open the fold (or, where "
            "sheets meet, turn one over), or take bending_model: hinge",
            file=rest.scene.source,
            key="mesh",
        )


def _check_rest_curvature(rest_tangent: Array, rest: RestShape, chosen: Ints, size: Array) -> None:
    """Refuse triangles ``chosen`` with edges ``size`` (n, 3) [m] if their tangents T̄ ``rest_tangent`` (n, 3)
    belong to angles beyond 180°.
    """
    largest, limit = np.abs(rest_tangent).max(axis=1), float(tangents_at(np.array(np.pi)))
    worst = int(largest.argmax())
    if largest[worst] > limit:
        raise InputError(
            f"turns triangle {chosen[worst]} by more than 180° against its edges, of up to "
            f"{size[worst].max():.3g} m, which no edge can; take a mesh finer by "
            f"{largest[worst] / limit:.2g}, or less curvature",
            file=rest.scene.source,
            key=f"material[{rest.shell_of[chosen[worst]]}].rest_curvature",
        )


def coarse_elements(rest: RestShape) -> Elements:
    """Hinges between the same triangles, for coarse levels of multigrid."""
    from lyra_petsc.terms.bending import hinge  # imported only where it is needed

    return hinge.elements(rest, "midedge")


def make(elements: Elements, scene: Scene, mass: Array) -> MidEdge:
    """The term on one rank."""
    return MidEdge(elements)
