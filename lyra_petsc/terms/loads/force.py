"""Dead loads: a total force on a selection of vertices, or a traction per rest area."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.select import find_group, select_triangles, select_vertices
from lyra_petsc.scene.schema import AppliedLoad, Scene
from lyra_petsc.terms.handles.motion import Window
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import WindowedLoad


class Force(WindowedLoad):
    """Forces and tractions of all loads: stencil (E, 1), data ``force`` (E, 3) [N]."""

    def add_force(self, x: Array, t0: float, t1: float, out: Array) -> None:
        force = self.elements.data["force"] * self.strength(t0, t1)[:, None]
        np.add.at(out, self.stencil[:, 0], force)


def _shares(rest: RestShape, load: AppliedLoad, key: str) -> tuple[NDArray[np.int64], Array]:
    """Vertices on which a total force acts and the share of each; the shares sum to 1.

    They are proportional to rest area in surface groups and to length in curve groups, otherwise equal.
    """
    mesh = rest.mesh
    vertices = select_vertices(mesh, load, key=key, file=rest.scene.source)
    weight = np.zeros(mesh.n_vertices)
    if load.group is not None:
        group = find_group(mesh, load.group, key=key, file=rest.scene.source)
        if len(group.triangles):
            corners = mesh.triangles[group.triangles]
            np.add.at(weight, corners.ravel(), np.repeat(rest.area[group.triangles], 3))
        elif len(group.edges):
            lengths = np.linalg.norm(np.diff(mesh.rest[group.edges], axis=1)[:, 0], axis=1)
            np.add.at(weight, group.edges.ravel(), np.repeat(lengths, 2))
    if not weight.any():
        weight[vertices] = 1.0
    share: Array = weight[vertices] / weight[vertices].sum()
    return vertices, share


def elements(rest: RestShape) -> Elements:
    """Nodal forces of all force and traction loads (rank 0)."""
    vertices, forces, loads = [], [], []
    for number, load in enumerate(rest.scene.loads):
        if load.force is not None:
            chosen, share = _shares(rest, load, f"loads[{number}]")
            force = share[:, None] * np.asarray(load.force)
        elif load.traction is not None:
            faces = select_triangles(
                rest.mesh, load.group, key=f"loads[{number}].group", file=rest.scene.source
            )
            area = np.bincount(
                rest.mesh.triangles[faces].ravel(), np.repeat(rest.area[faces] / 3.0, 3), rest.mesh.n_vertices
            )
            chosen = np.flatnonzero(area)
            force = area[chosen, None] * np.asarray(load.traction)
        else:
            continue
        vertices.append(chosen)
        forces.append(force)
        loads.append(np.full(len(chosen), float(number)))
    stencil = np.concatenate(vertices)[:, None]
    return Elements(stencil, {"force": np.concatenate(forces), "load": np.concatenate(loads)})


def make(elements: Elements, scene: Scene, mass: Array) -> Force:
    """The load on one rank."""
    return Force(elements, [Window(load.start, load.until) for load in scene.loads])
