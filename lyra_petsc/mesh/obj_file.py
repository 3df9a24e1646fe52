"""Reader of Wavefront .obj files: positions, material coordinates (``vt``), faces and named groups."""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.mesh import NamedSet, Sheet
from lyra_petsc.mesh.readers import drop_loose_vertices, first_few, printable, split_polygon, split_quads
from lyra_petsc.scene.text import read_bytes

# keywords that are ignored without a note
_IGNORED = re.compile(
    "v[np]|[ps]|mtllib|maplib|usemap|bevel|[cd]_interp|lod|cstype|deg|bmat|step|curv2?|surf|parm|trim|"
    "hole|scrv|sp|end|con|mg|shadow_obj|trace_obj|[cs]tech"
)

MAX_CORNERS = 256
"""Limit on the corners of a polygon: the work of splitting it grows with their square."""


@dataclass
class _Raw:
    """The content of the lines; indices count from 0, −1 stands for a missing ``vt``."""

    points: array[float] = field(default_factory=lambda: array("d"))
    uv: array[float] = field(default_factory=lambda: array("d"))
    corner_point: array[int] = field(default_factory=lambda: array("q"))
    corner_uv: array[int] = field(default_factory=lambda: array("q"))
    face_size: array[int] = field(default_factory=lambda: array("q"))
    face_line: array[int] = field(default_factory=lambda: array("q"))
    spans: list[tuple[str, int, int]] = field(default_factory=list)
    curves: dict[str, list[tuple[int, int]]] = field(default_factory=dict)
    unknown: dict[str, int] = field(default_factory=dict)


def read_obj(path: Path) -> Sheet:
    """Read an .obj file.

    It reads ``v``, ``vt``, ``f`` (``a``, ``a/b``, ``a//c``, ``a/b/c``, negative numbers, polygons), and
    ``g``, ``o`` and ``usemtl`` as surface groups; ``l`` after ``g`` are the edges of a group of curves; a
    backslash continues a line. Other keywords are ignored, with a note if they are unknown. Quads are split
    along the shorter diagonal, larger polygons into a fan. Vertices in no face are dropped with a note.

    Raises
    ------
    InputError
        Text that is no number, a vertex out of range, a face of fewer than three corners, or ``vt`` at some
        corners only; the message gives the line.
    """
    data = read_bytes(path)
    if b"\0" in data:
        raise InputError("is no text file, hence no .obj mesh", file=path)
    raw = _parse(data.decode("utf-8-sig", errors="replace"), path)
    if not raw.face_size:
        raise InputError("no faces ('f' lines), hence no triangles", file=path)
    point, uv_index = np.array(raw.corner_point, dtype=np.int64), np.array(raw.corner_uv, dtype=np.int64)
    points = np.array(raw.points, dtype=np.float64).reshape(-1, 3)
    uv = np.array(raw.uv, dtype=np.float64).reshape(-1, 2)
    size, line = np.array(raw.face_size, dtype=np.int64), np.array(raw.face_line, dtype=np.int64)
    corner_line = np.repeat(line, size)
    _check_range(point, len(points), "vertex", corner_line, path)
    with_uv = uv_index >= 0
    if with_uv.any() and not with_uv.all():
        raise InputError(
            f"faces with and without vt (without: {_lines(corner_line[~with_uv])}); give vt to all or none",
            file=path,
        )
    if with_uv.any():
        _check_range(uv_index, len(uv), "vt", corner_line, path)
    corners, first = _split(points[point], size, line, path)
    sheet = Sheet(points, point[corners], uv[uv_index[corners]] if with_uv.any() else None)
    if (size > 3).any():
        sheet.notes.append(f"{int((size > 3).sum())} faces with more than three corners split into triangles")
    if raw.unknown:
        sheet.notes.append(f"lines with unknown keywords ignored: {first_few(sorted(raw.unknown))}")
    sheet.groups = [
        NamedSet(name, 2, np.arange(first[begin], first[end], dtype=np.int64))
        for name, begin, end in raw.spans
        if end > begin
    ]
    for name, edges in raw.curves.items():
        members = np.array(edges, dtype=np.int64)
        if members.max() >= len(points):
            message = f"no vertex {members.max() + 1} for the edges of '{name}'; the file has {len(points)}"
            raise InputError(message, file=path)
        sheet.groups.append(NamedSet(name, 1, members))
    drop_loose_vertices(sheet)
    return sheet


