"""From the nodes and element blocks of a .msh file to the triangles and groups of a sheet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.meshing.files import culprits
from lyra_petsc.meshing.msh_elements import ELEMENT_TYPES, Block
from lyra_petsc.meshing.msh_values import MshError
from lyra_petsc.meshing.polygons import split_quads
from lyra_petsc.meshing.sheet import NamedSet, Sheet

Ints = NDArray[np.int64]
Names = dict[tuple[int, int], str]


class NoTrianglesError(MshError):
    """A sound file without a surface mesh."""


def assemble(
    tags: Ints, points: NDArray[np.float64], blocks: list[Block], names: Names, *, note_loose: bool
) -> Sheet:
    """Sheet of the triangles in ``blocks``.

    Parameters
    ----------
    tags : (n,) int64
        Node tags in file order.
    points : (n, 3) float64
    blocks : list of Block
        Elements in file order, with node tags.
    names : dict
        Names of physical groups by (dimension, tag).
    note_loose : bool
        Whether dropping nodes that are in no triangle deserves a note.

    Raises
    ------
    MshError
        Tags that are used twice or belong to no node.
    NoTrianglesError
    """
    notes: list[str] = []
    blocks = _numbered(blocks, tags)
    triangles, entity, members = _triangles(points, [b for b in blocks if b.dimension == 2], notes)
    if len(triangles) == 0:
        solid = any(block.dimension == 3 and len(block.nodes) for block in blocks)
        hint = ", only solid elements: save the surface mesh" if solid else ""
        raise NoTrianglesError("no triangles" + hint)
    triangles, members = _once(triangles, entity, members)
    used = np.zeros(len(tags), dtype=np.bool_)
    used[triangles] = True
    new_number = np.cumsum(used) - 1
    if note_loose and not used.all():
        loose = tags[~used]
        verb = "node that is in no triangle" if len(loose) == 1 else "nodes that are in no triangle"
        notes.append(f"{len(loose)} {verb} dropped (tag {culprits(loose.tolist())})")
    groups = [
        NamedSet(names.get((2, tag), str(tag)), 2, inside) for tag, inside in members.items() if len(inside)
    ]
    for dimension in (1, 0):
        groups += _lower(dimension, blocks, names, used, new_number)
    empty = {name for (dimension, _), name in names.items() if dimension < 3} - {
        group.name for group in groups
    }
    if empty:
        notes.append(f"physical groups without elements on the triangles left out: {culprits(sorted(empty))}")
    kept = tags[used]
    counted = np.array_equal(kept, np.arange(1, len(kept) + 1))
    return Sheet(
        points[used], new_number[triangles], groups=groups, notes=notes, tags=None if counted else kept
    )


def _numbered(blocks: list[Block], tags: Ints) -> list[Block]:
    """``blocks`` up to dimension 2, with positions in the file instead of node tags."""
    order = np.argsort(tags, kind="stable")
    ascending = tags[order]
    twice = np.unique(ascending[1:][ascending[1:] == ascending[:-1]])
    if twice.size:
        raise MshError(f"cannot be understood: several nodes have the tag {culprits(twice.tolist())}")
    numbered = []
    for block in blocks:
        if block.dimension == 3:
            numbered.append(block)
            continue
        at = np.searchsorted(ascending, block.nodes)
        known = at < len(tags)
        known[known] = ascending[at[known]] == block.nodes[known]
        if not known.all():
            unknown = culprits(np.unique(block.nodes[~known]).tolist())
            raise MshError(f"uses nodes that do not exist: tag {unknown}")
        numbered.append(Block(block.kind, order[at], block.entity, block.physical))
    return numbered


def _triangles(
    points: NDArray[np.float64], blocks: list[Block], notes: list[str]
) -> tuple[Ints, Ints, dict[int, Ints]]:
    """Triangles (F, 3), their entities (F,) and the triangles of each physical tag."""
    parts = [np.empty((0, 3), dtype=np.int64)]
    entities = [np.empty(0, dtype=np.int64)]
    members: dict[int, list[Ints]] = {}
    begin = quads = curved = 0
    for block in blocks:
        _, corners, nodes = ELEMENT_TYPES[block.kind]
        curved += len(block.nodes) if nodes > corners else 0
        each = corners - 2
        part = block.nodes
        if corners == 4:
            quads += len(part)
            part = np.take_along_axis(part[:, None, :], split_quads(points[part]), axis=2).reshape(-1, 3)
        parts.append(part)
        entities.append(np.repeat(block.entity, each))
        for tag, inside in block.physical:
            expanded = (inside[:, None] * each + np.arange(each)).reshape(-1) + begin
            members.setdefault(tag, []).append(expanded)
        begin += len(part)
    if quads:
        notes.append(f"{quads} quads split into triangles")
    if curved:
        notes.append(f"{curved} elements of higher order reduced to their corners")
    merged = {tag: np.concatenate(lists) for tag, lists in sorted(members.items())}
    return np.concatenate(parts), np.concatenate(entities), merged


def _once(triangles: Ints, entity: Ints, members: dict[int, Ints]) -> tuple[Ints, dict[int, Ints]]:
    """Drop the repetitions with which format 2 writes an element that is in several groups.

    Only where the same triangle of the same entity stands once per group; any other repetition is left
    for the checks of the mesh to refuse.
    """
    if len(members) < 2:
        return triangles, members
    rows = np.column_stack([entity, np.sort(triangles, axis=1)])
    order = np.lexsort(rows.T[::-1])
    new = np.concatenate(([True], (rows[order][1:] != rows[order][:-1]).any(axis=1)))
    if new.all():
        return triangles, members
    # lexsort is stable: the first of each run stands first in the file
    representative = np.empty(len(triangles), dtype=np.int64)
    representative[order] = order[new][np.cumsum(new) - 1]
    if any(len(np.unique(representative[inside])) < len(inside) for inside in members.values()):
        return triangles, members
    keep = representative == np.arange(len(triangles))
    number = np.cumsum(keep) - 1
    return triangles[keep], {
        tag: np.unique(number[representative[inside]]) for tag, inside in members.items()
    }


def _lower(
    dimension: int, blocks: list[Block], names: Names, used: NDArray[np.bool_], new_number: Ints
) -> list[NamedSet]:
    """Groups of points or curves, reduced to vertices that are kept."""
    collected: dict[int, list[Ints]] = {}
    for block in blocks:
        if block.dimension == dimension:
            for tag, inside in block.physical:
                collected.setdefault(tag, []).append(block.nodes[inside])
    groups = []
    for tag, lists in sorted(collected.items()):
        nodes = np.concatenate(lists)
        kept = new_number[nodes[used[nodes].all(axis=1)]]
        if len(kept):
            members = kept if dimension == 1 else kept[:, 0]
            groups.append(NamedSet(names.get((dimension, tag), str(tag)), dimension, members))
    return groups
