"""Element blocks of .msh files, format 2 and format 4."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.meshing.msh_values import MshError, Values, one, several

Ints = NDArray[np.int64]

# gmsh element types: (dimension, corners, nodes), from the gmsh reference manual, "MSH file format"
ELEMENT_TYPES: dict[int, tuple[int, int, int]] = {
    15: (0, 1, 1),
    **{kind: (1, 2, nodes) for kind, nodes in {1: 2, 8: 3, 26: 4, 27: 5, 28: 6}.items()},
    **{
        kind: (2, 3, nodes)
        for kind, nodes in {2: 3, 9: 6, 20: 9, 21: 10, 22: 12, 23: 15, 24: 15, 25: 21}.items()
    },
    **{kind: (2, 4, nodes) for kind, nodes in {3: 4, 10: 9, 16: 8, 36: 16, 37: 25, 38: 36}.items()},
    **{kind: (3, 4, nodes) for kind, nodes in {4: 4, 11: 10, 29: 20, 30: 35, 31: 56}.items()},
    **{kind: (3, 8, nodes) for kind, nodes in {5: 8, 12: 27, 17: 20, 92: 64, 93: 125}.items()},
    **{kind: (3, 6, nodes) for kind, nodes in {6: 6, 13: 18, 18: 15}.items()},
    **{kind: (3, 5, nodes) for kind, nodes in {7: 5, 14: 14, 19: 13}.items()},
}


@dataclass
class Block:
    """Elements of one type.

    Attributes
    ----------
    kind : int
        gmsh element type.
    nodes : (n, corners) int64
        Tags of the corner nodes.
    entity : (n,) int64
        Tag of the geometrical entity.
    physical : list of (tag, (m,) int64)
        Physical groups with the elements of the block that are in them.
    """

    kind: int
    nodes: Ints
    entity: Ints
    physical: list[tuple[int, Ints]]

    @property
    def dimension(self) -> int:
        return ELEMENT_TYPES[self.kind][0]


def element_type(kind: int) -> tuple[int, int, int]:
    """Dimension, corners and nodes of a gmsh element type; raises MshError if unknown."""
    try:
        return ELEMENT_TYPES[kind]
    except KeyError:
        raise MshError(f"holds elements of the unknown type {kind}") from None


def blocks_2(values: Values) -> list[Block]:
    """Blocks of an ASCII format 2 ``$Elements`` section, in file order."""
    left = one(values)
    blocks = []
    while left > 0:
        head = values.window(3)
        if len(head) < 3:
            raise MshError("is cut short")
        kind, n_tags = int(head[1]), int(head[2])
        nodes = element_type(kind)[2]
        width = 3 + _tags(n_tags) + nodes
        # rows of one type and number of tags mostly follow each other: take as many at once as do
        run, reach = 0, 64
        while True:
            ahead = values.window(min(reach, left) * width)
            table = ahead[: len(ahead) // width * width].reshape(-1, width)
            same = (table[:, 1] == kind) & (table[:, 2] == n_tags)
            run = int(np.argmin(same)) if not same.all() else len(same)
            if run < len(same) or len(same) < reach:
                break
            reach *= 8
        if run == 0:
            raise MshError("is cut short")
        blocks.append(_block_2(kind, values.rows(run, width)[0][:, 3:], n_tags))
        left -= run
    return blocks


def blocks_2_binary(values: Values, n_elements: int) -> list[Block]:
    """Blocks of a binary format 2 ``$Elements`` section, whose count ``n_elements`` is text."""
    blocks: list[Block] = []
    left = n_elements
    while left > 0:
        kind, follow, n_tags = several(values, 3)
        if follow < 1:
            raise MshError(f"holds a block of {follow} elements")
        rows = values.rows(follow, 1 + _tags(n_tags) + element_type(kind)[2])[0]
        blocks.append(_block_2(kind, rows[:, 1:], n_tags))
        left -= follow
    return _joined(blocks)


def blocks_4(values: Values, physical: dict[tuple[int, int], list[int]]) -> list[Block]:
    """Blocks of a format 4.1 ``$Elements`` section; ``physical`` gives the groups of each (dim, tag)."""
    blocks = []
    n_blocks = several(values, 4, "size")[0]
    for _ in range(n_blocks):
        dimension, entity, kind = several(values, 3)
        count = one(values, "size")
        _, corners, nodes = element_type(kind)
        rows = values.rows(count, 1 + nodes, width="size")[0]
        everything = np.arange(count, dtype=np.int64)
        groups = [(tag, everything) for tag in physical.get((dimension, entity), [])]
        blocks.append(Block(kind, rows[:, 1 : 1 + corners], np.full(count, entity, dtype=np.int64), groups))
    return blocks


def _tags(n_tags: int) -> int:
    if not 0 <= n_tags <= 100_000:
        raise MshError(f"holds an element with {n_tags} tags")
    return n_tags


def _block_2(kind: int, rows: Ints, n_tags: int) -> Block:
    corners = element_type(kind)[1]
    # a negative number marks a group that sees the entity from behind
    physical = np.abs(rows[:, 0]) if n_tags > 0 else np.zeros(len(rows), dtype=np.int64)
    entity = rows[:, 1] if n_tags > 1 else np.zeros(len(rows), dtype=np.int64)
    groups = [(int(tag), np.flatnonzero(physical == tag)) for tag in np.unique(physical) if tag != 0]
    return Block(kind, rows[:, n_tags : n_tags + corners], entity, groups)


def _joined(blocks: list[Block]) -> list[Block]:
    """Neighbouring blocks of one type made one: some writers give each element its own block."""
    runs: list[list[Block]] = []
    for block in blocks:
        if runs and runs[-1][0].kind == block.kind:
            runs[-1].append(block)
        else:
            runs.append([block])
    joined = []
    for run in runs:
        offset = np.cumsum([0] + [len(block.nodes) for block in run])
        members: dict[int, list[Ints]] = {}
        for block, shift in zip(run, offset, strict=False):
            for tag, inside in block.physical:
                members.setdefault(tag, []).append(inside + shift)
        joined.append(
            Block(
                run[0].kind,
                np.concatenate([block.nodes for block in run]),
                np.concatenate([block.entity for block in run]),
                [(tag, np.concatenate(parts)) for tag, parts in sorted(members.items())],
            )
        )
    return joined
