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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints, Mask, unwritable
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.bending import midedge_energy
from lyra_petsc.terms.bending.midedge_elements import elements as elements  # the registry reads it here
from lyra_petsc.terms.bending.midedge_geometry import (
    areas,
    curvatures_of_tangents,
    director_angles,
    mean_directors,
    rest_rotation_of,
    spins_of,
)
from lyra_petsc.terms.bending.midedge_mesh import CREASED
from lyra_petsc.terms.bending.midedge_shape import (
    Frames,
    directions,
    directors,
    largest_angle,
    mark_turned_edges,
    some_perpendicular,
    tangents,
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

(NO_FRICTION,) = unwritable(np.empty((0, 2)))
NO_REST_TANGENTS = np.empty((0, 3))
"""Stands for rest tangents T̄ that are all 0."""


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
        angle, normal, square, e = director_angles(corners, before)
        angle_after, _, square_after, _ = director_angles(y[self.stencil[chosen]], after)
        height = np.sum(moved * normal[:, None, :], axis=2)
        size = np.sqrt(square)[:, None] * np.linalg.norm(e, axis=2)
        with np.errstate(divide="ignore", invalid="ignore"):
            # change of α to first order, from ∂α/∂x of ``midedge_energy``, and the real one
            linear = -np.einsum("eij,ekj,ek->ei", e, e, height) / size
            spins = spins_of(sign[:, :, None] * frozen.direction[number], e)
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


def coarse_elements(rest: RestShape) -> Elements:
    """Hinges between the same triangles, for coarse levels of multigrid."""
    from lyra_petsc.terms.bending import hinge  # imported only where it is needed

    return hinge.elements(rest, "midedge")


def make(elements: Elements, scene: Scene, mass: Array) -> MidEdge:
    """The term on one rank."""
    return MidEdge(elements)
