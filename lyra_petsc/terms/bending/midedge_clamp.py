"""Directors whose angles are prescribed by handles.

With ``clamp`` a director stays normal to a plane that moves with the handle: the mean plane of the triangles
on its edge when the handle starts to act. Where only springs hold the ends of an edge the director keeps its
angle in the frame that follows the edge. With ``symmetry`` the director starts in the symmetry plane
(``midedge.elements``). Parallel transport between edges in this plane keeps vectors of the plane in it, so
that the director stays in the plane with a constant angle.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.select import select_vertices
from lyra_petsc.terms.bending.midedge import MidEdge
from lyra_petsc.terms.bending.midedge_elements import edge_numbers
from lyra_petsc.terms.bending.midedge_geometry import normals_of
from lyra_petsc.terms.bending.midedge_shape import Frames, transported, unit
from lyra_petsc.terms.handles.motion import Motion, Window
from lyra_petsc.terms.rest import RestShape


class _Plane(NamedTuple):
    """The clamped edges (n, 3), vectors (n, 3) across them in the sheet's plane, and the rates of both."""

    edge: Array
    inward: Array
    edge_rate: Array
    inward_rate: Array


@dataclass
class _Handle:
    """The owned edges that one handle clamps.

    Attributes
    ----------
    indices : (n,)
        Indices of their unknowns in flattened arrays over owned rows.
    edges : (n,)
        Their numbers in the term's ``of_edges``.
    stencil : (n, 8)
        Local rows of the ends, the corners of one triangle, and those of the other (or of the same again).
    motion : Motion
    window : Window
    symmetric : bool
        Whether they lie in a symmetry plane, where their unknowns are constant.
    """

    indices: Ints
    edges: Ints
    stencil: Ints
    motion: Motion
    window: Window
    symmetric: bool


