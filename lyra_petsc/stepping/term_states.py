"""What terms keep in a checkpoint beside positions and velocities, for any number of ranks; collective.

Of vertices and of edges with an unknown by ``term.name``; of elements that change with the vertices' numbers
in the mesh.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.term import Elastic


def vertex_arrays(system: StageEquations) -> dict[str, Array]:
    """Arrays (n_vertices, 3) of the owned vertices."""
    return {
        f"{term.name}.{name}": values
        for term in system.active.elastic
        for name, values in term.state().items()
    }


def edge_arrays(system: StageEquations) -> dict[str, Array]:
    """Arrays (n_edges,) of the owned edges with an unknown."""
    layout, found = system.points, {}
    for term in system.active.elastic:
        for name, values in term.edge_state().items():
            rows = np.zeros(3 * layout.n_local)
            rows[term.edge_indices] = values
            found[f"{term.name}.{name}"] = rows[layout.edge_indices]
    return found


def element_arrays(system: StageEquations) -> dict[str, Array]:
    """Of elements (E, n + m) each, of which the first n are numbers of vertices in the mesh."""
    layout, found = system.points, {}
    for term in system.active.elastic:
        if term.registration.element_vertices:
            if term.registration.neighbours:
                vertices, values = term.element_state()
            else:
                vertices = layout.global_number[term.stencil[: term.n_owned]]
                values = term.element_values()[: term.n_owned]
            numbers = layout.mesh_vertex_of_local()[layout.local(vertices.ravel())].reshape(vertices.shape)
            found[term.name] = np.concatenate([numbers, values], axis=1)
    return found


def restore_fixed(
    system: StageEquations, edges: Mapping[str, Array], elements: Mapping[str, tuple[Ints, Array]]
) -> None:
    """Let terms go on with what is of edges, and of elements that stay: given by global numbers (E, n), on
    any rank.
    """
    for term in system.active.elastic:
        if term.registration.edge_state:
            _restore_edges(system, term, edges)
        if term.name in elements and not term.registration.neighbours:
            vertices, values = _send_to_owners(system, *elements[term.name])
            _restore_values(term, system.points.global_number[term.stencil], vertices, values)


def restore_changing(
    system: StageEquations, arrays: Mapping[str, Array], elements: Mapping[str, tuple[Ints, Array]]
) -> None:
    """Let them go on with what is of vertices, and of elements that come and go with what is near."""
    layout = system.points
    for term in system.active.elastic:
        if term.registration.state:
            known = {name: arrays.get(f"{term.name}.{name}") for name in term.registration.state}
            term.restore({name: array for name, array in known.items() if array is not None})
        if term.name in elements and term.registration.neighbours:
            own = range(layout.start, layout.start + layout.n_owned)
            term.restore_elements(*_send_to_owners(system, *elements[term.name]), own)
            term.initialise_pairs(system.x, system.active.frozen[term])


def _send_to_owners(system: StageEquations, vertices: Ints, values: Array) -> tuple[Ints, Array]:
    """Elements of all ranks that have a vertex of this one."""
    layout, comm = system.points, system.points.comm
    owner = np.searchsorted(layout.bounds, vertices, side="right") - 1
    sent = [np.flatnonzero((owner == rank).any(axis=1)) for rank in range(comm.size)]
    came = comm.alltoall([(vertices[rows], values[rows]) for rows in sent])
    vertices, values = (np.concatenate(part) for part in zip(*came, strict=True))
    return vertices, values


def _restore_edges(system: StageEquations, term: Elastic, edges: Mapping[str, Array]) -> None:
    """Let a term go on with what is of edges, those of ghosts too."""
    layout, state = system.points, {}
    for name in term.registration.edge_state:
        rows = np.zeros((layout.n_local, 3))
        rows.ravel()[layout.edge_indices] = edges[f"{term.name}.{name}"]
        layout.update_ghosts(rows)
        state[name] = rows.ravel()[term.edge_indices]
    term.restore_edges(state, system.x)


def _restore_values(term: Elastic, own: Ints, vertices: Ints, values: Array) -> None:
    """Let a term whose elements have these vertices (E, n) go on with values (k, m) of others (k, n), among
    which they are; those that are not keep what they have.
    """
    found, now = {tuple(key): row for row, key in enumerate(vertices.tolist())}, term.element_values().copy()
    rows = np.array([found.get(tuple(key), -1) for key in own.tolist()], dtype=np.int64)
    now[rows >= 0] = values[rows[rows >= 0]]
    term.restore_values(now)
