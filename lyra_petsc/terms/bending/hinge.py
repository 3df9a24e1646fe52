"""Bending: one hinge per interior edge.

Per hinge with rest edge length l, rest areas A0 and A1, rest angle θ̄::

    energy = k (θ − θ̄)²,   k = B l² / (2 (A0 + A1))

Source: Grinspun et al., Discrete Shells, SCA 2003, with the stiffness calibrated so that B [N·m] is
the cylindrical bending stiffness on meshes whose lines run along the bend (k ‖ē‖/h̄ with k = B/6).
The energy of a hinge fades out if a triangle's area is below a tenth of its rest area, see ``hinge_energy``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.bending import hinge_fading, hinge_forces, hinge_shape
from lyra_petsc.terms.bending.hinge_energy import fading_limit
from lyra_petsc.terms.bending.hinge_rows import add_across, add_within
from lyra_petsc.terms.bending.hinge_triangles import triangles_of
from lyra_petsc.terms.protocols import HasGeometry, Located
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Assembly, Couplings, OffDiagonal

Stencil = NDArray[np.int32] | NDArray[np.int64]

NONE = np.empty(0, dtype=np.int64)
"""No hinges."""


class HingeGeometry(NamedTuple):
    """Geometry of triangles and hinges at given positions.

    Attributes
    ----------
    triangles : (T, 7)
        Output of ``hinge_shape.triangles``.
    angles : (E,)
        Dihedral angles [rad] in [−π, π], 0 where a triangle has no normal.
    lengths : (E,)
        Edge lengths [m].
    fading : (F,) int64
        Numbers of the hinges that fade.
    """

    triangles: Array
    angles: Array
    lengths: Array
    fading: NDArray[np.int64]


def dihedral_angles(x: Array, stencil: Stencil) -> Array:
    """Dihedral angles θ [rad] in [−π, π] of hinges (E, 4), (E,); 0 where a triangle has no normal."""
    sine, cosine = np.empty(len(stencil)), np.empty(len(stencil))
    hinge_shape.angle_parts_of_points(x, stencil, sine, cosine)
    # NumPy's functions of whole arrays use SIMD instructions
    return np.arctan2(sine, cosine, out=sine)


class Bending(HasGeometry):
    """The bending energy of all hinges.

    Parameters
    ----------
    elements : Elements
        Stencil (E, 4) as in ``dihedral_angle``; data ``k`` (E,) [N·m], ``rest_angle`` (E,) [rad],
        ``rest_height`` (E,) sum of the two heights on the edge [m], ``length`` (E,) of the rest edge [m],
        ``limit`` (E, 2) of |n|² of both triangles [m⁴], ``damping`` (E,) [s], ``opposite_corners`` (E, 2) of
        the opposite vertices in their triangles (0, 1, 2).
    """

    def __init__(self, elements: Elements) -> None:
        data = elements.data
        super().__init__(elements.without("limit", "opposite_corners"))
        self._k, self._rest = data["k"], data["rest_angle"]
        self._triangles = triangles_of(self.stencil, data["opposite_corners"].astype(np.int64))
        # all hinges of a triangle have the same limit for it
        self._limit = np.empty(len(self._triangles.corners))
        self._limit[self._triangles.sides[:-1] >> 2] = data["limit"]

    def compute_geometry(self, x: Array, frozen: None) -> HingeGeometry:
        corners, sides, _ = self._triangles
        triangles = np.empty((len(corners), 7))
        sine, cosine, length = (np.empty(self.n_elements) for _ in range(3))
        any_fades = hinge_shape.triangles(x, corners, self._limit, triangles)
        hinge_shape.angle_parts(x, self.stencil, sides, triangles, sine, cosine, length)
        # NumPy's functions of whole arrays use SIMD instructions
        angles, fading = np.arctan2(sine, cosine, out=sine), NONE
        if any_fades:
            fading = np.flatnonzero((triangles[sides[:-1] >> 2, 6] == 0.0).any(axis=1))
            angles[fading] = dihedral_angles(x, self.stencil[fading])
        return HingeGeometry(triangles, angles, length, fading)

    def _geometry(self, x: Array, frozen: Located | None) -> HingeGeometry:
        geometry: HingeGeometry = self.at(x, frozen).geometry
        return geometry

    def angles(self, x: Array, frozen: Located | None = None) -> Array:
        """Dihedral angles of all hinges of this rank [rad], (E,), a read-only array."""
        return self._geometry(x, frozen).angles

    def weights(self, x: Array) -> Array:
        """Factor of each hinge's energy by which it fades, (E,); 1 unless a triangle has nearly collapsed."""
        out = np.empty(self.n_elements)
        hinge_fading.weights(x, self.stencil, self._triangles.sides, self._limit, out)
        return out

    def energies(self, x: Array, frozen: Located | None = None) -> Array:
        return self.all_energies(x, frozen, self.n_owned)

    def law(self, angles: Array, convexity: float | None = None) -> tuple[Array, Array]:
        """k (E,) [N·m] and θ̄ (E,) [rad] of hinges at ``angles`` (E,): energies and moments there are those of
        k (θ − θ̄)²; with ``convexity`` moments and their derivatives are, mixed as Hessians are.
        """
        return self._k, self._rest

    def all_energies(self, x: Array, frozen: Located | None, n: int) -> Array:
        """Energy [J] of the first n hinges of this rank, (n,)."""
        geometry = self._geometry(x, frozen)
        law = self.law(geometry.angles)
        out = law[0][:n] * (geometry.angles[:n] - law[1][:n]) ** 2
        if len(geometry.fading):
            hinge_fading.energies(x, *self._fading(geometry, law), out)
        return out

    def _fading(self, geometry: HingeGeometry, law: tuple[Array, Array]) -> tuple[Array | Stencil, ...]:
        """Arguments of the functions of ``hinge_fading`` about the hinges and their law."""
        hinges = self.stencil, self._triangles.sides, geometry.fading
        return *hinges, self._limit, geometry.angles, *law

    def add_gradient(self, x: Array, frozen: Located | None, out: Array) -> None:
        corners, sides, hinges = self._triangles
        geometry = self._geometry(x, frozen)
        triangles, angles, lengths, fading = geometry
        law, forces = self.law(angles), np.empty(self.n_elements + 1)
        hinge_forces.edge_forces(sides, triangles, angles, lengths, *law, forces)
        hinge_forces.add_gradient(corners, hinges, triangles, forces, out)
        if len(fading):
            hinge_fading.add_gradient(x, *self._fading(geometry, law), out)

    @property
    def couplings(self) -> Couplings:
        return {self.name: self._triangles.corners, f"{self.name} across": OffDiagonal(self.stencil[:, 2:])}

    def add_hessian(self, x: Array, frozen: Located | None, into: Assembly) -> None:
        corners, sides, hinges = self._triangles
        within, across = into.offsets[self.name], into.offsets[f"{self.name} across"]
        geometry, convexity = self._geometry(x, frozen), into.convexity
        triangles, angles, lengths, fading = geometry
        factors = np.empty((self.n_elements + 1, 2))
        law, values = self.law(angles, convexity), into.values
        weighted = convexity, *law, into.weight
        add_across(sides, triangles, angles, lengths, *weighted, across, values, factors)
        add_within(x, corners, hinges, sides, triangles, factors, within, values)
        if len(fading):
            to = into.weight, within, across, values
            hinge_fading.add_hessian(x, *self._fading(geometry, law), convexity, *to)

    def force_scale(self, size: float) -> Array:
        return self.elements.data["k"] * size / self.elements.data["rest_height"] ** 2


