"""Reader of gmsh's .msh files (formats 2.2 and 4.1): triangles and physical groups in file order.

It does not use gmsh, which in a child process takes 1.6 times as long for a million triangles (binary 4.1:
3.1 s instead of 1.9 s; text 2.2: 10.5 s instead of 6.5 s), changes the order of the nodes of format 2.2, and
does not say which section of a file is damaged.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.mesh import ElementBlock, NamedSet, Sheet
from lyra_petsc.mesh.readers import drop_loose_vertices, first_few, printable, split_quads
from lyra_petsc.scene.text import read_bytes

Names = dict[tuple[int, int], str]
Width = Literal["int", "size"]

_SECTION = re.compile(rb"^[ \t]*\$([A-Za-z]\w*)[ \t]*\r?\n", re.MULTILINE)
_NAME = re.compile(r'^\s*(\d+)\s+(-?\d+)\s+"(.*)"\s*$', re.MULTILINE)


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


_WITHOUT_TRIANGLES = {
    1: ", only curves: make a surface, and beside other physical groups a Physical Surface of it",
    3: ", only solid elements: save the surface mesh",
}


class MshError(ValueError):
    """A section does not follow the format; the message is for the user."""


class NoTrianglesError(MshError):
    """An undamaged file without a surface mesh."""


def read_msh(path: Path) -> Sheet:
    """Read a .msh file.

    Vertices and triangles are in file order. With a note, nodes in no triangle are dropped, quads are split
    along the shorter diagonal, and elements of higher order are reduced to their corners. A physical group
    without a name is called by its number.

    Raises
    ------
    InputError
        If the file is of another format, damaged, or holds no triangles.
    """
    content = _read_sections(read_bytes(path), path)
    nodes = "ParametricNodes" if "ParametricNodes" in content.sections else "Nodes"
    for section in (nodes, "Elements"):
        if section not in content.sections:
            raise InputError(f"the mesh has no triangles: section ${section} is missing", file=path)
    section = ""
    try:
        section = nodes
        tags, points = _read_nodes(content)
        section = "Entities"
        physical = _read_entities(content)
        section = "Elements"
        blocks = _read_elements(content, physical)
        return assemble_sheet(tags, points, blocks, _read_names(content), note_loose=True)
    except NoTrianglesError as error:
        raise InputError(f"the mesh has {error}", file=path) from None
    except MshError as error:
        raise InputError(f"damaged: section ${section} {error}", file=path) from None


# -- sections ----------------------------------------------------------------------------------------


@dataclass
class _File:
    """The sections of a file; ``order`` is the byte order (< or >) of a binary file, empty for ASCII."""

    version: str
    order: str
    sections: dict[str, bytes] = field(default_factory=dict)

    def values(self, section: str) -> Values:
        body = self.sections[section]
        return BinaryValues(body, self.order) if self.order else TextValues(body)


def _read_sections(data: bytes, path: Path) -> _File:
    content: _File | None = None
    at = 0
    while (head := _SECTION.search(data, at)) is not None:
        name = head.group(1)
        end = data.find(b"$End" + name, head.end())
        if end < 0:
            if content is None and name != b"MeshFormat":
                break
            raise InputError(f"damaged: section ${name.decode()} does not end", file=path)
        body = data[head.end() : end]
        at = end + 4 + len(name)
        if name == b"MeshFormat":
            content = _read_format(body, path)
        elif content is not None:
            content.sections.setdefault(name.decode(), body)
    if content is None:
        hint = "format 1" if b"$NOD" in data[:200] else "no $MeshFormat section"
        raise InputError(f"is no gmsh mesh of format 2.2 or 4.1 ({hint})", file=path)
    return content


def _read_format(body: bytes, path: Path) -> _File:
    line, _, rest = body.partition(b"\n")
    words = line.decode("latin-1").split()
    if len(words) < 3 or words[1] not in ("0", "1"):
        raise InputError("damaged: section $MeshFormat is not 'version type size'", file=path)
    version, kind, size = words[:3]
    if version not in ("2", "2.0", "2.1", "2.2", "4.1"):
        raise InputError(
            f"format {version} is not read; 2.2 and 4.1 are: "
            f"gmsh {path.name} -save -format msh41 -o new-{path.name}",
            file=path,
        )
    if kind == "0":
        return _File(version, "")
    if size != "8" or len(rest) < 4:
        raise InputError(
            "damaged: binary file without its byte-order mark or with sizes other than 8", file=path
        )
    for order in "<>":
        if int(np.frombuffer(rest, dtype=f"{order}i4", count=1)[0]) == 1:
            return _File(version, order)
    raise InputError("damaged: the byte-order mark of a binary file is not 1", file=path)


def _read_nodes(content: _File) -> tuple[Ints, Array]:
    """Tags (n,) and points (n, 3) in file order."""
    if content.version == "4.1":
        values = content.values("Nodes")
        tags, points = [np.empty(0, dtype=np.int64)], [np.empty((0, 3))]
        for _ in range(read_ints(values, 4, "size")[0]):
            dimension, _, parametric = read_ints(values, 3)
            count = read_int(values, "size")
            tags.append(values.rows(count, 1, width="size")[0][:, 0])
            extra = dimension if parametric and 0 <= dimension <= 3 else 0
            points.append(values.rows(count, 0, 3 + extra)[1][:, :3])
        return np.concatenate(tags), np.concatenate(points)
    if "ParametricNodes" in content.sections:
        return _read_parametric_nodes(*_read_count(content, "ParametricNodes"))
    values, count = _read_count(content, "Nodes")
    rows, points_2 = values.rows(count, 1, 3)
    return rows[:, 0], points_2


def _read_parametric_nodes(values: Values, count: int) -> tuple[Ints, Array]:
    """Nodes of format 2 with their entities and the parameters on these: one on a curve, two on a surface."""
    tags, points = [np.empty((0, 1), dtype=np.int64)], [np.empty((0, 3))]
    for _ in range(count):
        tag, point = values.rows(1, 1, 3)
        dimension, _ = read_ints(values, 2)
        values.rows(1, 0, dimension if dimension in (1, 2) else 0)
        tags.append(tag)
        points.append(point)
    return np.concatenate(tags)[:, 0], np.concatenate(points)


def _read_elements(content: _File, physical: dict[tuple[int, int], list[int]]) -> list[ElementBlock]:
    if content.version == "4.1":
        return blocks_4(content.values("Elements"), physical)
    if not content.order:
        return blocks_2(TextValues(content.sections["Elements"]))
    values, count = _read_count(content, "Elements")
    return blocks_2_binary(values, count)


def _read_count(content: _File, section: str) -> tuple[Values, int]:
    """Values of a format 2 section and their count, which precedes them as text in binary files too."""
    if not content.order:
        values = content.values(section)
        return values, read_int(values)
    line, _, rest = content.sections[section].partition(b"\n")
    if not line.strip().isdigit() or len(line) > 20:
        raise MshError("does not begin with a count")
    return BinaryValues(rest, content.order), int(line)


def _read_entities(content: _File) -> dict[tuple[int, int], list[int]]:
    """Physical groups of each entity (dimension, tag) of a 4.1 file."""
    physical: dict[tuple[int, int], list[int]] = {}
    if content.version != "4.1":
        return physical
    for section in ("Entities", "PartitionedEntities"):
        if section not in content.sections:
            continue
        values = content.values(section)
        partitioned = section == "PartitionedEntities"
        if partitioned:
            read_ints(values, 1, "size")
            values.rows(read_int(values, "size"), 2)
        for dimension, count in enumerate(read_ints(values, 4, "size")):
            for _ in range(count):
                tag = read_int(values)
                if partitioned:
                    read_ints(values, 2)
                    read_ints(values, read_int(values, "size"))
                values.rows(1, 0, 3 if dimension == 0 else 6)
                groups = read_ints(values, read_int(values, "size"))
                physical[dimension, tag] = [abs(group) for group in groups]
                if dimension > 0:
                    read_ints(values, read_int(values, "size"))
    return physical


def _read_names(content: _File) -> dict[tuple[int, int], str]:
    text = content.sections.get("PhysicalNames", b"").decode("utf-8", errors="replace").replace("\r", "")
    return {(int(dim), abs(int(tag))): printable(name) for dim, tag, name in _NAME.findall(text)}


# -- numbers of a section ----------------------------------------------------------------------------


class TextValues:
    """Values of an ASCII section, read from front to back."""

    def __init__(self, body: bytes) -> None:
        with warnings.catch_warnings():
            # numpy warns and stops at the first text that is no number
            warnings.simplefilter("error")
            try:
                self._values = np.fromstring(body.decode("latin-1"), dtype=np.float64, sep=" ")
            except (DeprecationWarning, ValueError):
                raise MshError("holds something that is no number") from None
        self._at = 0

    def rows(self, n: int, integers: int, reals: int = 0, width: Width = "int") -> tuple[Ints, Array]:
        """Read ``n`` rows of ``integers`` integers followed by ``reals`` real numbers.

        Returns (n, integers) int64 and (n, reals) float64. ``width`` is the type of the integers in a binary
        file: C ``int`` or ``size_t``.

        Raises
        ------
        MshError
            If fewer numbers remain, or an integer is none.
        """
        columns = integers + reals
        if n < 0 or n * columns > len(self._values) - self._at:
            raise MshError(f"is cut short: {n} rows announced, too few numbers left")
        table = self._values[self._at : self._at + n * columns].reshape(n, columns)
        self._at += n * columns
        return _whole(table[:, :integers]), np.array(table[:, integers:])

    def peek(self, n: int) -> Ints:
        """The next integers, at most ``n``, without advancing."""
        return _whole(self._values[self._at : self._at + n])


class BinaryValues:
    """Values of a binary section, with the methods of `TextValues`; ``order`` is ``<`` or ``>``."""

    def __init__(self, body: bytes, order: str) -> None:
        self._body = body
        self._order = order
        self._at = 0

    def rows(self, n: int, integers: int, reals: int = 0, width: Width = "int") -> tuple[Ints, Array]:
        whole = f"{self._order}{'i4' if width == 'int' else 'u8'}"
        row = np.dtype([("whole", whole, (integers,)), ("real", f"{self._order}f8", (reals,))])
        if n < 0 or n * row.itemsize > len(self._body) - self._at:
            raise MshError(f"is cut short: {n} rows announced, too few bytes left")
        table = np.frombuffer(self._body, dtype=row, count=n, offset=self._at)
        self._at += n * row.itemsize
        largest = int(table["whole"].max()) if n and integers else 0
        if largest >= 2**62:
            raise MshError(f"holds the number {largest} where a count or a tag belongs")
        return table["whole"].astype(np.int64), table["real"].astype(np.float64)


Values: TypeAlias = TextValues | BinaryValues


def read_int(values: Values, width: Width = "int") -> int:
    """Read the next integer."""
    return int(values.rows(1, 1, width=width)[0][0, 0])


def read_ints(values: Values, n: int, width: Width = "int") -> list[int]:
    """Read the next ``n`` integers."""
    return values.rows(n, 1, width=width)[0][:, 0].tolist()


def _whole(table: Array) -> Ints:
    # floats are exact for integers below 2^53; no tag of a mesh is as large
    if not (
        np.isfinite(table).all() and (np.abs(table) < 2.0**53).all() and (table == np.floor(table)).all()
    ):
        raise MshError("holds something else where a count or a tag belongs")
    return table.astype(np.int64)


# -- elements ----------------------------------------------------------------------------------------


def element_type(kind: int) -> tuple[int, int, int]:
    """Dimension, corners and nodes of a gmsh element type; raises MshError if unknown."""
    try:
        return ELEMENT_TYPES[kind]
    except KeyError:
        raise MshError(f"holds elements of the unknown type {kind}") from None


def blocks_2(values: TextValues) -> list[ElementBlock]:
    """Blocks of an ASCII format 2 ``$Elements`` section, in file order."""
    remaining = read_int(values)
    blocks = []
    while remaining > 0:
        head = values.peek(3)
        if len(head) < 3:
            raise MshError("is cut short")
        kind, n_tags = int(head[1]), int(head[2])
        nodes = element_type(kind)[2]
        width = 3 + _check_tag_count(n_tags) + nodes
        # consecutive rows of one type and number of tags are read at once
        run, n_rows = 0, 64
        while True:
            ahead = values.peek(min(n_rows, remaining) * width)
            table = ahead[: len(ahead) // width * width].reshape(-1, width)
            same = (table[:, 1] == kind) & (table[:, 2] == n_tags)
            run = int(np.argmin(same)) if not same.all() else len(same)
            if run < len(same) or len(same) < n_rows:
                break
            n_rows *= 8
        if run == 0:
            raise MshError("is cut short")
        blocks.append(_block_2(kind, values.rows(run, width)[0][:, 3:], n_tags))
        remaining -= run
    return blocks


def blocks_2_binary(values: Values, n_elements: int) -> list[ElementBlock]:
    """Blocks of a binary format 2 ``$Elements`` section, whose count ``n_elements`` is text."""
    blocks: list[ElementBlock] = []
    remaining = n_elements
    while remaining > 0:
        kind, count, n_tags = read_ints(values, 3)
        if count < 1:
            raise MshError(f"holds a block of {count} elements")
        rows = values.rows(count, 1 + _check_tag_count(n_tags) + element_type(kind)[2])[0]
        blocks.append(_block_2(kind, rows[:, 1:], n_tags))
        remaining -= count
    return _merge_blocks(blocks)


def blocks_4(values: Values, physical: dict[tuple[int, int], list[int]]) -> list[ElementBlock]:
    """Blocks of a format 4.1 ``$Elements`` section; ``physical`` gives the groups of each (dim, tag)."""
    blocks = []
    n_blocks = read_ints(values, 4, "size")[0]
    for _ in range(n_blocks):
        dimension, entity, kind = read_ints(values, 3)
        count = read_int(values, "size")
        _, corners, nodes = element_type(kind)
        rows = values.rows(count, 1 + nodes, width="size")[0]
        tags = np.array(physical.get((dimension, entity), []), dtype=np.int64)
        groups = np.column_stack([np.tile(np.arange(count), len(tags)), np.repeat(tags, count)])
        blocks.append(ElementBlock(kind, rows[:, 1 : 1 + corners], np.full(count, entity), groups))
    return blocks


def _check_tag_count(n_tags: int) -> int:
    if not 0 <= n_tags <= 100_000:
        raise MshError(f"holds an element with {n_tags} tags")
    return n_tags


def _block_2(kind: int, rows: Ints, n_tags: int) -> ElementBlock:
    corners = element_type(kind)[1]
    # a negative tag marks a group in which the orientation of the entity is reversed
    physical = np.abs(rows[:, 0]) if n_tags > 0 else np.zeros(len(rows), dtype=np.int64)
    entity = rows[:, 1] if n_tags > 1 else np.zeros(len(rows), dtype=np.int64)
    inside = np.flatnonzero(physical)
    groups = np.column_stack([inside, physical[inside]])
    return ElementBlock(kind, rows[:, n_tags : n_tags + corners], entity, groups)


def _merge_blocks(blocks: list[ElementBlock]) -> list[ElementBlock]:
    """Merge consecutive blocks of one type: some programs write a block for each element."""
    merged = []
    for kind, same in groupby(blocks, key=lambda block: block.kind):
        run = list(same)
        first = np.cumsum([0] + [len(block.nodes) for block in run])
        groups = [block.groups + [offset, 0] for block, offset in zip(run, first, strict=False)]
        nodes = np.concatenate([block.nodes for block in run])
        entity = np.concatenate([block.entity for block in run])
        merged.append(ElementBlock(kind, nodes, entity, np.concatenate(groups)))
    return merged


def _by_tag(members: Ints, tags: Ints) -> dict[int, Ints]:
    """The ``members`` (n, …) of each tag, in their order; tags ascending."""
    order = np.argsort(tags, kind="stable")
    present, first = np.unique(tags[order], return_index=True)
    parts = np.split(members[order], first[1:])
    return dict(zip(present.tolist(), parts, strict=False))


# -- triangles and groups ----------------------------------------------------------------------------


def assemble_sheet(
    tags: Ints, points: Array, blocks: list[ElementBlock], names: Names, *, note_loose: bool
) -> Sheet:
    """Make a `Sheet` of the triangles in ``blocks``.

    Parameters
    ----------
    tags : (n,) int64
        Node tags in file order.
    points : (n, 3) float64
    blocks : list of ElementBlock
        Elements in file order, with node tags.
    names : dict
        Names of physical groups by (dimension, tag).
    note_loose : bool
        Add a note if vertices in no triangle are dropped.

    Raises
    ------
    MshError
        A tag that several nodes or no node has.
    NoTrianglesError
    """
    notes: list[str] = []
    blocks = _resolve_tags(blocks, tags)
    triangles, entity, members = _triangles(points, _of_dimension(2, blocks), notes)
    n_solids = sum(len(block.nodes) for block in _of_dimension(3, blocks))
    if len(triangles) == 0:
        highest = 3 if n_solids else 1 if _of_dimension(1, blocks) else 0
        raise NoTrianglesError("no triangles" + _WITHOUT_TRIANGLES.get(highest, ""))
    if n_solids:
        notes.append(f"{n_solids} solid elements left out")
    triangles, members = _drop_repeated(triangles, entity, members)
    groups = [NamedSet(names.get((2, tag), str(tag)), 2, inside) for tag, inside in members.items()]
    for dimension in (1, 0):
        groups += _lower_groups(dimension, blocks, names)
    counted_from_0 = np.array_equal(tags, np.arange(len(tags)))
    sheet = Sheet(
        points,
        triangles,
        groups=[group for group in groups if len(group.members)],
        notes=notes,
        tags=None if counted_from_0 else tags,
    )
    drop_loose_vertices(sheet, noted=note_loose)
    empty = {name for (dimension, _), name in names.items() if dimension < 3}
    empty -= {group.name for group in sheet.groups}
    if empty:
        notes.append(
            f"physical groups without elements on the triangles left out: {first_few(sorted(empty))}"
        )
    if sheet.tags is not None and np.array_equal(sheet.tags, np.arange(1, len(sheet.points) + 1)):
        sheet.tags = None
    return sheet


def _of_dimension(dimension: int, blocks: list[ElementBlock]) -> list[ElementBlock]:
    return [block for block in blocks if element_type(block.kind)[0] == dimension and len(block.nodes)]


def _resolve_tags(blocks: list[ElementBlock], tags: Ints) -> list[ElementBlock]:
    """``blocks`` up to dimension 2, with indices of nodes in file order instead of tags."""
    order = np.argsort(tags, kind="stable")
    ascending = tags[order]
    twice = np.unique(ascending[1:][ascending[1:] == ascending[:-1]])
    if twice.size:
        raise MshError(f"cannot be understood: several nodes have the tag {first_few(twice.tolist())}")
    numbered = []
    for block in blocks:
        if element_type(block.kind)[0] == 3:
            numbered.append(block)
            continue
        at = np.searchsorted(ascending, block.nodes)
        known = at < len(tags)
        known[known] = ascending[at[known]] == block.nodes[known]
        if not known.all():
            unknown = first_few(np.unique(block.nodes[~known]).tolist())
            raise MshError(f"uses nodes that do not exist: tag {unknown}")
        numbered.append(ElementBlock(block.kind, order[at], block.entity, block.groups))
    return numbered


def _triangles(
    points: Array, blocks: list[ElementBlock], notes: list[str]
) -> tuple[Ints, Ints, dict[int, Ints]]:
    """Triangles (F, 3), their entities (F,) and the triangles of each physical tag."""
    parts = [np.empty((0, 3), dtype=np.int64)]
    entities = [np.empty(0, dtype=np.int64)]
    members, tags = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    begin = quads = curved = 0
    for block in blocks:
        _, corners, nodes = ELEMENT_TYPES[block.kind]
        curved += len(block.nodes) if nodes > corners else 0
        per_element = corners - 2
        part = block.nodes
        if corners == 4:
            quads += len(part)
            part = np.take_along_axis(part[:, None, :], split_quads(points[part]), axis=2).reshape(-1, 3)
        parts.append(part)
        entities.append(np.repeat(block.entity, per_element))
        members.append((block.groups[:, :1] * per_element + np.arange(per_element)).reshape(-1) + begin)
        tags.append(np.repeat(block.groups[:, 1], per_element))
        begin += len(part)
    if quads:
        notes.append(f"{quads} quads split into triangles")
    if curved:
        notes.append(f"{curved} elements of higher order reduced to their corners")
    by_tag = _by_tag(np.concatenate(members), np.concatenate(tags))
    return np.concatenate(parts), np.concatenate(entities), by_tag


def _drop_repeated(triangles: Ints, entity: Ints, members: dict[int, Ints]) -> tuple[Ints, dict[int, Ints]]:
    """Drop repeated triangles: format 2 contains an element once for each group that it is in.

    Only repetitions of a triangle in the same entity and different groups are dropped; others remain for
    `build.check_topology` to refuse.
    """
    if len(members) < 2:
        return triangles, members
    rows = np.column_stack([entity, np.sort(triangles, axis=1)])
    order = np.lexsort(rows.T[::-1])
    new = np.concatenate(([True], (rows[order][1:] != rows[order][:-1]).any(axis=1)))
    if new.all():
        return triangles, members
    # lexsort is stable: the first of equal triangles is the first in the file
    representative = np.empty(len(triangles), dtype=np.int64)
    representative[order] = order[new][np.cumsum(new) - 1]
    if any(len(np.unique(representative[inside])) < len(inside) for inside in members.values()):
        return triangles, members
    keep = representative == np.arange(len(triangles))
    number = np.cumsum(keep) - 1
    return triangles[keep], {
        tag: np.unique(number[representative[inside]]) for tag, inside in members.items()
    }


def _lower_groups(dimension: int, blocks: list[ElementBlock], names: Names) -> list[NamedSet]:
    """Groups of points or curves."""
    chosen = _of_dimension(dimension, blocks)
    if not chosen:
        return []
    nodes = np.concatenate([block.nodes[block.groups[:, 0]] for block in chosen])
    tags = np.concatenate([block.groups[:, 1] for block in chosen])
    return [
        NamedSet(names.get((dimension, tag), str(tag)), dimension, inside if dimension == 1 else inside[:, 0])
        for tag, inside in _by_tag(nodes, tags).items()
    ]
