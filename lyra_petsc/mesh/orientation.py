"""Consistent orientation: neighbouring triangles run along their common edge in opposite directions."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.mesh import Sheet
from lyra_petsc.mesh.readers import first_few
from lyra_petsc.mesh.topology import edge_table

Ints = NDArray[np.int64]


def orient(sheet: Sheet, *, file: object | None, key: str | None = None) -> None:
    """Turn triangles over until the orientation is consistent in each connected piece, with a note.

    In each piece the larger part keeps its orientation, in a tie that of the first triangle.

    Parameters
    ----------
    sheet : Sheet
        At most two triangles on an edge.

    Raises
    ------
    InputError
        A one-sided surface (Möbius strip).
    """
    table = edge_table(sheet.triangles)
    begin = table.first[table.sizes == 2]
    first, second = table.sides[begin], table.sides[begin + 1]
    corner = sheet.triangles.reshape(-1)
    # both sides start at the same vertex: the two triangles disagree
    disagree = corner[first] == corner[second]
    if not disagree.any():
        return
    pairs = np.stack([first // 3, second // 3], axis=1)
    turned = _walk(len(sheet.triangles), pairs, disagree)
    contradiction = pairs[(turned[pairs[:, 0]] != turned[pairs[:, 1]]) != disagree]
    if contradiction.size:
        shown = first_few(f"{one}-{other}" for one, other in contradiction.tolist())
        raise InputError(
            f"the surface has one side only (a Möbius strip): cut it where triangles {shown} meet "
            "(counted from 0)",
            file=file,
            key=key,
        )
    sheet.triangles = sheet.triangles.copy()
    sheet.triangles[turned] = sheet.triangles[turned][:, [0, 2, 1]]
    if sheet.uv is not None:
        sheet.uv = sheet.uv.copy()
        sheet.uv[turned] = sheet.uv[turned][:, [0, 2, 1]]
    sheet.notes.append(
        f"{int(turned.sum())} of {len(turned)} triangles turned over so that all are oriented alike"
    )


def _walk(n_triangles: int, pairs: Ints, disagree: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Triangles to turn over, by a breadth-first walk over each connected piece."""
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
    return np.array(turned, dtype=np.bool_)
