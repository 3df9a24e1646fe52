"""Meshes in formats of other programs, as meshio and VTK read them; runs in the child process.

Readers drop what they do not know, some without a word. Therefore the numbers of points and elements that
they return are compared with those of the file.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import re
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.mesh import ElementBlock
from lyra_petsc.mesh.readers import first_few, split_polygon

LIBRARIES = {
    **dict.fromkeys((".stl", ".ply", ".off", ".inp", ".bdf"), "meshio"),
    ".vtk": "vtk",
    **dict.fromkeys((".unv", ".geo"), "gmsh"),
}
"""The library that reads each format: meshio does not read surfaces of .vtk, nor gmsh their version 5."""

_POINT_SET = "points of a set"

# gmsh's numbers of elements with straight and with curved sides, and the number of corners
_KINDS = {
    **{
        _POINT_SET: (15, 15, 1),
        "vertex": (15, 15, 1),
        "line": (1, 8, 2),
        "triangle": (2, 9, 3),
        "quad": (3, 16, 4),
    },
    **{"tetra": (4, 4, 4), "hexahedron": (5, 5, 8), "wedge": (6, 6, 6), "pyramid": (7, 7, 5)},
}
_VTK_TYPES = {
    **{
        1: "vertex",
        3: "line",
        5: "triangle",
        6: "strip",
        7: "polygon",
        9: "quad",
        10: "tetra",
        12: "hexahedron",
    },
    **{13: "wedge", 14: "pyramid", 21: "line3", 22: "triangle6", 23: "quad8", 24: "tetra10", 28: "quad9"},
}
_REMEDY = "save the mesh in another format, such as .msh"


class Refused(Exception):
    """The file cannot be used; the message is for the user."""


_Names = list[tuple[int, int, str]]


class FileMesh(NamedTuple):
    """A mesh as a library read it.

    Attributes
    ----------
    tags, points : (n,) int64, (n, 3) float64
        Nodes in file order.
    elements : list of ElementBlock
    names : list of (int, int, str)
        Dimension, number and name of each group that has a name.
    notes : list of str
        Lines for the user.
    """

    tags: Ints
    points: Array
    elements: list[ElementBlock]
    names: _Names
    notes: list[str]


class _Cells(NamedTuple):
    """Elements of one type, as meshio calls it: points (n, k), and memberships (m, 2) in groups."""

    name: str
    points: Ints
    groups: Ints


def read_format(path: Path, loaded: Callable[[ModuleType], None]) -> FileMesh:
    """Read a file by meshio or VTK; ``loaded`` is called with the library before it reads.

    Raises
    ------
    Refused
    """
    library = LIBRARIES[path.suffix]
    data = path.read_bytes()
    announced = count_announced(path.suffix, data)
    try:
        module = importlib.import_module("vtkmodules.vtkIOLegacy" if library == "vtk" else library)
    except ImportError as error:
        raise Refused(
            f"{path.suffix} files need {library} ({error}); install it (pip install {library}), or {_REMEDY}"
        ) from None
    loaded(module)
    try:
        # meshio prints warnings, and ends the process at some errors
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            read = _read_vtk if library == "vtk" else _read_meshio
            return _converted(path, announced, *read(module, path))
    except (Refused, MemoryError):
        raise
    except (Exception, SystemExit) as error:  # of any kind, in damaged files
        text = f"{error.args[0]} is used and not defined" if isinstance(error, KeyError) else str(error)
        raise Refused(f"{library} cannot read it ({text or type(error).__name__}); {_REMEDY}") from None


def _converted(
    path: Path, announced: tuple[int | None, int], points: Array, cells: list[_Cells], names: _Names
) -> FileMesh:
    """The mesh that a library read, if it is whole."""
    surfaces_only = path.suffix == ".bdf"  # whose other cards are too many to know them
    counted = [
        len(block.points)
        for block in cells
        if block.name != _POINT_SET and (not surfaces_only or block.name[:4] in ("tria", "quad"))
    ]
    refuse_losses(LIBRARIES[path.suffix], announced, len(points), sum(counted))
    if points.ndim != 2 or points.shape[1] != 3:
        raise Refused(f"its points have {points.shape[-1]} coordinates, not three; {_REMEDY}")
    points = points.astype(np.float64)
    elements = [_elements(points, block) for block in cells]
    polygons = sum(len(block.points) for block in cells if block.name.startswith("polygon"))
    notes = [f"{polygons} polygons split into triangles"] if polygons else []
    return FileMesh(np.arange(len(points)), points, elements, names, notes)


def refuse_losses(library: str, announced: tuple[int | None, int], n_points: int, n_elements: int) -> None:
    """Refuse a mesh with other numbers of points and elements than ``announced``."""
    for here, there, parts in zip((n_points, n_elements), announced, ("points", "elements"), strict=True):
        if there not in (None, here):
            raise Refused(f"{library} reads {here} of the {there} {parts} in it; {_REMEDY}")


def _elements(points: Array, cells: _Cells) -> ElementBlock:
    """Elements of a type of gmsh; polygons and strips are split into triangles."""
    name, corners, groups = cells
    if corners.size and not 0 <= corners.min() <= corners.max() < len(points):
        wrong = np.unique(corners[(corners < 0) | (corners >= len(points))])
        raise Refused(f"its elements use points that it does not have: {first_few(wrong.tolist())}")
    base = name.rstrip("0123456789")
    kind = 2
    if base == "polygon":
        corners = np.concatenate([_fan(points, polygon) for polygon in corners])
    elif base == "strip":
        first = np.arange(corners.shape[1] - 2)[:, None]
        corners = corners[:, first + np.where(first % 2, [1, 0, 2], [0, 1, 2])].reshape(-1, 3)
    elif base in _KINDS:
        straight, curved, n_corners = _KINDS[base]
        if corners.ndim != 2 or corners.shape[1] < n_corners:
            raise Refused(f"is damaged: a {name} of fewer than {n_corners} points")
        kind, corners = straight if name == base else curved, corners[:, :n_corners]
    else:
        raise Refused(f"elements of the type {name} are not read; {_REMEDY}")
    return ElementBlock(kind, corners, np.zeros(len(corners), np.int64), groups)


def _fan(points: Array, polygon: Ints) -> Ints:
    fan = split_polygon(points[polygon])
    if fan is None:
        raise Refused(
            f"no fan of triangles fills the polygon of the points {first_few(polygon.tolist())}; "
            "split it into triangles"
        )
    return polygon[fan]


# -- spelling ----------------------------------------------------------------------------------------


def usual_spelling(suffix: str, data: bytes) -> bytes:
    """The content of a file in the spelling that meshio knows, of several that are in use."""
    if suffix == ".stl" and b"\0" not in data:
        return data.lower()
    if suffix == ".ply":
        return re.sub(rb"\bvertex_index\b", b"vertex_indices", data, count=1)
    if suffix == ".off":
        data = re.sub(rb"#[^\n]*", b"", data)
        return re.sub(rb"^\s*OFF\s+(\d+)\s+(\d+)\s+(\d+)", rb"OFF\n\1 \2 \3\n", data)
    if suffix == ".bdf":
        data = data.upper()
        return data if re.search(rb"^\s*BEGIN BULK", data, re.MULTILINE) else b"BEGIN BULK\n" + data
    if suffix == ".inp":
        data = re.sub(rb"^\*\*[^\n]*\n", b"", data, flags=re.MULTILINE)
        return _ABAQUS_TYPE.sub(lambda card: card[1] + _ABAQUS_FLAT.sub(rb"S\1", card[2].upper()), data)
    return data


_ABAQUS_TYPE = re.compile(rb"^(\*ELEMENT\b[^\n]*?\bTYPE\s*=\s*)(\w+)", re.MULTILINE | re.IGNORECASE)
_ABAQUS_FLAT = re.compile(rb"^(?:S|DS|M3D|SFM3D|R3D|CPS|CPE)([34])(?:R|RS|R5|RSW)?$")
"""Shells, membranes and plane elements of three or four nodes, of which meshio knows few."""


# -- libraries ---------------------------------------------------------------------------------------


def _read_meshio(meshio: ModuleType, path: Path) -> tuple[Array, list[_Cells], _Names]:
    reader = getattr(meshio, {".inp": "abaqus", ".bdf": "nastran"}.get(path.suffix, path.suffix[1:]))
    mesh = reader.read(str(path))
    if (np.asarray(mesh.point_data.get("nastran:ref", 0)) != 0).any():
        raise Refused(f"has points in coordinate systems of their own; {_REMEDY} in one system")
    if len(set(ids := getattr(mesh, "points_id", np.arange(0)).tolist())) < len(ids):
        raise Refused("has several points of one number")
    blocks = [(block.type, np.asarray(block.data)) for block in mesh.cells]
    sets = {
        name: [*members, *[None] * len(blocks)][: len(blocks)] for name, members in mesh.cell_sets.items()
    }
    if path.suffix == ".inp":
        # meshio takes the number of a set for that of the elements which define it
        owners = _inp_content(path.read_bytes()).sets
        for name in {owner for owner in owners if owner}:
            sets[name] = [
                np.arange(len(nodes)) if owner == name else None
                for owner, (_, nodes) in zip(owners, blocks, strict=True)
            ]
    names: _Names = []
    groups: list[list[Ints]] = [[] for _ in blocks]
    for number, (name, members) in enumerate(sets.items(), 1):
        for block, inside in enumerate(members):
            if inside is not None and len(inside):
                groups[block].append(np.column_stack([inside, np.full(len(inside), number)]))
        names += [(dimension, number, name) for dimension in (1, 2)]
    properties = mesh.cell_data.get("nastran:ref", [])
    if [len(numbers) for numbers in properties] == [len(nodes) for _, nodes in blocks]:
        for block, numbers in enumerate(properties):
            groups[block].append(np.column_stack([np.arange(len(numbers)), numbers]))
    cells = [
        _Cells(kind, nodes, np.concatenate([np.empty((0, 2), np.int64), *rows]))
        for (kind, nodes), rows in zip(blocks, groups, strict=True)
    ]
    for number, (name, inside) in enumerate(mesh.point_sets.items(), len(sets) + 1):
        if name not in sets and len(inside):  # programs write the nodes of each set of elements, too
            rows = np.column_stack([np.arange(len(inside)), np.full(len(inside), number)])
            cells.append(_Cells(_POINT_SET, np.asarray(inside)[:, None], rows))
            names.append((0, number, name))
    return np.asarray(mesh.points), cells, names


def _read_vtk(vtk: ModuleType, path: Path) -> tuple[Array, list[_Cells], _Names]:
    vtk_to_numpy = importlib.import_module("vtkmodules.util.numpy_support").vtk_to_numpy
    reader = vtk.vtkGenericDataObjectReader()
    reader.SetFileName(str(path))
    reader.Update()
    data = reader.GetOutput()
    if data is not None and data.IsA("vtkPolyData"):
        arrays = [(data.GetPolys(), None), (data.GetStrips(), np.array([6]))]
    elif data is not None and data.IsA("vtkUnstructuredGrid"):
        types = data.GetCellTypesArray()
        arrays = [(data.GetCells(), np.empty(0, int) if types is None else vtk_to_numpy(types))]
    else:
        raise Refused(f"VTK finds no surface mesh in it; {_REMEDY}")
    if data.GetPoints() is None:
        raise Refused("VTK finds no points in it")
    cells = []
    for array, types in arrays:
        if array is None:
            continue
        offsets = vtk_to_numpy(array.GetOffsetsArray()).astype(np.int64)
        nodes = vtk_to_numpy(array.GetConnectivityArray()).astype(np.int64)
        sizes = np.diff(offsets)
        if types is None:
            types = np.select([sizes == 3, sizes == 4], [5, 9], 7)
        kinds = np.broadcast_to(types, sizes.shape)
        # elements of one type in a row are one block
        begins = np.flatnonzero((np.diff(kinds, prepend=-1) != 0) | (np.diff(sizes, prepend=-1) != 0))
        for begin, end in pairwise([*begins, len(sizes)]):
            name = _VTK_TYPES.get(int(kinds[begin]), f"{kinds[begin]} of VTK")
            block = nodes[offsets[begin] : offsets[end]].reshape(end - begin, -1)
            cells.append(_Cells(name, block, np.empty((0, 2), np.int64)))
    return vtk_to_numpy(data.GetPoints().GetData()), cells, []


# -- what the file announces -------------------------------------------------------------------------


def count_announced(suffix: str, data: bytes) -> tuple[int | None, int]:
    """Numbers of points (None for formats without) and elements in a file; of a .bdf those of surfaces, of a
    polygonal .vtk the polygons and strips.

    Raises
    ------
    Refused
        The file is of another format, or cut short.
    """
    try:
        return _COUNTERS[suffix](data)
    except (IndexError, ValueError):
        raise Refused("is damaged: there is text where numbers belong") from None


def _count_stl(data: bytes) -> tuple[None, int]:
    n_binary = int.from_bytes(data[80:84], "little")
    if len(data) == 84 + 50 * n_binary:
        return None, n_binary
    if data.lstrip()[:5].lower() != b"solid":
        raise Refused(f"is no STL: neither text, nor as long as its {n_binary} triangles")
    if not re.search(rb"^\s*endsolid\b", data, re.MULTILINE | re.IGNORECASE):
        raise Refused("is cut short: 'endsolid' is missing")
    return None, len(re.findall(rb"^\s*facet\b", data, re.MULTILINE | re.IGNORECASE))


def _count_ply(data: bytes) -> tuple[int, int]:
    head, mark, _ = data.partition(b"end_header")
    counts = [
        re.search(rb"^element %b (\d+)\s*$" % word, head, re.MULTILINE) for word in (b"vertex", b"face")
    ]
    if not mark or not counts[0] or not counts[1]:
        raise Refused("is no PLY mesh: its header has no number of vertices and faces, or does not end")
    return int(counts[0][1]), int(counts[1][1])


def _count_off(data: bytes) -> tuple[int, int]:
    words = re.sub(rb"#[^\n]*", b"", data[:100_000]).split()
    if len(words) < 4 or words[0] != b"OFF" or not words[1].isdigit() or not words[2].isdigit():
        raise Refused("is no OFF mesh: it does not begin with OFF and the numbers of vertices and faces")
    return int(words[1]), int(words[2])


class _InpContent(NamedTuple):
    """Numbers of nodes and elements of an Abaqus file, and the set that each *ELEMENT names (or "")."""

    n_nodes: int
    n_elements: int
    sets: list[str]


def _inp_content(data: bytes) -> _InpContent:
    nodes: list[str] = []
    n_elements, n_parts, sets, keyword, continued = 0, 0, [], "", False
    for line in map(str.strip, data.decode("latin-1").splitlines()):
        if not line or line.startswith("**"):
            continue
        if line.startswith("*"):
            keyword, continued = line[1:].upper().split(",")[0].strip(), False
            n_parts += keyword == "PART"
            if keyword == "INCLUDE" or n_parts > 1:
                raise Refused(f"holds several parts or files, of which one is read; {_REMEDY}")
            if keyword == "ELEMENT":
                named = re.search(r"ELSET\s*=\s*([^,]+)", line, re.IGNORECASE)
                sets.append(named[1].strip() if named else "")
        elif keyword == "INSTANCE":
            raise Refused(f"moves its part in the assembly, which is not read; {_REMEDY}")
        elif keyword == "NODE":
            nodes.append(line.split(",")[0].strip())
        elif keyword == "ELEMENT":
            n_elements += not continued
            continued = line.endswith(",")
    if len(set(nodes)) < len(nodes):
        raise Refused("has several nodes of one number")
    return _InpContent(len(nodes), n_elements, sets)


def _count_bdf(data: bytes) -> tuple[int, int]:
    def count(cards: bytes) -> int:
        return len(re.findall(rb"^(?:%b)\b" % cards, data, re.MULTILINE | re.IGNORECASE))

    if b"ENDDATA" not in data:
        raise Refused("is cut short: ENDDATA is missing")
    return count(b"GRID"), count(rb"CTRI\w+|CQUAD\w*|CTRAX\w+|CSHEAR")


def _count_vtk(data: bytes) -> tuple[int, int]:
    version = re.match(rb"# vtk DataFile Version (\d+)", data)
    n_points = re.search(rb"^\s*POINTS\s+(\d+)", data, re.MULTILINE | re.IGNORECASE)
    cells = re.findall(
        rb"^\s*(?:CELLS|POLYGONS|TRIANGLE_STRIPS)\s+(\d+)\s+\d+", data, re.MULTILINE | re.IGNORECASE
    )
    if not version or not n_points or not cells:
        raise Refused("is no legacy .vtk of a surface: it lacks its first line, POINTS, or POLYGONS or CELLS")
    # from version 5 on it is the number of offsets, which is one more
    return int(n_points[1]), sum(int(number) - (int(version[1]) >= 5) for number in cells)


def _count_unv(data: bytes) -> tuple[int, int]:
    counts = {"nodes": 0, "elements": 0}
    lines = iter(data.decode("latin-1").splitlines())
    for line in lines:
        if line.strip() != "-1":
            continue
        number = next(lines, "").strip()
        body = _until_mark(lines)
        if number in ("15",):
            counts["nodes"] += sum(1 for _ in body)
        elif number in ("781", "2411"):
            counts["nodes"] += sum(1 for _ in body) // 2
        elif number in ("780", "2412"):
            for record in body:
                words = record.split()
                n_nodes, is_beam = int(words[-1]), int(words[1]) in (11, 21, 22, 23, 24)
                counts["elements"] += 1
                for _ in range(is_beam + -(-n_nodes // 8)):
                    next(body, None)
        else:
            for _ in body:
                pass
    return counts["nodes"], counts["elements"]


def _until_mark(lines: Iterator[str]) -> Iterator[str]:
    """The lines of a dataset, up to its mark."""
    for line in lines:
        if line.strip() == "-1":
            return
        yield line
    raise Refused("is cut short: a dataset does not end")


_COUNTERS: dict[str, Callable[[bytes], tuple[int | None, int]]] = {
    ".stl": _count_stl,
    ".ply": _count_ply,
    ".off": _count_off,
    ".inp": lambda data: _inp_content(data)[:2],
    ".bdf": _count_bdf,
    ".vtk": _count_vtk,
    ".unv": _count_unv,
}