def _corners_of(triangles: NDArray[np.int64], vertices: NDArray[np.int64]) -> NDArray[np.int64]:
    """Corner (0, 1, 2) of each triangle (n, 3) that is the given vertex (n,)."""
    return np.argmax(triangles == vertices[:, None], axis=1)


def edge_in_material(
    rest: RestShape,
    triangle: NDArray[np.int64],
    tail: NDArray[np.int64],
    head: NDArray[np.int64],
    model: str = "hinge",
) -> tuple[Array, Array]:
    """The edge tail → head of each triangle in material axes, and the bending stiffness for its direction.

    Returns
    -------
    edge : (n, 2) float64
        Material vector of the edge [m], warp axis first.
    stiffness : (n,) float64
        B [N·m] of a hinge on that edge, 0 for materials of other bending models.
    """
    corners, uv = rest.mesh.triangles[triangle], rest.mesh.triangle_uv[triangle]
    row = np.arange(len(triangle))
    edge = uv[row, _corners_of(corners, head)] - uv[row, _corners_of(corners, tail)]
    warp = np.radians(rest.per_triangle("warp_degrees")[triangle])
    cosine, sine = np.cos(warp), np.sin(warp)
    edge = np.stack(
        [cosine * edge[:, 0] + sine * edge[:, 1], cosine * edge[:, 1] - sine * edge[:, 0]], axis=1
    )
    direction = np.degrees(np.arctan2(np.abs(edge[:, 1]), np.abs(edge[:, 0])))
    stiffness = np.zeros(len(triangle))
    for number, shell in enumerate(rest.shells):
        mine = rest.shell_of[triangle] == number
        if not shell.bends_with(model):
            continue
        if model == "hinge":
            stiffness[mine] = np.interp(direction[mine], [0.0, 45.0, 90.0], shell.bending)
        else:
            along = edge[mine] / np.linalg.norm(edge[mine], axis=1, keepdims=True)
            x, y = along[:, 1], -along[:, 0]
            bent = np.stack([x * x, y * y, 2.0 * x * y])
            stiffness[mine] = np.einsum("in,ij,jn->n", bent, np.array(shell.plate_matrix), bent)
    return edge, stiffness


