"""Dry friction in bending with directors on edges, which gives a fabric's hysteresis and lasting folds.

As in ``coulomb``, for the curvature κ of a triangle (``midedge``) less the curvature κ_p to which it has
slid, in a norm that weights directions by their limits M1 and M2 [N m/m] ::

    |u|² = (M1² u11² + M2² u22² + 2 M1 M2 u12²) / (M1 M2),   u = κ − κ_p
    energy = ½ A √(M1 M2) |u|² / κ_y  for |u| ≤ κ_y,   A √(M1 M2) (|u| − κ_y/2)  beyond

κ is a linear function of the directors' tangents T, so that with constants K the energy is a function of the
quadratic form Q of ``midedge_energy``: E = ½ Q up to r = √Q = r_y and r_y (r − r_y/2) beyond. Its gradient
there is that of the form with K r_y/r in place of K, and its Hessian is less by p pᵀ / (r r_y) with the
gradient p.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from copy import copy
from typing import NamedTuple, Self

import numpy as np

from lyra_petsc.arrays import Array, unwritable
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.bending import hinge, midedge_elements, midedge_energy
from lyra_petsc.terms.bending.hinge import edge_in_material
from lyra_petsc.terms.bending.midedge import NO_FRICTION, MidEdge
from lyra_petsc.terms.bending.midedge_geometry import areas, curvatures_of_tangents
from lyra_petsc.terms.bending.midedge_shape import Frames
from lyra_petsc.terms.protocols import AT_LIMIT, Located, Place, SharesFrozen, TermState, Yields
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Assembly, Term, UpcomingStep

YIELD_CURVATURE = 2.0
"""κ_y [1/m]: change of curvature at which friction reaches its limit."""


class Sliding(NamedTuple):
    """Sliding of the triangles at given positions.

    Attributes
    ----------
    part : (E,)
        r_y/r for sliding triangles, otherwise 1.
    friction : (E, 2)
        As `midedge_energy` expects it.
    tangent : (E, 4)
        As from `midedge_shape.tangents`.
    """

    part: Array
    friction: Array
    tangent: Array


class MidEdgeFriction(Yields, SharesFrozen):
    """Friction of all triangles; `connect` must be called next.

    Parameters
    ----------
    elements : Elements
        As of `MidEdge`, with K for ``stiffness`` and data ``r_y`` (E,) [√J].

    Attributes
    ----------
    bent : (E, 3)
        Directors' tangents to which the triangles have slid.
    """

    def __init__(self, elements: Elements) -> None:
        super().__init__(elements)
        self.bent: Array = elements.data["rest"].copy()
        self._r_y = elements.data["r_y"]

    def connect(self, terms: Iterable[Term]) -> None:
        self.partner = sheet = next(term for term in terms if isinstance(term, MidEdge))
        assert self.edges is not None
        self._edges = np.searchsorted(sheet.of_edges.indices, self.edges).astype(np.int32)
        theirs = sheet.elements.data["triangle"]
        order = np.argsort(theirs)
        self._rows = order[np.searchsorted(theirs, self.elements.data["triangle"], sorter=order)]

    @property
    def _sheet(self) -> MidEdge:
        assert isinstance(self.partner, MidEdge)
        return self.partner

    def freeze(self, step: UpcomingStep) -> Frames:
        return self._sheet.freeze(step)

    # -- energy ------------------------------------------------------------------------------------

    def _sliding(self, x: Array, frozen: Frames | Located) -> Sliding:
        half, data = np.empty(self.n_elements), self.elements.data
        tangent = self._sheet.at(x, frozen).geometry[self._rows]
        constants = data["stiffness"], self.bent, np.zeros(self.n_elements), NO_FRICTION
        midedge_energy.energies(tangent, *constants, half)
        r_y, r = self._r_y, np.sqrt(2.0 * np.maximum(half, 0.0))
        larger = np.maximum(r, r_y)
        offset = np.where(r > r_y, 0.5 * r_y * (larger - r_y), 0.0)
        curvature = np.where(r > r_y, -1.0 / (r_y * larger), 0.0)
        sliding = Sliding(r_y / larger, np.column_stack([curvature, offset]), tangent)
        unwritable(*sliding)
        return sliding

    def _constants(self, sliding: Sliding) -> tuple[Array, ...]:
        """Directors' tangents, K, tangents of rest, limits and friction: arguments of kernels."""
        data = self.elements.data
        stiffness = data["stiffness"] * sliding.part[:, None]
        return sliding.tangent, stiffness, self.bent, data["limit"], sliding.friction

    def energies(self, x: Array, frozen: Frames | Located) -> Array:
        return self.all_energies(x, frozen, self.n_owned)

    def all_energies(self, x: Array, frozen: Frames | Located, n: int) -> Array:
        """Energy [J] of the first n triangles of this rank, (n,)."""
        out = np.empty(n)
        midedge_energy.energies(*self._constants(self._sliding(x, frozen)), out)
        return out

    def add_gradient(self, x: Array, frozen: Frames | Located, out: Array) -> None:
        at = self._sheet.at(x, frozen)
        numbers = self.stencil, self._edges, self.edges, self.elements.data["sign"]
        constants = *self._constants(self._sliding(x, at)), self._sheet.of_edges.length
        midedge_energy.add_gradient(x, *numbers, at.frozen.direction, *constants, out)

    def add_hessian(self, x: Array, frozen: Frames | Located, into: Assembly) -> None:
        located = self._sheet.at(x, frozen)
        constants = *self._constants(self._sliding(x, located)), self._sheet.of_edges.length
        numbers = self._edges, self.elements.data["sign"], located.frozen.direction
        at = into.offsets[f"{self.name} vertices"], into.offsets[self.name], into.values
        law = into.convexity, *numbers, *constants
        midedge_energy.add_hessian(x, self.stencil, *law, into.weight, *at)

    def at_limits(self, *, yields: bool) -> Self:
        other = copy(self)
        other._r_y = self._r_y * (1.0 - AT_LIMIT if yields else 1.0 + AT_LIMIT)
        return other

    def force_scale(self, size: float) -> Array:
        data = self.elements.data
        return data["stiffness"][:, [0, 3, 5]].sum(axis=1) * size / data["height"] ** 2

    # -- state -------------------------------------------------------------------------------------

    def initialise(self, x: Array) -> None:
        self.accept(x, self._sheet.frames)

    def _bent_at(self, x: Array, frozen: Frames | Located) -> Array:
        """The value of ``bent`` after a step that ends at x."""
        sliding = self._sliding(x, frozen)
        tangent, part = sliding.tangent[:, :3], sliding.part[:, None]
        slid = tangent - part * (tangent - self.bent)
        return np.where((part < 1.0) & np.isfinite(tangent), slid, self.bent)

    def accept(self, x: Array, frozen: Frames | Located) -> None:
        self.bent = self._bent_at(x, frozen)

    def heat(self, x: Array, frozen: Frames | Located) -> float:
        at, bent = self._sheet.at(x, frozen), self.bent
        if not (self._sliding(x, at).part < 1.0).any():
            return 0.0
        before = float(self.energies(x, at).sum())
        self.accept(x, at)
        after = float(self.energies(x, at).sum())
        self.bent = bent
        return before - after

    def state(self) -> dict[str, TermState]:
        return {"bent": TermState(Place.ELEMENT, self.bent)}

    def restore(self, values: Mapping[str, Array], x: Array) -> None:
        self.bent = values["bent"].copy()


