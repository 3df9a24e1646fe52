"""From the mesh sources of a scene to one checked mesh; serial, for rank 0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.meshing.capacity import check_capacity
from lyra_petsc.meshing.files import culprits
from lyra_petsc.meshing.grids import GridSource, grid_sheet, grid_vertices
from lyra_petsc.meshing.groups import GroupTable
from lyra_petsc.meshing.layout import lay_out
from lyra_petsc.meshing.mesh import Mesh, Source
from lyra_petsc.meshing.orientation import NotOrientableError, reversed_triangles
from lyra_petsc.meshing.sheet import Sheet
from lyra_petsc.meshing.transform import Transform, moved, scaled
from lyra_petsc.meshing.validate import check_shape, check_topology


class MeshSource(Protocol):
    """One entry of a scene's ``mesh``: a file or a grid, and where it is put."""

    @property
    def file(self) -> Path | None: ...
    @property
    def grid(self) -> GridSource | None: ...
    @property
    def size(self) -> float | None: ...
    @property
    def transform(self) -> Transform | None: ...
    @property
    def name(self) -> str | None: ...


@dataclass
class _Piece:
    """A source ready to be joined; arrays as in Mesh, numbered within the source."""

    positions: NDArray[np.float64]
    rest: NDArray[np.float64]
    triangles: NDArray[np.int64]
    triangle_uv: NDArray[np.float64]
    with_uv: bool
    seams: bool


def build_mesh(sources: Sequence[MeshSource], *, file: object | None = None) -> Mesh:
    """Read, transform, check and join the mesh sources of a scene.

    Vertices are numbered consecutively over the sources, in file order within each. Groups: a named
    source is a surface group of its name; its own groups are found by their names, where those of equal
    name in several sources are one group, and as ``source.group``. Where one name stands for groups of
    different dimension, the surface (else the curve) keeps it and the others become ``name.curve`` and
    ``name.point``, with a note.

    Rest shape: with ``vt`` those, in metres, whatever the transform; without, the mesh after scaling.

    Parameters
    ----------
    sources : sequence of MeshSource
    file : optional
        The scene file, for messages about keys.

    Raises
    ------
    InputError
        Whatever cannot be read or simulated; names the mesh file, or the scene's key.
    """
    if len(sources) == 0:
        raise InputError("a mesh needs at least one source: file or grid", file=file, key="mesh")
    groups = GroupTable()
    pieces: list[_Piece] = []
    notes: list[str] = []
    names: set[str] = set()
    listed: list[Source] = []
    tags: list[NDArray[np.int64]] = []
    n_vertices = n_triangles = 0
    for number, source in enumerate(sources):
        key = "mesh" if len(sources) == 1 else f"mesh[{number}]"
        if source.name is not None and source.name in names:
            raise InputError(f"'{source.name}' names an earlier source too", file=file, key=f"{key}.name")
        names |= {source.name} if source.name is not None else set()
        if source.grid is not None:
            check_capacity(n_vertices + grid_vertices(source.grid), file=file, key=f"{key}.grid")
        try:
            sheet = _read(source, key, file)
            piece = _prepare(sheet, source, key, file)
        except MemoryError:
            raise InputError("the mesh does not fit into memory", file=source.file or file, key=key) from None
        label = source.name or (Path(source.file).name if source.file is not None else "grid")
        notes += [f"{label}: {note}" for note in sheet.notes]
        groups.add(sheet.groups, source.name, len(piece.triangles), n_vertices, n_triangles)
        pieces.append(piece)
        listed.append(Source(label, len(piece.positions), len(piece.triangles)))
        tags.append(np.zeros(len(piece.positions), np.int64) if sheet.tags is None else sheet.tags)
        n_vertices += len(piece.positions)
        n_triangles += len(piece.triangles)
    mesh = _join(pieces)
    mesh.groups, group_notes = groups.finish(mesh.triangles)
    mesh.notes = notes + group_notes
    mesh.sources = listed
    mesh.tags = np.concatenate(tags) if any(each.any() for each in tags) else None
    return mesh


