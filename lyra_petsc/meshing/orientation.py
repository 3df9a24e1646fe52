"""Consistent orientation: neighbouring triangles run along their common edge in opposite directions."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.meshing.topology import edge_table

Ints = NDArray[np.int64]


class NotOrientableError(ValueError):
    """A one-sided surface (Möbius strip); ``triangles`` (n, 2) are neighbours that contradict."""

    def __init__(self, triangles: Ints) -> None:
        super().__init__("the surface cannot be oriented")
        self.triangles = triangles


def reversed_triangles(triangles: Ints) -> NDArray[np.bool_]:
    """Triangles to turn over so that orientation is consistent in each connected piece.

    In each piece the larger part keeps its orientation, in a tie that of the first triangle.

    Parameters
    ----------
    triangles : (F, 3) int64
        At most two triangles on an edge.

    Returns
    -------
    (F,) bool

    Raises
    ------
    NotOrientableError
    """
    table = edge_table(triangles)
    begin = table.first[table.sizes == 2]
    first, second = table.sides[begin], table.sides[begin + 1]
    corner = triangles.reshape(-1)
    # both sides start at the same vertex: the two triangles disagree
    disagree = corner[first] == corner[second]
    if not disagree.any():
        return np.zeros(len(triangles), dtype=np.bool_)
    pairs = np.stack([first // 3, second // 3], axis=1)
    return _walk(len(triangles), pairs, disagree)


def _walk(n_triangles: int, pairs: Ints, disagree: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Breadth-first walk over each piece: who must be turned over relative to where it began."""
    links: list[list[tuple[int, bool]]] = [[] for _ in range(n_triangles)]
    for (one, other), differs in zip(pairs.tolist(), disagree.tolist(), strict=True):
        links[one].append((other, differs))
        links[other].append((one, differs))
    turned: list[bool | None] = [None] * n_triangles
    for seed in range(n_triangles):
        if turned[seed] is not None:
            continue
        turned[seed] = False
        piece, queue = [seed], deque([seed])
        while queue:
            here = queue.popleft()
            for there, differs in links[here]:
                if turned[there] is None:
                    turned[there] = bool(turned[here]) != differs
                    piece.append(there)
                    queue.append(there)
        if 2 * sum(bool(turned[member]) for member in piece) > len(piece):
            for member in piece:
                turned[member] = not turned[member]
    result = np.array(turned, dtype=np.bool_)
    contradiction = (result[pairs[:, 0]] != result[pairs[:, 1]]) != disagree
    if contradiction.any():
        raise NotOrientableError(pairs[contradiction])
    return result