def sliding_elements(rest: RestShape, stiffness: Array, limit: Array, *also: str) -> Elements:
    """The triangles that bend by this model and slide (rank 0), of shells with these constants.

    Parameters
    ----------
    rest : RestShape
    stiffness : (n, 3, 3)
        Stiffness [N·m] on (κ11, κ22, 2 κ12) before sliding; 0 for shells that do not slide.
    limit : (n,)
        κᵀ ``stiffness`` κ [N/m] at which sliding begins.
    *also : str
        Names of constants of `MidEdge` that the elements keep, too.
    """
    notes = list(rest.notes)
    triangles = midedge_elements.elements(rest)
    rest.notes = notes  # those of the sheet only
    data = dict(triangles.data)
    shell = rest.shell_of[data["triangle"].astype(np.int64)]
    curvature, area = curvatures_of_tangents(data["material"]), areas(data["material"])
    form = area[:, None, None] * np.einsum("eki,ekl,elj->eij", curvature, stiffness[shell], curvature)
    rows = stiffness[shell, 0, 0] > 0.0
    assert triangles.edges is not None
    if rest.scene.creases or rest.scene.seams:
        part = form[rows]
        midedge_elements.condense_creases(part, rest, triangles.edges[rows])
        form[rows] = part
    data["stiffness"] = np.stack([form[:, i, j] for i in range(3) for j in range(i, 3)], axis=1)
    data["r_y"] = np.sqrt(area * limit[shell])
    for name in {"direction", "director", "material", "length", "rest_rotation", "damping"}.difference(also):
        del data[name]
    chosen = {name: values[rows] for name, values in data.items()}
    return Elements(triangles.stencil[rows], chosen, edges=triangles.edges[rows])


def elements(rest: RestShape) -> Elements:
    """The triangles that bend by this model and have friction (rank 0)."""
    m1, m2 = np.array([shell.friction_moment for shell in rest.shells]).T
    mean, zero = np.sqrt(m1 * m2), np.zeros_like(m1)
    form = np.array([[m1 * m1, zero, zero], [zero, m2 * m2, zero], [zero, zero, 0.5 * m1 * m2]])
    stiffness = (form / np.where(mean > 0.0, mean * YIELD_CURVATURE, 1.0)).transpose(2, 0, 1)
    return sliding_elements(rest, stiffness, mean * YIELD_CURVATURE)


def coarse_elements(rest: RestShape) -> Elements:
    """Hinges between the same triangles, which bend like them while nothing slides."""
    quad, faces = rest.hinges.vertices, rest.hinges.triangles
    moments = np.array([shell.friction_moment for shell in rest.shells])
    limit, bends = np.full(len(quad), np.inf), ~rest.own_bending
    for side in range(2):
        edge, stiffness = edge_in_material(rest, faces[:, side], quad[:, 0], quad[:, 1], "midedge")
        across = edge[:, ::-1] ** 2 / np.sum(edge * edge, axis=1, keepdims=True)
        limit = np.minimum(limit, np.sum(across * moments[rest.shell_of[faces[:, side]]], axis=1))
        bends &= stiffness > 0.0
    hinges, limit = hinge.elements(rest, "midedge"), limit[bends]
    rows, data = limit > 0.0, dict(hinges.data)
    data["k"] = limit * data["length"] / (YIELD_CURVATURE * data["rest_height"])
    return Elements(hinges.stencil[rows], {name: values[rows] for name, values in data.items()})


def make(elements: Elements, scene: Scene, mass: Array) -> MidEdgeFriction:
    """The term on one rank."""
    return MidEdgeFriction(elements)