def _read(source: MeshSource, key: str, file: object | None) -> Sheet:
    if (source.file is None) == (source.grid is None):
        raise InputError("give one of file and grid", file=file, key=key)
    if source.size is not None and (
        source.grid is not None or Path(str(source.file)).suffix.lower() != ".geo"
    ):
        raise InputError("an element size is for .geo files only", file=file, key=f"{key}.size")
    if source.grid is not None:
        return grid_sheet(source.grid, key=f"{key}.grid", file=file)
    path = Path(str(source.file))
    suffix = path.suffix.lower()
    if suffix == ".geo":
        from lyra_petsc.meshing.geo import mesh_geo

        return mesh_geo(path, source.size, key=key, file=file)
    if suffix == ".msh":
        from lyra_petsc.meshing.msh import read_msh

        return read_msh(path)
    if suffix == ".obj":
        from lyra_petsc.meshing.obj import read_obj

        return read_obj(path)
    raise InputError(f"unknown kind of mesh file '{suffix}'; .geo, .msh and .obj are read", file=path)


def _prepare(sheet: Sheet, source: MeshSource, key: str, file: object | None) -> _Piece:
    # a grid has no file of its own: its mistakes are the scene's
    where = {"file": source.file} if source.file is not None else {"file": file, "key": f"{key}.grid"}
    check_topology(sheet, **where)
    _orient(sheet, **where)
    rest = scaled(sheet.points, source.transform, key=key, file=file)
    positions = moved(rest, source.transform, key=key, file=file)
    uv, seams = sheet.uv, False
    if uv is not None:
        check_shape(uv, "rest", **where)
        flat = np.zeros_like(rest)
        flat[sheet.triangles.reshape(-1), :2] = uv.reshape(-1, 2)
        seams = bool((flat[sheet.triangles][:, :, :2] != uv).any())
        rest = rest if seams else flat
    else:
        check_shape(rest[sheet.triangles], "rest", **where)
        uv = lay_out(rest, sheet.triangles)
    check_shape(positions[sheet.triangles], "start", **where)
    return _Piece(positions, rest, sheet.triangles, uv, sheet.uv is not None, seams)


def _orient(sheet: Sheet, *, file: object | None, key: str | None = None) -> None:
    """Turn triangles over until neighbours agree."""
    try:
        turned = reversed_triangles(sheet.triangles)
    except NotOrientableError as error:
        pairs = [f"{one}-{other}" for one, other in error.triangles.tolist()]
        raise InputError(
            "the surface has one side only (a Möbius strip): cut it where triangles "
            f"{culprits(pairs)} meet (counted from 0)",
            file=file,
            key=key,
        ) from None
    if not turned.any():
        return
    sheet.triangles = sheet.triangles.copy()
    sheet.triangles[turned] = sheet.triangles[turned][:, [0, 2, 1]]
    if sheet.uv is not None:
        sheet.uv = sheet.uv.copy()
        sheet.uv[turned] = sheet.uv[turned][:, [0, 2, 1]]
    sheet.notes.append(
        f"{int(turned.sum())} of {len(turned)} triangles turned over so that all are oriented alike"
    )


def _join(pieces: list[_Piece]) -> Mesh:
    offsets = np.cumsum([0] + [len(piece.positions) for piece in pieces])
    return Mesh(
        positions=np.concatenate([piece.positions for piece in pieces]),
        rest=np.concatenate([piece.rest for piece in pieces]),
        triangles=np.concatenate(
            [piece.triangles + offset for piece, offset in zip(pieces, offsets, strict=False)]
        ),
        triangle_uv=np.concatenate([piece.triangle_uv for piece in pieces]),
        flat_rest=np.concatenate([np.full(len(piece.triangles), piece.with_uv) for piece in pieces]),
        has_seams=any(piece.seams for piece in pieces),
        has_uv=any(piece.with_uv for piece in pieces),
    )