class ClampedEdges:
    """The clamps of a scene on one rank.

    Parameters
    ----------
    term : MidEdge
    elements : mapping of handle number → Elements
        Output of ``elements`` after distribution.
    handles : mapping of handle number → (Motion, Window, bool)
        The last tells whether the handle is a symmetry plane.
    owned : (n,) int64
        Indices of the unknowns of all edges that this rank owns.

    Attributes
    ----------
    term : MidEdge
    """

    def __init__(
        self,
        term: MidEdge,
        elements: Mapping[int, Elements],
        handles: Mapping[int, tuple[Motion, Window, bool]],
        owned: Ints,
    ) -> None:
        self.term = term
        self._handles: dict[int, _Handle] = {}
        for number, clamped in elements.items():
            assert clamped.edges is not None
            mine = np.isin(clamped.edges[:, 0], owned)
            indices = np.asarray(clamped.edges[mine, 0], dtype=np.int64)
            edges = np.searchsorted(term.of_edges.indices, indices)
            stencil = clamped.stencil[mine].astype(np.int64)
            self._handles[number] = _Handle(indices, edges, stencil, *handles[number])

    @property
    def windows(self) -> dict[int, Window]:
        """The time window in which each handle clamps, by its number."""
        return {number: clamped.window for number, clamped in self._handles.items()}

    @property
    def reference_rows(self) -> Ints:
        """Local rows (n,) whose reference positions at the start of handles are needed."""
        none = np.empty(0, dtype=np.int64)
        return np.concatenate([none, *(clamped.stencil.ravel() for clamped in self._handles.values())])

    def indices(self, number: int) -> Ints:
        """Indices (n,) of the edge unknowns that a handle prescribes, in flattened arrays over owned rows."""
        handle = self._handles.get(number)
        return np.empty(0, dtype=np.int64) if handle is None else handle.indices

    def targets(self, number: int, at: float, reference: Callable[[float, Ints], Array], out: Array) -> None:
        """Write the unknowns that a handle prescribes at time ``at`` [s] into ``out`` (n,).

        Of the angles that differ by full turns the one nearest to the present unknown in ``out`` is taken.
        """
        handle = self._handles.get(number)
        if handle is None or handle.symmetric:
            return
        plane = self._plane(handle, at, reference)
        edges, (t0, a0) = self.term.of_edges, self.term.frames.vectors
        tangent = unit(plane.edge)
        director = unit(np.cross(plane.edge, plane.inward))
        base = transported(Frames(t0[handle.edges], a0[handle.edges]), tangent)
        sine = np.sum(np.cross(tangent, base) * director, axis=1)
        angle = np.arctan2(sine, np.sum(base * director, axis=1))
        length = edges.length[handle.edges]
        now = out[handle.indices] / length
        out[handle.indices] = length * (angle + 2.0 * np.pi * np.round((now - angle) / (2.0 * np.pi)))

    def rates(self, number: int, at: float, reference: Callable[[float, Ints], Array], out: Array) -> None:
        """Write the rates of a handle's unknowns at time ``at`` [s] into ``out`` (n,)."""
        handle = self._handles.get(number)
        if handle is None or handle.symmetric:
            return
        e, w, de, dw = self._plane(handle, at, reference)
        size = np.linalg.norm(e, axis=1)
        tangent, normal = unit(e), np.cross(e, w)
        height = np.linalg.norm(normal, axis=1)
        director = normal / height[:, None]
        normal_rate = np.cross(de, w) + np.cross(e, dw)
        spin = np.sum(normal_rate * np.cross(tangent, director), axis=1) / height
        t0 = self.term.frames.direction[handle.edges]
        cosine = 1.0 + np.sum(t0 * tangent, axis=1)
        frame_spin = -np.sum(np.cross(t0, tangent) * de, axis=1) / (cosine * size)
        out[handle.indices] = self.term.of_edges.length[handle.edges] * (spin - frame_spin)

    def moment(self, number: int, reaction: Array, x: Array, frames: Frames) -> Array:
        """Moment (3,) [N·m] of a handle on this rank's edges, without that of the forces at their ends.

        ``reaction`` (n,) [N] is the force on their unknowns at positions x (n_local, 3) [m].
        """
        handle = self._handles.get(number)
        if handle is None:
            return np.zeros(3)
        return self.term.moment(reaction, handle.edges, x, frames)

    def _plane(self, handle: _Handle, at: float, reference: Callable[[float, Ints], Array]) -> _Plane:
        rows, start = handle.stencil, handle.window.start
        points = reference(start, rows.ravel()).reshape(*rows.shape, 3)
        local = np.arange(8 * len(points)).reshape(-1, 8)
        flat = points.reshape(-1, 3)
        normal = unit(normals_of(flat, local[:, 2:5]) + normals_of(flat, local[:, 5:8]))
        tail, head = points[:, 0], points[:, 1]
        inward = tail + np.cross(normal, head - tail)  # edge × inward has the direction of the normal
        moving = np.concatenate([tail, head, inward])
        a, b, c = np.split(handle.motion.moved(moving, start, at), 3)
        da, db, dc = np.split(handle.motion.velocity(moving, start, at), 3)
        return _Plane(b - a, c - a, db - da, dc - da)


def elements(rest: RestShape) -> dict[int, Elements]:
    """The edges whose two ends a handle holds, for each handle that holds slopes, by its number (rank 0)."""
    chosen = np.flatnonzero(rest.bends_with("midedge"))
    triangles = rest.mesh.triangles[chosen]
    number, _ = edge_numbers(rest, triangles)
    sides = number.ravel()
    by_edge = np.argsort(sides, kind="stable")
    edges, first, count = np.unique(sides[by_edge], return_index=True, return_counts=True)
    one, two = (triangles[by_edge[first + k * (count - 1)] // 3] for k in (0, 1))
    ends, by_handle = rest.edges[edges], {}
    for index, handle in enumerate(rest.scene.handles):
        if handle.holds_slope:
            held = select_vertices(rest.mesh, handle, key=f"handles[{index}]", file=rest.scene.source)
            row = np.flatnonzero(np.isin(ends, held).all(axis=1))
            by_handle[index] = Elements(
                np.concatenate([ends[row], one[row], two[row]], axis=1), edges=edges[row][:, None]
            )
    return by_handle
