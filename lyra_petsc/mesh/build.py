"""From the mesh sources of a scene to one checked mesh; serial, for rank 0."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.capacity import check_capacity
from lyra_petsc.mesh.grids import grid_sheet, grid_vertices
from lyra_petsc.mesh.groups import GroupTable
from lyra_petsc.mesh.measures import lay_out
from lyra_petsc.mesh.mesh import Mesh, Sheet, Source, TriangleSurface
from lyra_petsc.mesh.orientation import orient
from lyra_petsc.mesh.validate import check_shape, check_topology
from lyra_petsc.scene.schema import MeshSource, Rotation, Scene, Transform


def mesh_of(scene: Scene, tell: Callable[[str], None] | None = None) -> Mesh:
    """`build_mesh` of a scene's sources, with its obstacles; scripts are trusted if the scene's are."""
    mesh = build_mesh(scene.mesh, file=scene.source, trust_scripts=scene.trusts_meshes, tell=tell)
    for name, obstacle in (scene.obstacles or {}).items():
        if obstacle.mesh is not None:
            source = MeshSource(file=obstacle.mesh.file, transform=obstacle.mesh.transform)
            mesh.obstacles[name], notes = _surface(source, scene.trusts_meshes, tell)
            mesh.notes += [f"obstacle {name}: {note}" for note in notes]
    return mesh


def _surface(
    source: MeshSource, trust_scripts: bool, tell: Callable[[str], None] | None
) -> tuple[TriangleSurface, list[str]]:
    """The surface of an obstacle at t = 0, without unused points, and the notes of the reader of its file."""
    try:
        sheet = _read(source, trust_scripts, tell)
        used, numbers = np.unique(sheet.triangles, return_inverse=True)
        whole = Sheet(sheet.points[used], numbers.reshape(-1, 3).astype(np.int64))
        check_topology(whole, file=source.file)
        _, points = _placed(whole.points, source.transform)
        check_shape(points[whole.triangles], "start", file=source.file)
    except MemoryError:
        raise InputError("the mesh does not fit into memory", file=source.file) from None
    return TriangleSurface(points, whole.triangles), sheet.notes


def _placed(points: NDArray[np.float64], transform: Transform) -> tuple[NDArray[np.float64], ...]:
    """Points (n, 3) [m] after the scaling, and after the whole transform."""
    scaled = points * np.asarray(transform.scale)
    turned = scaled if transform.rotate is None else scaled @ _rotation_matrix(transform.rotate).T
    return scaled, turned + np.asarray(transform.translate)


def build_mesh(
    sources: Sequence[MeshSource],
    *,
    file: object | None = None,
    trust_scripts: bool = False,
    tell: Callable[[str], None] | None = None,
) -> Mesh:
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
    trust_scripts : bool
        Give gmsh its scripts as they are, whatever they say.
    tell : callable, optional
        Called with a line now and then while gmsh is at work.

    Raises
    ------
    InputError
        Whatever cannot be read or simulated; names the mesh file, or the scene's key.
    """
    groups = GroupTable()
    pieces: list[Mesh] = []
    notes: list[str] = []
    listed: list[Source] = []
    tags: list[NDArray[np.int64]] = []
    n_vertices = n_triangles = 0
    for number, source in enumerate(sources):
        key = "mesh" if len(sources) == 1 else f"mesh[{number}]"
        if source.grid is not None:
            check_capacity(n_vertices + grid_vertices(source.grid), file=file, key=f"{key}.grid")
        try:
            sheet = _read(source, trust_scripts, tell)
            piece = _prepare(sheet, source, key, file)
        except MemoryError:
            raise InputError("the mesh does not fit into memory", file=source.file or file, key=key) from None
        label = source.name or (source.file.name if source.file is not None else "grid")
        notes += [f"{label}: {note}" for note in sheet.notes]
        groups.add(sheet.groups, source.name, piece.n_triangles, n_vertices, n_triangles)
        pieces.append(piece)
        listed.append(Source(label, piece.n_vertices, piece.n_triangles))
        tags.append(np.zeros(piece.n_vertices, np.int64) if sheet.tags is None else sheet.tags)
        n_vertices += piece.n_vertices
        n_triangles += piece.n_triangles
    mesh = _join(pieces)
    mesh.groups, group_notes = groups.finish(mesh.triangles)
    mesh.notes = notes + group_notes
    mesh.sources = listed
    mesh.tags = np.concatenate(tags) if any(each.any() for each in tags) else None
    return mesh


