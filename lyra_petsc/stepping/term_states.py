"""State of the terms in a checkpoint, independent of the number of ranks; collective.

Entries have the key ``term.entry``. Elements are identified by the numbers of their vertices in the mesh, a
further entry, `VERTICES`, of the term.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.points import Layout
from lyra_petsc.terms.protocols import Place, Stateful, TermState
from lyra_petsc.terms.term import Elastic

VERTICES = "vertices"
"""Name of the entry with the numbers of the vertices of a term's elements."""


class ElementState(NamedTuple):
    """The state of a term's elements, each on any rank.

    Attributes
    ----------
    vertices : (E, n)
        Global numbers of their vertices.
    values : mapping of (E, m)
        By the name of the entry.
    """

    vertices: Ints
    values: Mapping[str, Array]


def _entries(terms: Iterable[Stateful], place: Place) -> Iterator[tuple[Stateful, str, TermState]]:
    """The entries of all terms at a place, with term and name."""
    for term in terms:
        for name, entry in term.state().items():
            if entry.place is place:
                yield term, name, entry


def vertex_arrays(terms: Iterable[Stateful]) -> dict[str, Array]:
    """The terms' arrays (n_vertices, 3) of the owned vertices, by key."""
    return {f"{term.name}.{name}": entry.values for term, name, entry in _entries(terms, Place.VERTEX)}


def edge_arrays(terms: Iterable[Stateful], layout: Layout) -> dict[str, Array]:
    """The terms' arrays (n_edges,) of the owned edges with an unknown, by key."""
    arrays = {}
    for term, name, entry in _entries(terms, Place.EDGE):
        rows = np.zeros(3 * layout.n_local)
        rows[_edge_indices(term)] = entry.values
        arrays[f"{term.name}.{name}"] = rows[layout.edge_indices]
    return arrays


def element_arrays(terms: Iterable[Stateful], layout: Layout) -> dict[str, Array]:
    """The terms' arrays (E, m) of owned elements, and mesh numbers (E, n) of their vertices, by key."""
    arrays = {}
    for term, name, entry in _entries(terms, Place.ELEMENT):
        vertices, values = entry.vertices, entry.values
        if vertices is None:
            vertices, values = layout.global_number[term.stencil[: term.n_owned]], values[: term.n_owned]
        numbers = layout.mesh_vertex_of_local()[layout.local(vertices.ravel())].reshape(vertices.shape)
        arrays[f"{term.name}.{VERTICES}"] = numbers.astype(np.float64)
        arrays[f"{term.name}.{name}"] = values
    return arrays


def restore_fixed(
    terms: Iterable[Stateful],
    layout: Layout,
    x: Array,
    arrays: Mapping[str, Array],
    edges: Mapping[str, Array],
    elements: Mapping[str, ElementState],
) -> None:
    """Restore the state of vertices, edges, and elements with fixed stencils, at positions x (n_local, 3).

    A term that a checkpoint knows nothing of keeps its state. ``elements`` is by the name of the term.
    """
    for term in terms:
        state = {}
        for name, entry in term.state().items():
            key = f"{term.name}.{name}"
            if entry.place is Place.VERTEX and key in arrays:
                state[name] = arrays[key]
            elif entry.place is Place.EDGE and key in edges:
                state[name] = _of_local_edges(layout, term, edges[key])
            elif entry.place is Place.ELEMENT and entry.vertices is None and term.name in elements:
                rows, own = _send_to_owners(layout, elements[term.name]), layout.global_number[term.stencil]
                state[name] = _in_order(own, rows.vertices, rows.values[name], entry.values)
        if state:
            term.restore(state, x)


def restore_changing(
    friction: Any,
    layout: Layout,
    elements: ElementState,
    places: Mapping[str, tuple[int, int]],
) -> None:
    """Restore the state of elements with changing stencils (pairs that are near).

    ``places`` are the numbers of obstacles and of their first points in the checkpoint, by name.
    """
    friction.restore_pairs(*_send_to_owners(layout, elements), places)


def _send_to_owners(layout: Layout, elements: ElementState) -> ElementState:
    """Exchange elements so that each rank gets those with a vertex that it owns."""
    comm, (vertices, by_name) = layout.comm, elements
    owner = np.searchsorted(layout.bounds, vertices, side="right") - 1
    sent = [np.flatnonzero((owner == rank).any(axis=1)) for rank in range(comm.size)]
    arrays = vertices, *by_name.values()
    received = comm.alltoall([[values[rows] for values in arrays] for rows in sent])
    vertices, *parts = (np.concatenate(part) for part in zip(*received, strict=True))
    return ElementState(vertices, dict(zip(by_name, parts, strict=True)))


def _edge_indices(term: Elastic) -> Ints:
    """Indices (n,) of the unknowns of a term's edges in flattened arrays over local rows."""
    return np.empty(0, dtype=np.int64) if term.edges is None else np.unique(term.edges).astype(np.int64)


def _of_local_edges(layout: Layout, term: Elastic, owned: Array) -> Array:
    """Values of a term's edges, ghosts included, from those of the owned edges."""
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