def _parse(text: str, path: Path) -> _Raw:
    raw = _Raw()
    open_groups: dict[str, list[str]] = {"g": [], "o": [], "usemtl": []}
    begin = dict.fromkeys(open_groups, 0)

    def close(kind: str, names: list[str]) -> None:
        n_faces = len(raw.face_size)
        raw.spans.extend((name, begin[kind], n_faces) for name in open_groups[kind])
        open_groups[kind], begin[kind] = names, n_faces

    for number, line in _logical_lines(text):
        parts = line.split()
        if not parts:
            continue
        word = parts[0]
        try:
            if word == "v":
                x, y, z = parts[1:4]
                raw.points.extend((float(x), float(y), float(z)))
            elif word == "f":
                _parse_face(raw, parts, number)
            elif word == "l":
                edges = _parse_line(raw, parts)
                for name in open_groups["g"]:
                    raw.curves.setdefault(name, []).extend(edges)
            elif word == "vt":
                raw.uv.extend((float(parts[1]), float(parts[2]) if len(parts) > 2 else 0.0))
            elif word == "g":
                close("g", [printable(name) for name in parts[1:]])
            elif word in ("o", "usemtl"):
                close(word, [printable(" ".join(parts[1:]))] if len(parts) > 1 else [])
            elif not _IGNORED.fullmatch(word):
                raw.unknown[printable(word[:20])] = number
        except (ValueError, IndexError, OverflowError) as error:
            shown = printable(line.strip()[:60])
            reason = f" ({error})" if isinstance(error, _FaceError) else ""
            raise InputError(f"line {number}: '{shown}' cannot be read{reason}", file=path) from None
    for kind in begin:
        close(kind, [])
    return raw


class _FaceError(ValueError):
    """A malformed face, with the message for it."""


def _parse_face(raw: _Raw, parts: list[str], number: int) -> None:
    if len(parts) < 4:
        raise _FaceError("a face has at least three corners")
    if len(parts) > MAX_CORNERS + 1:
        raise _FaceError(f"{len(parts) - 1} corners, at most {MAX_CORNERS}; split it into triangles")
    for corner in parts[1:]:
        fields = corner.split("/")
        raw.corner_point.append(_from_zero(int(fields[0]), len(raw.points) // 3, "vertex"))
        has_uv = len(fields) > 1 and fields[1] != ""
        raw.corner_uv.append(_from_zero(int(fields[1]), len(raw.uv) // 2, "vt") if has_uv else -1)
    raw.face_size.append(len(parts) - 1)
    raw.face_line.append(number)


def _parse_line(raw: _Raw, parts: list[str]) -> list[tuple[int, int]]:
    """The edges of a line through two vertices or more."""
    if len(parts) < 3:
        raise _FaceError("a line has at least two vertices")
    vertices = [_from_zero(int(part.split("/")[0]), len(raw.points) // 3, "vertex") for part in parts[1:]]
    return list(pairwise(vertices))


def _from_zero(index: int, count: int, kind: str) -> int:
    """Index from 0 of an .obj index, which counts from 1, or if negative back from the last of ``count``."""
    if index > 0:
        return index - 1
    if index == 0 or -index > count:
        raise _FaceError(f"no {kind} {index}; {count} so far, numbers count from 1")
    return count + index


def _logical_lines(text: str) -> Iterator[tuple[int, str]]:
    """Lines with their numbers, without comments; a line that ends in a backslash is joined to the next."""
    pending, start = "", 0
    for number, line in enumerate(text.replace("\r\n", "\n").replace("\r", "\n").split("\n"), 1):
        if "#" in line:
            line = line[: line.index("#")]
        if line.endswith("\\"):
            start = start or number
            pending += line[:-1] + " "
            continue
        yield (start or number), pending + line
        pending, start = "", 0
    if pending:
        yield start, pending


def _split(points: Array, size: Ints, line: Ints, path: Path) -> tuple[Ints, Ints]:
    """Corner numbers (F, 3) of the triangles in file order, and the first triangle of each face (n + 1,).

    ``points`` (C, 3) are the positions of the corners of all faces, ``size`` and ``line`` (n,) the number of
    corners and the line of each face.
    """
    begin = np.concatenate(([0], np.cumsum(size)))
    first = np.concatenate(([0], np.cumsum(size - 2)))
    triangles = np.empty((first[-1], 3), dtype=np.int64)
    for n in np.unique(size):
        faces = np.flatnonzero(size == n)
        corner = begin[faces][:, None] + np.arange(n)
        if n == 3:
            triangles[first[faces]] = corner
        elif n == 4:
            local = split_quads(points[corner])
            triangles[first[faces][:, None] + np.arange(2)] = begin[faces][:, None, None] + local
        else:
            for face in faces:
                fan = split_polygon(points[begin[face] : begin[face + 1]])
                if fan is None:
                    raise InputError(
                        f"line {line[face]}: a polygon of {n} corners that no fan of triangles fills; "
                        "split it into triangles",
                        file=path,
                    )
                triangles[first[face] : first[face + 1]] = begin[face] + fan
    return triangles, first


def _check_range(index: Ints, count: int, kind: str, line: Ints, path: Path) -> None:
    wrong = np.flatnonzero(index >= count)
    if wrong.size:
        raise InputError(
            f"line {line[wrong[0]]}: no {kind} {index[wrong[0]] + 1}; the file has {count}", file=path
        )


def _lines(numbers: Ints) -> str:
    return "lines " + first_few(np.unique(numbers).tolist())
