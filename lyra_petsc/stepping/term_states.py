"""State of the terms in a checkpoint, independent of the number of ranks; collective.

Entries of vertices and of edges have the key ``term.entry``. Entries of elements have the term's name, and
each element is identified by the numbers of its vertices in the mesh.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.protocols import Place, Stateful, TermState
from lyra_petsc.terms.term import Elastic


def _entries(equations: StageEquations, place: Place) -> Iterator[tuple[Stateful, str, TermState]]:
    """The entries of all terms at a place, with term and name."""
    for term in equations.active.stateful:
        for name, entry in term.state().items():
            if entry.place is place:
                yield term, name, entry


def vertex_arrays(equations: StageEquations) -> dict[str, Array]:
    """The terms' arrays (n_vertices, 3) of the owned vertices, by key."""
    return {f"{term.name}.{name}": entry.values for term, name, entry in _entries(equations, Place.VERTEX)}


def edge_arrays(equations: StageEquations) -> dict[str, Array]:
    """The terms' arrays (n_edges,) of the owned edges with an unknown, by key."""
    layout, found = equations.points, {}
    for term, name, entry in _entries(equations, Place.EDGE):
        rows = np.zeros(3 * layout.n_local)
        rows[_edge_indices(term)] = entry.values
        found[f"{term.name}.{name}"] = rows[layout.edge_indices]
    return found


def element_arrays(equations: StageEquations) -> dict[str, Array]:
    """Rows (E, n + m) of owned elements, by term: n mesh numbers of vertices, then m values."""
    layout, found = equations.points, {}
    for term, _, entry in _entries(equations, Place.ELEMENT):
        vertices, values = entry.vertices, entry.values
        if vertices is None:
            vertices, values = layout.global_number[term.stencil[: term.n_owned]], values[: term.n_owned]
        numbers = layout.mesh_vertex_of_local()[layout.local(vertices.ravel())].reshape(vertices.shape)
        found[term.name] = np.concatenate([numbers, values], axis=1)
    return found


def restore_fixed(
    equations: StageEquations,
    arrays: Mapping[str, Array],
    edges: Mapping[str, Array],
    elements: Mapping[str, tuple[Ints, Array]],
) -> None:
    """Restore the state of vertices, of edges, and of elements with fixed stencils.

    A term that a checkpoint knows nothing of keeps its state. ``elements`` has for each term the global
    numbers (E, n) of vertices and the values (E, m) of elements, each on any rank.
    """
    for term in equations.active.stateful:
        found = {}
        for name, entry in term.state().items():
            key = f"{term.name}.{name}"
            if entry.place is Place.VERTEX and key in arrays:
                found[name] = arrays[key]
            elif entry.place is Place.EDGE and key in edges:
                found[name] = _of_local_edges(equations, term, edges[key])
            elif entry.place is Place.ELEMENT and entry.vertices is None and term.name in elements:
                rows = _send_to_owners(equations, *elements[term.name])
                found[name] = _in_order(equations.points.global_number[term.stencil], *rows, entry.values)
        if found:
            term.restore(found, equations.x)


def obstacle_places(equations: StageEquations) -> dict[str, tuple[int, int]]:
    """Number of each obstacle in `element_arrays`, and of its first point, by name."""
    if equations.contact is None:
        return {}
    return equations.contact.barrier.obstacles.places


def restore_changing(
    equations: StageEquations,
    elements: Mapping[str, tuple[Ints, Array]],
    places: Mapping[str, tuple[int, int]],
) -> None:
    """Restore the state of elements with changing stencils (pairs that are near).

    ``places`` are the `obstacle_places` of the checkpoint.
    """
    friction = None if equations.contact is None else equations.contact.friction
    if friction is not None and friction.name in elements:
        friction.restore_pairs(*_send_to_owners(equations, *elements[friction.name]), places)
        friction.initialise_pairs(equations.x, equations.step.frozen[friction])


def _send_to_owners(equations: StageEquations, vertices: Ints, values: Array) -> tuple[Ints, Array]:
    """Exchange elements so that each rank gets those with a vertex that it owns."""
    layout, comm = equations.points, equations.points.comm
    owner = np.searchsorted(layout.bounds, vertices, side="right") - 1
    sent = [np.flatnonzero((owner == rank).any(axis=1)) for rank in range(comm.size)]
    received = comm.alltoall([(vertices[rows], values[rows]) for rows in sent])
    vertices, values = (np.concatenate(part) for part in zip(*received, strict=True))
    return vertices, values


def _edge_indices(term: Elastic) -> Ints:
    """Indices (n,) of the unknowns of a term's edges in flattened arrays over local rows."""
    return np.empty(0, dtype=np.int64) if term.edges is None else np.unique(term.edges).astype(np.int64)


def _of_local_edges(equations: StageEquations, term: Elastic, owned: Array) -> Array:
    """Values of a term's edges, ghosts included, from those of the owned edges."""
    layout = equations.points
    rows = np.zeros((layout.n_local, 3))
    rows.ravel()[layout.edge_indices] = owned
    layout.update_ghosts(rows)
    return rows.ravel()[_edge_indices(term)]


def _in_order(own: Ints, vertices: Ints, values: Array, present: Array) -> Array:
    """Values (k, m) of a checkpoint's elements in the order of a term's.

    ``own`` (E, n) are the vertices of the term's elements, ``vertices`` (k, n) those of the checkpoint.
    Elements that are not in the checkpoint keep their ``present`` values (E, m).
    """
    row_of = {tuple(key): row for row, key in enumerate(vertices.tolist())}
    rows = np.array([row_of.get(tuple(key), -1) for key in own.tolist()], dtype=np.int64)
    restored = present.copy()
    restored[rows >= 0] = values[rows[rows >= 0]]
    return restored
