"""Dead loads: a total force on a selection of vertices, or a traction per rest area."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.select import find_group, select_triangles, select_vertices
from lyra_petsc.scene.schema import AppliedLoad, Scene
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import UpcomingStep, WindowedLoad


class Force(WindowedLoad):
    """Forces and tractions of all loads: stencil (E, 1), data ``share`` (E,), of a force, or area [m²]."""

    def add_force(self, step: UpcomingStep, out: Array) -> None:
        np.add.at(out, self.stencil[:, 0], self.elements.data["share"][:, None] * self.values(step))


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
    """Vertices of all force and traction loads, and their shares (rank 0)."""
    vertices, shares, loads = [], [], []
    for number, load in enumerate(rest.scene.loads):
        if load.force is not None:
            chosen, share = _shares(rest, load, f"loads[{number}]")
        elif load.traction is not None:
            faces = select_triangles(
                rest.mesh, load.group, key=f"loads[{number}].group", file=rest.scene.source
            )
            area = np.bincount(
                rest.mesh.triangles[faces].ravel(), np.repeat(rest.area[faces] / 3.0, 3), rest.mesh.n_vertices
            )
            chosen = np.flatnonzero(area)
            share = np.asarray(area[chosen], dtype=np.float64)
        else:
            continue
        vertices.append(chosen)
        shares.append(share)
        loads.append(np.full(len(chosen), float(number)))
    stencil = np.concatenate(vertices)[:, None]
    return Elements(stencil, {"share": np.concatenate(shares), "load": np.concatenate(loads)})


def make(elements: Elements, scene: Scene, mass: Array) -> Force:
    """The load on one rank."""
    return Force(elements, scene, "force", "traction")
