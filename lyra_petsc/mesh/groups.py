"""Groups of several sources brought under unique names."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.mesh.mesh import Group, NamedSet
from lyra_petsc.mesh.select import DIMENSION_NAMES

Ints = NDArray[np.int64]


class GroupTable:
    """Collects the groups of each source, then makes one dictionary of them."""

    def __init__(self) -> None:
        self._members: dict[tuple[str, int], list[Ints]] = {}

    def add(
        self,
        groups: list[NamedSet],
        source: str | None,
        n_triangles: int,
        first_vertex: int,
        first_triangle: int,
    ) -> None:
        """Take the groups of one source of ``n_triangles``, numbered from the given vertex and triangle."""
        for group in groups:
            members = group.members + (first_triangle if group.dimension == 2 else first_vertex)
            self._put(group.name, group.dimension, members)
            if source is not None:
                self._put(f"{source}.{group.name}", group.dimension, members)
        if source is not None:
            self._put(source, 2, np.arange(first_triangle, first_triangle + n_triangles, dtype=np.int64))

    def finish(self, triangles: Ints) -> tuple[dict[str, Group], list[str]]:
        """Groups by unique name, and a note for each name that had to change.

        ``triangles`` is (F, 3), of the whole mesh.
        """
        groups: dict[str, Group] = {}
        notes: list[str] = []
        # surfaces first: they keep the name, as materials can be told by surface groups only
        for name, dimension in sorted(self._members, key=lambda entry: -entry[1]):
            members = np.concatenate(self._members[name, dimension])
            unique = name
            while unique in groups:
                unique = f"{unique}.{DIMENSION_NAMES[dimension]}"
            if unique != name:
                notes.append(
                    f"group '{name}' is used for several dimensions; that of {DIMENSION_NAMES[dimension]}s "
                    f"is called '{unique}'"
                )
            groups[unique] = _group(dimension, members, triangles)
        return groups, notes

    def _put(self, name: str, dimension: int, members: Ints) -> None:
        self._members.setdefault((name, dimension), []).append(members)


def _group(dimension: int, members: Ints, triangles: Ints) -> Group:
    no_triangles, no_edges = np.empty(0, dtype=np.int64), np.empty((0, 2), dtype=np.int64)
    if dimension == 2:
        inside = np.unique(members)
        return Group(2, np.unique(triangles[inside]), inside, no_edges)
    if dimension == 1:
        edges = np.unique(np.sort(members, axis=1), axis=0)
        return Group(1, np.unique(edges), no_triangles, edges)
    return Group(0, np.unique(members), no_triangles, no_edges)
