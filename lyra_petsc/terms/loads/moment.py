"""Moments on boundary edges: M per rest length about the edge, as a follower load.

The power of a moment M [N·m/m] on an edge of rest length L is M L times the rate φ̇ + γ · ė at which the
edge's director rotates about it (``midedge_shape``). The load is therefore M L on φ, and ± M L γ at the ends;
γ vanishes where the frame has the edge's present direction. M > 0 lifts the free side of the edge towards the
normal of its triangle: it acts about the clockwise direction of the edge, so that κ increases.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.select import find_group
from lyra_petsc.mesh.topology import boundary_edges
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.bending.midedge import MidEdge
from lyra_petsc.terms.bending.midedge_shape import unit
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Term, UpcomingStep, WindowedLoad


class Moment(WindowedLoad):
    """The moments of all loads: stencil (E, 2), edges (E, 1), data ``sign`` (E,).

    A moment [N·m/m] times its sign is about its edge, directed from the smaller vertex number.
    """

    is_follower = True

    def connect(self, terms: Iterable[Term]) -> None:
        assert self.edges is not None
        self._term = term = next(term for term in terms if isinstance(term, MidEdge))
        self._indices = self.edges[:, 0]
        self._numbers = np.searchsorted(term.of_edges.indices, self._indices)

    def add_force(self, step: UpcomingStep, out: Array) -> None:
        np.add.at(out.reshape(-1), self._indices, self.elements.data["sign"] * self.values(step))
        self.add_force_on_vertices(step, out)

    def add_force_on_vertices(self, step: UpcomingStep, out: Array) -> None:
        self._add_couples(step.x, self.elements.data["sign"] * self.values(step), out)

    def _add_couples(self, x: Array, moment: Array, out: Array) -> None:
        """Add the forces ± M L γ [N] to out."""
        tail, head = self.stencil.T
        edge, direction = x[head] - x[tail], self._term.frames.direction[self._numbers]
        tangent = unit(edge)
        size = np.linalg.norm(edge, axis=1) * (1.0 + np.sum(direction * tangent, axis=1))
        factor = -moment * self._term.of_edges.length[self._numbers] / size
        force = factor[:, None] * np.cross(direction, tangent)
        np.add.at(out, head, force)
        np.subtract.at(out, tail, force)


def elements(rest: RestShape) -> Elements:
    """The edges under each moment (rank 0).

    Raises
    ------
    InputError
        If a group has no boundary edges, or a material at it does not bend by ``midedge``.
    """
    mesh, scene = rest.mesh, rest.scene
    ends, faces, _ = boundary_edges(mesh.triangles)
    n = mesh.n_vertices
    low, high = ends.min(axis=1), ends.max(axis=1)
    keys, sign = low * n + high, np.where(ends[:, 0] < ends[:, 1], -1.0, 1.0)
    number = np.searchsorted(rest.edges[:, 0] * n + rest.edges[:, 1], keys)
    rows, signs, loads = [], [], []
    for index, load in enumerate(scene.loads):
        if load.moment is None:
            continue
        assert load.group is not None
        key = f"loads[{index}]"
        group = find_group(mesh, load.group, key=f"{key}.group", file=scene.source)
        if len(group.edges):
            wanted = np.unique(group.edges.min(axis=1) * n + group.edges.max(axis=1))
            row = np.flatnonzero(np.isin(keys, wanted))
            complete = len(row) == len(wanted)
        else:
            row = np.flatnonzero(np.isin(ends, group.vertices).all(axis=1))
            complete = len(row) > 0
        if not complete:
            raise InputError(
                f"a moment acts on boundary edges, which group '{load.group}' is not made of; take a curve "
                "group on the boundary",
                file=scene.source,
                key=f"{key}.group",
            )
        if not rest.bends_with("midedge")[faces[row]].all():
            raise InputError(
                f"the material at group '{load.group}' has no moments on edges; give it "
                "bending_model: midedge and a bending stiffness",
                file=scene.source,
                key=f"{key}.moment",
            )
        rows.append(row)
        signs.append(sign[row])
        loads.append(np.full(len(row), float(index)))
    row = np.concatenate(rows)
    data = {"sign": np.concatenate(signs), "load": np.concatenate(loads)}
    return Elements(np.column_stack([low[row], high[row]]), data, edges=number[row][:, None])


def make(elements: Elements, scene: Scene, mass: Array) -> Moment:
    """The load on one rank."""
    return Moment(elements, scene, "moment")
