"""gmsh .msh files, formats 2.2 and 4.1, ASCII and binary: triangles and physical groups in file order."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.meshing.files import printable, read_bytes
from lyra_petsc.meshing.msh_elements import Block, blocks_2, blocks_2_binary, blocks_4
from lyra_petsc.meshing.msh_surface import NoTrianglesError, assemble
from lyra_petsc.meshing.msh_values import BinaryValues, MshError, TextValues, Values, one, several
from lyra_petsc.meshing.sheet import Sheet

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

_SECTION = re.compile(rb"^[ \t]*\$([A-Za-z]\w*)[ \t]*\r?\n", re.MULTILINE)
_NAME = re.compile(r'^\s*(\d+)\s+(-?\d+)\s+"(.*)"\s*$', re.MULTILINE)


@dataclass
class _File:
    """The sections of a file and how to read them; ``order`` is empty for ASCII."""

    version: str
    order: str
    sections: dict[str, bytes] = field(default_factory=dict)

    def values(self, section: str) -> Values:
        body = self.sections[section]
        return BinaryValues(body, self.order) if self.order else TextValues(body)


def read_msh(path: Path, *, note_loose: bool = True) -> Sheet:
    """Read a .msh file.

    Vertices come in the order in which the file lists its nodes; those in no triangle are dropped, with
    a note unless ``note_loose`` is False. Triangles come in file order. Quads are split on the shorter
    diagonal, elements of higher order reduced to their corners, with a note. A physical group without a
    name is called by its number.

    Raises
    ------
    InputError
        If the file is of another format, damaged, or holds no triangles.
    """
    content = _sections(read_bytes(path), path)
    for section in ("Nodes", "Elements"):
        if section not in content.sections:
            raise InputError(f"the mesh has no triangles: section ${section} is missing", file=path)
    section = ""
    try:
        section = "Nodes"
        tags, points = _nodes(content)
        section = "Entities"
        physical = _entities(content)
        section = "Elements"
        blocks = _elements(content, physical)
        return assemble(tags, points, blocks, _names(content), note_loose=note_loose)
    except NoTrianglesError as error:
        raise InputError(f"the mesh has {error}", file=path) from None
    except MshError as error:
        raise InputError(f"damaged: section ${section} {error}", file=path) from None


def _sections(data: bytes, path: Path) -> _File:
    found: _File | None = None
    at = 0
    while (head := _SECTION.search(data, at)) is not None:
        name = head.group(1)
        end = data.find(b"$End" + name, head.end())
        if end < 0:
            if found is None and name != b"MeshFormat":
                break
            raise InputError(f"damaged: section ${name.decode()} does not end", file=path)
        body = data[head.end() : end]
        at = end + 4 + len(name)
        if name == b"MeshFormat":
            found = _format(body, path)
        elif found is not None:
            found.sections.setdefault(name.decode(), body)
    if found is None:
        hint = "format 1" if b"$NOD" in data[:200] else "no $MeshFormat section"
        raise InputError(f"is no gmsh mesh of format 2.2 or 4.1 ({hint})", file=path)
    return found


def _format(body: bytes, path: Path) -> _File:
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


def _nodes(content: _File) -> tuple[Ints, Floats]:
    """Tags (n,) and points (n, 3) in file order."""
    if content.version == "4.1":
        values = content.values("Nodes")
        tags, points = [np.empty(0, dtype=np.int64)], [np.empty((0, 3))]
        for _ in range(several(values, 4, "size")[0]):
            dimension, _, parametric = several(values, 3)
            count = one(values, "size")
            tags.append(values.rows(count, 1, width="size")[0][:, 0])
            extra = dimension if parametric and 0 <= dimension <= 3 else 0
            points.append(values.rows(count, 0, 3 + extra)[1][:, :3])
        return np.concatenate(tags), np.concatenate(points)
    values, count = _counted(content, "Nodes")
    rows, points_2 = values.rows(count, 1, 3)
    return rows[:, 0], points_2


def _elements(content: _File, physical: dict[tuple[int, int], list[int]]) -> list[Block]:
    if content.version == "4.1":
        return blocks_4(content.values("Elements"), physical)
    if not content.order:
        return blocks_2(content.values("Elements"))
    values, count = _counted(content, "Elements")
    return blocks_2_binary(values, count)


def _counted(content: _File, section: str) -> tuple[Values, int]:
    """Values of a format 2 section after its count, which is text in binary files too."""
    if not content.order:
        values = content.values(section)
        return values, one(values)
    line, _, rest = content.sections[section].partition(b"\n")
    if not line.strip().isdigit() or len(line) > 20:
        raise MshError("does not begin with a count")
    return BinaryValues(rest, content.order), int(line)


def _entities(content: _File) -> dict[tuple[int, int], list[int]]:
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
            several(values, 1, "size")
            values.rows(one(values, "size"), 2)
        for dimension, count in enumerate(several(values, 4, "size")):
            for _ in range(count):
                tag = one(values)
                if partitioned:
                    several(values, 2)
                    several(values, one(values, "size"))
                values.rows(1, 0, 3 if dimension == 0 else 6)
                groups = several(values, one(values, "size"))
                physical[dimension, tag] = [abs(group) for group in groups]
                if dimension > 0:
                    several(values, one(values, "size"))
    return physical


def _names(content: _File) -> dict[tuple[int, int], str]:
    text = content.sections.get("PhysicalNames", b"").decode("utf-8", errors="replace").replace("\r", "")
    return {(int(dim), abs(int(tag))): printable(name) for dim, tag, name in _NAME.findall(text)}