def _foot_and_height(
    rest: RestShape, triangle: NDArray[np.int64], quad: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Foot, as distance from the tail, and height [m] of the opposite vertex over the edge, (n,) each."""
    tail, head, opposite = quad.T
    edge, _ = edge_in_material(rest, triangle, tail, head)
    side, _ = edge_in_material(rest, triangle, tail, opposite)
    length = np.linalg.norm(edge, axis=1)
    along = (side * edge).sum(axis=1) / length
    height = np.abs(side[:, 1] * edge[:, 0] - side[:, 0] * edge[:, 1]) / length
    return along, height


def _angles_from_curvature(rest: RestShape, quad: NDArray[np.int64], triangles: NDArray[np.int64]) -> Array:
    """Dihedral angles (E,) [rad] of the piecewise linear interpolant of z = ½ rᵀ κ r.

    κ is the rest curvature of each triangle's material. Positive curvature raises the sheet towards its
    normal, which makes the angles negative.
    """
    angle = np.zeros(len(quad))
    for side, column, sign in ((0, 2, 1.0), (1, 3, -1.0)):
        corners = quad[:, [0, 1, column]]
        ee, nn, en = _rest_curvature(rest, triangles[:, side], corners)
        edge, _ = edge_in_material(rest, triangles[:, side], corners[:, 0], corners[:, 1])
        along, height = _foot_and_height(rest, triangles[:, side], corners)
        length = np.linalg.norm(edge, axis=1)
        # the twist is relative to the middle of the edge, where the slopes of both triangles agree
        z = ee * along * (along - length) + sign * en * (2.0 * along - length) * height + nn * height**2
        angle -= 0.5 * z / height
    return angle


def _rest_curvature(
    rest: RestShape, triangle: NDArray[np.int64], edge: NDArray[np.int64]
) -> tuple[Array, Array, Array]:
    """Rest curvature κ of triangles along, across and mixed to edges (tail, head, …), (n,) [1/m] each."""
    curved = np.array([shell.rest_curvature or (0.0, 0.0, 0.0) for shell in rest.shells])
    k11, k22, k12 = curved[rest.shell_of[triangle]].T
    vector, _ = edge_in_material(rest, triangle, edge[:, 0], edge[:, 1])
    t = vector / np.linalg.norm(vector, axis=1)[:, None]
    ee = k11 * t[:, 0] ** 2 + 2 * k12 * t[:, 0] * t[:, 1] + k22 * t[:, 1] ** 2
    nn = k11 * t[:, 1] ** 2 - 2 * k12 * t[:, 0] * t[:, 1] + k22 * t[:, 0] ** 2
    en = (k22 - k11) * t[:, 0] * t[:, 1] + k12 * (t[:, 0] ** 2 - t[:, 1] ** 2)
    return ee, nn, en


def mirrored_angles(rest: RestShape, corners: NDArray[np.int64], triangle: NDArray[np.int64]) -> Array:
    """Half the rest angle [rad] of the hinge of each triangle (tail, head, opposite) and its mirror image."""
    ee, nn, _ = _rest_curvature(rest, triangle, corners)
    edge, _ = edge_in_material(rest, triangle, corners[:, 0], corners[:, 1])
    along, height = _foot_and_height(rest, triangle, corners)
    return -0.5 * (ee * along * (along - np.linalg.norm(edge, axis=1)) + nn * height**2) / height


def whole_hinges(rest: RestShape, model: str = "hinge") -> tuple[Elements, NDArray[np.int64]]:
    """All interior edges between materials of this bending model, but those of `RestShape.own_bending`, with
    the constants of elastic bending, and the triangle (E,) of which each has the material (rank 0).

    Between two materials that of smaller B is taken, as in the original Lyra. The rest length is the mean
    over the two triangles, which differ at a seam.
    """
    quad, faces = rest.hinges.vertices, rest.hinges.triangles
    edges, stiffnesses = zip(
        *(edge_in_material(rest, faces[:, side], quad[:, 0], quad[:, 1], model) for side in range(2)),
        strict=True,
    )
    length = 0.5 * (np.linalg.norm(edges[0], axis=1) + np.linalg.norm(edges[1], axis=1))
    b = np.minimum(*stiffnesses)
    areas = rest.area[faces].sum(axis=1)
    damping = rest.per_triangle("damping")[faces].mean(axis=1)
    rest_angle = np.zeros(len(quad))
    surface = ~rest.mesh.flat_rest[faces].all(axis=1)
    rest_angle[surface] = dihedral_angles(rest.mesh.rest, quad[surface])
    if any(shell.rest_curvature for shell in rest.shells):
        rest_angle += _angles_from_curvature(rest, quad, faces)
    if rest.scene.seams:
        rest_angle = np.where(np.isnan(rest.seam_angles), rest_angle, rest.seam_angles)
    bends = (b > 0.0) & ~rest.own_bending
    data = {
        "k": b * length**2 / (2.0 * areas),
        "rest_angle": rest_angle,
        "rest_height": 2.0 * areas / length,
        "length": length,
        "limit": fading_limit(rest.area[faces]),
        "opposite_corners": np.stack(
            [_corners_of(rest.mesh.triangles[faces[:, i]], quad[:, 2 + i]) for i in (0, 1)], 1
        ),
        "damping": damping,
    }
    softer = np.where(stiffnesses[0] <= stiffnesses[1], faces[:, 0], faces[:, 1])
    return Elements(quad[bends], {name: values[bends] for name, values in data.items()}), softer[bends]


def elements(rest: RestShape, model: str = "hinge") -> Elements:
    """Those of `whole_hinges` with the part of their stiffness that never yields (rank 0)."""
    hinges, triangle = whole_hinges(rest, model)
    k = hinges.data["k"] * rest.per_triangle("elastic_share")[triangle]
    return replace(hinges, data={**hinges.data, "k": k})


def make(elements: Elements, scene: Scene, mass: Array) -> Bending:
    """The term on one rank."""
    return Bending(elements)
