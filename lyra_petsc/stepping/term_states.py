"""State of the terms in a checkpoint, independent of the number of ranks; collective.

Entries of vertices and of edges have the key ``term.entry``. Entries of elements are identified by the
numbers of the vertices in the mesh.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.term import Elastic


def vertex_arrays(system: StageEquations) -> dict[str, Array]:
    """The terms' arrays (n_vertices, 3) of the owned vertices, by key."""
    return {
        f"{term.name}.{name}": values
        for term in system.active.elastic
        for name, values in term.state().items()
    }


def edge_arrays(system: StageEquations) -> dict[str, Array]:
    """The terms' arrays (n_edges,) of the owned edges with an unknown, by key."""
    layout, found = system.points, {}
    for term in system.active.elastic:
        for name, values in term.edge_state().items():
            rows = np.zeros(3 * layout.n_local)
            rows[term.edge_indices] = values
            found[f"{term.name}.{name}"] = rows[layout.edge_indices]
    return found


def element_arrays(system: StageEquations) -> dict[str, Array]:
    """Rows (E, n + m) of owned elements, by term: n mesh numbers of vertices, then m values."""
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
    """Restore the state of edges, and of elements with fixed stencils.

    ``elements`` has for each term the global numbers (E, n) of vertices and the values (E, m) of elements,
    each on any rank.
    """
    for term in system.active.elastic:
        if term.registration.edge_state:
            _restore_edges(system, term, edges)
        if term.name in elements and not term.registration.neighbours:
            vertices, values = _send_to_owners(system, *elements[term.name])
            _restore_values(term, system.points.global_number[term.stencil], vertices, values)


def obstacle_places(system: StageEquations) -> dict[str, tuple[int, int]]:
    """Number of each obstacle in `element_arrays`, and of its first point, by name."""
    return {name: place for term in system.active.changing for name, place in term.obstacle_places.items()}


def restore_changing(
    system: StageEquations,
    arrays: Mapping[str, Array],
    elements: Mapping[str, tuple[Ints, Array]],
    places: Mapping[str, tuple[int, int]],
) -> None:
    """Restore the state of vertices, and of elements with changing stencils (pairs that are near).

    ``places`` are the `obstacle_places` of the checkpoint.
    """
    layout = system.points
    for term in system.active.elastic:
        names = term.registration.state
        if names and all(f"{term.name}.{name}" in arrays for name in names):
            term.restore({name: arrays[f"{term.name}.{name}"] for name in names})
        if term.name in elements and term.registration.neighbours:
            own = range(layout.start, layout.start + layout.n_owned)
            term.restore_elements(*_send_to_owners(system, *elements[term.name]), own, places)
            term.initialise_pairs(system.x, system.active.frozen[term])


def _send_to_owners(system: StageEquations, vertices: Ints, values: Array) -> tuple[Ints, Array]:
    """Exchange elements so that each rank gets those with a vertex that it owns."""
    layout, comm = system.points, system.points.comm
    owner = np.searchsorted(layout.bounds, vertices, side="right") - 1
    sent = [np.flatnonzero((owner == rank).any(axis=1)) for rank in range(comm.size)]
    received = comm.alltoall([(vertices[rows], values[rows]) for rows in sent])
    vertices, values = (np.concatenate(part) for part in zip(*received, strict=True))
    return vertices, values


def _restore_edges(system: StageEquations, term: Elastic, edges: Mapping[str, Array]) -> None:
    """Restore a term's state of edges, ghosts included."""
    layout, state = system.points, {}
    for name in term.registration.edge_state:
        rows = np.zeros((layout.n_local, 3))
        rows.ravel()[layout.edge_indices] = edges[f"{term.name}.{name}"]
        layout.update_ghosts(rows)
        state[name] = rows.ravel()[term.edge_indices]
    term.restore_edges(state, system.x)


def _restore_values(term: Elastic, own: Ints, vertices: Ints, values: Array) -> None:
    """Restore the values of a term's elements.

    ``own`` (E, n) are the vertices of its elements, ``vertices`` (k, n) and ``values`` (k, m) those of the
    checkpoint, in another order. Elements that are not in the checkpoint keep their values.
    """
    row_of = {tuple(key): row for row, key in enumerate(vertices.tolist())}
    rows = np.array([row_of.get(tuple(key), -1) for key in own.tolist()], dtype=np.int64)
    restored = term.element_values().copy()
    restored[rows >= 0] = values[rows[rows >= 0]]
    term.restore_values(restored)
