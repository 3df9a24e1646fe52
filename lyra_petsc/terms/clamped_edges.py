"""Directors that handles hold.

With ``clamp`` they turn as the plane does that the sheet had at the start: the mean of those of the triangles
on the edge, when the handle starts to act; it moves as the handle does. Where only springs hold the ends of
an edge the director keeps its angle in the frame that follows the edge. With ``symmetry`` the director begins
in the plane (``midedge.elements``). The smallest rotation from one edge in that plane to another keeps what
is in it there, so that the director stays in it at an angle that never changes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.select import select_vertices
from lyra_petsc.terms.midedge import MidEdge, edge_numbers, normals_of
from lyra_petsc.terms.midedge_shape import Frames, carried, unit
from lyra_petsc.terms.motion import Motion, Window
from lyra_petsc.terms.rest import RestShape


class _Plane(NamedTuple):
    """Of clamped edges (n, 3) at one time: the edge, a vector in the sheet's plane, and their rates."""

    edge: Array
    inward: Array
    edge_rate: Array
    inward_rate: Array


@dataclass
class _Handle:
    """The owned edges that one handle clamps.

    Attributes
    ----------
    places : (n,)
        In the flat form of arrays over owned rows.
    edges : (n,)
        Their numbers among the term's.
    stencil : (n, 8)
        Local rows: ends, corners of one triangle, corners of the other or the same.
    symmetric : bool
        They lie in a symmetry plane, and keep their unknowns.
    """

    places: Ints
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
        As by ``elements``, after distribution.
    handles : mapping of handle number → (Motion, Window, bool)
        The last: whether it is a symmetry plane.
    owned : (n,) int64
        Places of all edges that this rank owns.

    Attributes
    ----------
    term : MidEdge
        Whose edges they are.
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
        for number, each in elements.items():
            assert each.edges is not None
            mine = np.isin(each.edges[:, 0], owned)
            places = np.asarray(each.edges[mine, 0], dtype=np.int64)
            edges = np.searchsorted(term.of_edges.places, places)
            stencil = each.stencil[mine].astype(np.int64)
            self._handles[number] = _Handle(places, edges, stencil, *handles[number])

    @property
    def windows(self) -> dict[int, Window]:
        """When each handle clamps, by its number."""
        return {number: each.window for number, each in self._handles.items()}

    @property
    def reference_rows(self) -> Ints:
        """Local rows (n,) whose positions at the start of handles are asked for."""
        none = np.empty(0, dtype=np.int64)
        return np.concatenate([none, *(each.stencil.ravel() for each in self._handles.values())])

    def places(self, number: int) -> Ints:
        """Places of the edges that a handle clamps on this rank, in the flat form of owned rows."""
        each = self._handles.get(number)
        return np.empty(0, dtype=np.int64) if each is None else each.places

    def targets(self, number: int, at: float, reference: Callable[[float, Ints], Array], out: Array) -> None:
        """Write a handle's unknowns at time ``at`` [s] over the present ones in ``out`` (n,)."""
        each = self._handles.get(number)
        if each is None or each.symmetric:
            return
        plane = self._plane(each, at, reference)
        edges, (t0, a0) = self.term.of_edges, self.term.frames
        tangent = unit(plane.edge)
        director = unit(np.cross(plane.edge, plane.inward))
        across = carried(Frames(t0[each.edges], a0[each.edges]), tangent)
        sine = np.sum(np.cross(tangent, across) * director, axis=1)
        angle = np.arctan2(sine, np.sum(across * director, axis=1))
        length = edges.length[each.edges]
        now = out[each.places] / length
        out[each.places] = length * (angle + 2.0 * np.pi * np.round((now - angle) / (2.0 * np.pi)))

    def rates(self, number: int, at: float, reference: Callable[[float, Ints], Array], out: Array) -> None:
        """Write the rates of a handle's unknowns at time ``at`` [s] into ``out`` (n,)."""
        each = self._handles.get(number)
        if each is None or each.symmetric:
            return
        e, w, de, dw = self._plane(each, at, reference)
        size = np.linalg.norm(e, axis=1)
        tangent, normal = unit(e), np.cross(e, w)
        height = np.linalg.norm(normal, axis=1)
        director = normal / height[:, None]
        turned = np.cross(de, w) + np.cross(e, dw)
        spin = np.sum(turned * np.cross(tangent, director), axis=1) / height
        t0 = self.term.frames.tangent[each.edges]
        cosine = 1.0 + np.sum(t0 * tangent, axis=1)
        frame = -np.sum(np.cross(t0, tangent) * de, axis=1) / (cosine * size)
        out[each.places] = self.term.of_edges.length[each.edges] * (spin - frame)

    def moment(self, number: int, reaction: Array, x: Array, frames: Frames) -> Array:
        """Moment (3,) [N·m] of a handle on its edges of this rank beside that of the forces at their ends.

        ``reaction`` (n,) [N] is the force on their unknowns at positions x (n_local, 3) [m].
        """
        each = self._handles.get(number)
        if each is None:
            return np.zeros(3)
        return self.term.moment(reaction, each.edges, x, frames)

    def _plane(self, each: _Handle, at: float, reference: Callable[[float, Ints], Array]) -> _Plane:
        rows, start = each.stencil, each.window.start
        points = reference(start, rows.ravel()).reshape(*rows.shape, 3)
        local = np.arange(8 * len(points)).reshape(-1, 8)
        flat = points.reshape(-1, 3)
        normal = unit(normals_of(flat, local[:, 2:5]) + normals_of(flat, local[:, 5:8]))
        tail, head = points[:, 0], points[:, 1]
        beside = tail + np.cross(normal, head - tail)  # edge × inward has the direction of the normal
        three = np.concatenate([tail, head, beside])
        a, b, c = np.split(each.motion.carried(three, start, at), 3)
        da, db, dc = np.split(each.motion.velocity(three, start, at), 3)
        return _Plane(b - a, c - a, db - da, dc - da)


def elements(rest: RestShape) -> dict[int, Elements]:
    """Of each handle that holds slopes the edges whose ends it holds, by its number (rank 0, whole mesh)."""
    chosen = np.flatnonzero(rest.bends_with("midedge"))
    triangles = rest.mesh.triangles[chosen]
    number, _ = edge_numbers(rest, triangles)
    sides = number.ravel()
    by_edge = np.argsort(sides, kind="stable")
    edges, first, count = np.unique(sides[by_edge], return_index=True, return_counts=True)
    one, two = (triangles[by_edge[first + k * (count - 1)] // 3] for k in (0, 1))
    ends, found = rest.edges[edges], {}
    for handle, each in enumerate(rest.scene.handles):
        if each.holds_slope:
            held = select_vertices(rest.mesh, each, key=f"handles[{handle}]", file=rest.scene.source)
            row = np.flatnonzero(np.isin(ends, held).all(axis=1))
            found[handle] = Elements(
                np.concatenate([ends[row], one[row], two[row]], axis=1), edges=edges[row][:, None]
            )
    return found