def _read(source: MeshSource, trust_scripts: bool, tell: Callable[[str], None] | None) -> Sheet:
    if source.grid is not None:
        return grid_sheet(source.grid)
    assert source.file is not None
    suffix = source.file.suffix.lower()
    if suffix == ".geo":
        from lyra_petsc.mesh.geo_file import mesh_geo

        return mesh_geo(
            source.file, source.size, algorithm=source.algorithm, trusted=trust_scripts, tell=tell
        )
    if suffix == ".msh":
        from lyra_petsc.mesh.msh_file import read_msh

        return read_msh(source.file)
    from lyra_petsc.mesh.obj_file import read_obj

    return read_obj(source.file)


def _prepare(sheet: Sheet, source: MeshSource, key: str, file: object | None) -> Mesh:
    # a grid has no file of its own: its mistakes are the scene's
    where = {"file": source.file} if source.file is not None else {"file": file, "key": f"{key}.grid"}
    check_topology(sheet, **where)
    orient(sheet, **where)
    rest, positions = _placed(sheet.points, source.transform)
    uv, seams = sheet.uv, False
    if uv is not None:
        check_shape(uv, "rest", **where)
        laid = np.zeros_like(rest)
        laid[sheet.triangles.reshape(-1), :2] = uv.reshape(-1, 2)
        seams = bool((laid[sheet.triangles][:, :, :2] != uv).any())
        rest = rest if seams else laid
    else:
        check_shape(rest[sheet.triangles], "rest", **where)
        uv = lay_out(rest, sheet.triangles)
    check_shape(positions[sheet.triangles], "start", **where)
    with_uv = sheet.uv is not None
    flat = np.full(len(sheet.triangles), with_uv)
    return Mesh(positions, rest, sheet.triangles, uv, flat, has_seams=seams, has_uv=with_uv)


def _join(pieces: list[Mesh]) -> Mesh:
    first = np.cumsum([0, *(piece.n_vertices for piece in pieces)])
    triangles = [piece.triangles + offset for piece, offset in zip(pieces, first, strict=False)]
    return Mesh(
        np.concatenate([piece.positions for piece in pieces]),
        np.concatenate([piece.rest for piece in pieces]),
        np.concatenate(triangles),
        np.concatenate([piece.triangle_uv for piece in pieces]),
        np.concatenate([piece.flat_rest for piece in pieces]),
        has_seams=any(piece.has_seams for piece in pieces),
        has_uv=any(piece.has_uv for piece in pieces),
    )


def _rotation_matrix(rotation: Rotation) -> NDArray[np.float64]:
    """Right-handed rotation matrix (3, 3); exact for multiples of 90° about x, y or z."""
    direction = np.asarray(rotation.axis)
    direction = direction / np.abs(direction).max()
    direction /= np.linalg.norm(direction)
    quarter, rest = divmod(rotation.degrees, 90.0)
    if rest == 0.0:
        # cos 90° is 6e-17 in floating point: a sheet turned upright would no longer be flat
        cosine, sine = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarter % 4)]
    else:
        cosine, sine = math.cos(math.radians(rotation.degrees)), math.sin(math.radians(rotation.degrees))
    x, y, z = direction
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix: NDArray[np.float64] = (
        cosine * np.eye(3) + sine * cross + (1.0 - cosine) * np.outer(direction, direction)
    )
    return matrix
