"""Build one checked mesh from the mesh sources of a scene (files and grids), on rank 0.

Meshes that cannot be simulated are refused; the messages give the numbers of vertices and triangles.
Triangles are oriented consistently: neighbours traverse their common edge in opposite directions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.capacity import check_capacity
from lyra_petsc.mesh.measures import SAME_PLACE, SCALE_RATIO, plane_coordinates
from lyra_petsc.mesh.mesh import FrameSums, Group, Mesh, NamedSet, Sheet, Source, TriangleSurface
from lyra_petsc.mesh.readers import first_few
from lyra_petsc.mesh.select import DIMENSION_NAMES
from lyra_petsc.mesh.topology import connected_components, connected_pieces, edge_table
from lyra_petsc.mesh.weld import coincident_with, weld
from lyra_petsc.scene.schema import Grid, MeshSource, Obstacle, Rotation, Scene, Transform

# A triangle is degenerate if twice its area is below this fraction of its longest side squared. Slivers of
# aspect ratio 1e9 pass; three points on a line do not, despite their round-off.
_FLATNESS = 1e-10


def check_topology(sheet: Sheet, *, file: object | None, key: str | None = None) -> None:
    """Refuse a mesh that is not a surface.

    Raises
    ------
    InputError
        No triangles, non-finite coordinates, a triangle that uses a vertex twice, or duplicate triangles.
        Triangles and vertices are counted from 0 in file order, quads as two triangles.
    """

    def refuse(message: str) -> None:
        raise InputError(message, file=file, key=key)

    triangles = sheet.triangles
    if len(triangles) == 0:
        refuse("the mesh has no triangles")
    if (bad := np.flatnonzero(~np.isfinite(sheet.points).all(axis=1))).size:
        refuse(f"coordinates that are not finite: vertices {first_few(bad.tolist())} (counted from 0)")
    if sheet.uv is not None and (bad := np.flatnonzero(~np.isfinite(sheet.uv).all(axis=(1, 2)))).size:
        refuse(f"vt that are not finite: triangles {first_few(bad.tolist())} (counted from 0)")
    if (bad := np.flatnonzero((triangles == np.roll(triangles, 1, axis=1)).any(axis=1))).size:
        refuse(f"degenerate triangles (a vertex used twice): {first_few(bad.tolist())} (counted from 0)")
    if (bad := _duplicates(triangles)).size:
        refuse(f"triangles that repeat another one: {first_few(bad.tolist())} (counted from 0)")


def check_shape(
    corners: Array, shape: str, *, file: object | None, key: str | None = None, remedy: str = ""
) -> None:
    """Refuse triangles without area.

    Parameters
    ----------
    corners : (F, 3, d) float64
        Corners of the triangles [m], d = 2 or 3.
    shape, remedy : str
        ``rest`` or ``start``, and what to do about it, for the message.

    Raises
    ------
    InputError
        Triangles whose area is zero up to round-off, or overflows.
    """
    with np.errstate(all="ignore"):
        a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        longest = np.sqrt(np.maximum(np.maximum((a * a).sum(1), (b * b).sum(1)), ((b - a) ** 2).sum(1)))
        if corners.shape[2] == 2:
            double_area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        else:
            double_area = np.linalg.norm(np.cross(a, b), axis=1)
        # far from the origin the round-off of the coordinates gives collinear points some area
        noise = 16 * np.finfo(np.float64).eps * np.abs(corners).max(axis=(1, 2)) * longest
        flat = double_area <= np.maximum(_FLATNESS * longest**2, noise)
    for wrong, text in (
        (~np.isfinite(double_area), f"triangles too large to compute in the {shape} shape"),
        (flat, f"degenerate triangles (no area in the {shape} shape)"),
    ):
        if wrong.any():
            numbers = first_few(np.flatnonzero(wrong).tolist())
            raise InputError(f"{text}: {numbers} (counted from 0){remedy}", file=file, key=key)


def _duplicates(triangles: Ints) -> Ints:
    """Triangles with the same three vertices as an earlier triangle, ascending."""
    corners = np.sort(triangles, axis=1)
    order = np.lexsort(corners.T[::-1])
    same = (corners[order][1:] == corners[order][:-1]).all(axis=1)
    return np.sort(order[1:][same])


def orient(sheet: Sheet, *, file: object | None, key: str | None = None) -> None:
    """Orient the triangles of each connected component consistently by reversing some, with a note.

    In each component the majority keeps its orientation; in a tie the first triangle does.

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
    # sides that start at the same vertex belong to triangles of opposite orientation
    disagree = corner[first] == corner[second]
    if not disagree.any():
        return
    n, one, other = len(sheet.triangles), first // 3, second // 3
    # a triangle is two nodes, t as it is and n + t reversed; links join those of equal orientation
    swap = np.where(disagree, n, 0)
    links = [np.stack([one, other + swap], axis=1), np.stack([one + n, other + n - swap], axis=1)]
    as_is, reversed_ = connected_components(2 * n, np.concatenate(links)).reshape(2, n)
    if (cut := disagree & (as_is == reversed_)[one]).any():
        shown = first_few(f"{a}-{b}" for a, b in zip(one[cut], other[cut], strict=True))
        raise InputError(
            f"the surface has one side only (a Möbius strip): cut it where triangles {shown} meet "
            "(counted from 0)",
            file=file,
            key=key,
        )
    # each component has the lowest number of its nodes: that of the first triangle, as it is
    turned = as_is > reversed_
    component = np.minimum(as_is, reversed_)
    turned ^= (2 * np.bincount(component, turned) > np.bincount(component))[component]
    sheet.triangles = sheet.triangles.copy()
    sheet.triangles[turned] = sheet.triangles[turned][:, [0, 2, 1]]
    if sheet.uv is not None:
        sheet.uv = sheet.uv.copy()
        sheet.uv[turned] = sheet.uv[turned][:, [0, 2, 1]]
    sheet.notes.append(
        f"{int(turned.sum())} of {len(turned)} triangles reversed for a consistent orientation"
    )


def grid_sheet(grid: Grid) -> Sheet:
    """Triangles of an nx × ny grid of cells, from the origin to (width, height, 0).

    Vertex ``j (nx + 1) + i`` is at column i, row j. The pattern ``diagonal`` joins (i, j) to (i+1, j+1);
    ``alternating`` takes the other diagonal where i + j is odd; ``criss-cross`` adds the centre of cell
    (i, j) as vertex ``(nx + 1)(ny + 1) + j nx + i``. All triangles are anticlockwise seen from +z; those of
    a cell are consecutive. Groups: surface ``sheet``, curves ``left``, ``right``, ``bottom``, ``top``, points
    ``corners``.
    """
    nx, ny = grid.nx, grid.ny
    points = _lattice_points(nx, ny, grid.width, grid.height)
    low_left = (np.arange(ny)[:, None] * (nx + 1) + np.arange(nx)[None, :]).reshape(-1)
    cell = np.stack([low_left, low_left + 1, low_left + nx + 2, low_left + nx + 1], axis=1)
    if grid.pattern == "criss-cross":
        points = np.concatenate([points, points[cell[:, [0, 2]]].mean(axis=1)])
        centre = np.arange(nx * ny) + (nx + 1) * (ny + 1)
        triangles = np.stack(
            [np.stack([cell[:, k], cell[:, (k + 1) % 4], centre], axis=1) for k in range(4)], axis=1
        )
    else:
        column, row = np.arange(nx)[None, :], np.arange(ny)[:, None]
        flipped = ((column + row) % 2 == 1).reshape(-1) & (grid.pattern == "alternating")
        triangles = np.where(
            flipped[:, None, None],
            cell[:, [[0, 1, 3], [1, 2, 3]]],
            cell[:, [[0, 1, 2], [0, 2, 3]]],
        )
    triangles = np.ascontiguousarray(triangles.reshape(-1, 3), dtype=np.int64)
    return Sheet(points, triangles, groups=_grid_groups(nx, ny, len(triangles)))


def count_grid_vertices(grid: Grid) -> int:
    """Number of vertices of a grid."""
    nx, ny = grid.nx, grid.ny
    return (nx + 1) * (ny + 1) + (nx * ny if grid.pattern == "criss-cross" else 0)


def _lattice_points(nx: int, ny: int, width: float, height: float) -> Array:
    points = np.zeros(((nx + 1) * (ny + 1), 3))
    points[:, 0] = np.tile(np.linspace(0.0, width, nx + 1), ny + 1)
    points[:, 1] = np.repeat(np.linspace(0.0, height, ny + 1), nx + 1)
    return points


def _grid_groups(nx: int, ny: int, n_triangles: int) -> list[NamedSet]:
    across, up = np.arange(nx + 1, dtype=np.int64), np.arange(ny + 1, dtype=np.int64) * (nx + 1)
    chains = {"left": up, "right": up + nx, "bottom": across, "top": across + ny * (nx + 1)}
    groups = [NamedSet("sheet", 2, np.arange(n_triangles, dtype=np.int64))]
    for name, chain in chains.items():
        groups.append(NamedSet(name, 1, np.stack([chain[:-1], chain[1:]], axis=1)))
    groups.append(NamedSet("corners", 0, np.array([0, nx, up[-1], up[-1] + nx], dtype=np.int64)))
    return groups


Members = dict[tuple[str, int], list[Ints]]
"""Members of the groups of the whole mesh by name and dimension, one array for each source."""


def _add_groups(
    members: Members, groups: list[NamedSet], source: str | None, n_triangles: int, first: tuple[int, int]
) -> None:
    """Add the groups of a source to ``members``; ``first``: numbers of its first vertex and triangle."""
    named = [(group.name, group.dimension, group.members + first[group.dimension == 2]) for group in groups]
    if source is not None:
        named += [(f"{source}/{name}", dimension, numbers) for name, dimension, numbers in named]
        named.append((source, 2, np.arange(first[1], first[1] + n_triangles, dtype=np.int64)))
    for name, dimension, numbers in named:
        members.setdefault((name, dimension), []).append(numbers)


def _named_groups(members: Members, triangles: Ints) -> tuple[dict[str, Group], list[str]]:
    """Groups by unique name, and a note for each group that was renamed; ``triangles`` (F, 3)."""
    groups: dict[str, Group] = {}
    notes: list[str] = []
    # surfaces come first and keep the name, as materials are assigned by surface groups only
    for name, dimension in sorted(members, key=lambda entry: -entry[1]):
        unique, kind = name, DIMENSION_NAMES[dimension]
        while unique in groups:
            unique = f"{unique}.{kind}"
        if unique != name:
            notes.append(
                f"group '{name}' is used for several dimensions; that of {kind}s is called '{unique}'"
            )
        groups[unique] = _group(dimension, np.concatenate(members[name, dimension]), triangles)
    return groups, notes


def _group(dimension: int, members: Ints, triangles: Ints) -> Group:
    no_triangles, no_edges = np.empty(0, dtype=np.int64), np.empty((0, 2), dtype=np.int64)
    if dimension == 2:
        inside = np.unique(members)
        return Group(2, np.unique(triangles[inside]), inside, no_edges)
    if dimension == 1:
        edges = np.unique(np.sort(members, axis=1), axis=0)
        return Group(1, np.unique(edges), no_triangles, edges)
    return Group(0, np.unique(members), no_triangles, no_edges)


def build_scene_mesh(scene: Scene, report: Callable[[str], None] | None = None) -> Mesh:
    """The mesh of a scene's sheets (`build_mesh`), with the surfaces of its obstacles."""
    sewn = None
    if scene.seams:
        from lyra_petsc.mesh.seams import join_seams  # only scenes with seams need it

        sewn = partial(join_seams, scene)
    mesh = build_mesh(
        scene.mesh, file=scene.source, trust_scripts=scene.trusts_meshes, report=report, sewn=sewn
    )
    for name, obstacle in (scene.obstacles or {}).items():
        if obstacle.mesh is not None:
            source = MeshSource(file=obstacle.mesh.file, transform=obstacle.mesh.transform)
            mesh.obstacles[name], notes = _read_surface(source, scene.trusts_meshes, report)
            mesh.notes += [f"obstacle {name}: {note}" for note in notes]
            if obstacle.mesh.frames is not None:
                frames = _frames_at_start(mesh.obstacles[name], obstacle)
                mesh.obstacles[name], mesh.frames[f"obstacles.{name}.mesh.frames"] = frames
    return mesh


def _frames_at_start(surface: TriangleSurface, obstacle: Obstacle) -> tuple[TriangleSurface, FrameSums]:
    """The surface of an obstacle as its frames have it at t = 0; and what the frames are, all checked."""
    from lyra_petsc.mesh.frame_files import check_frames  # with frames only
    from lyra_petsc.mesh.obstacles import surface_motion

    assert obstacle.mesh is not None
    motion = surface_motion(obstacle)
    of = f"{obstacle.mesh.file.name}, of which it holds places, has"
    sums = check_frames(motion.frames, (len(surface.points),), of)
    return surface._replace(points=motion.positions(0.0)), sums


def _read_surface(
    source: MeshSource, trust_scripts: bool, report: Callable[[str], None] | None
) -> tuple[TriangleSurface, list[str]]:
    """The surface of an obstacle at t = 0, without unused points, and the notes of its file's reader."""
    try:
        sheet = _read(source, trust_scripts, report)
        sheet.uv = None
        check_topology(sheet, file=source.file)
        _, points = transformed(sheet.points, source.transform)
        check_shape(points[sheet.triangles], "start", file=source.file)
    except MemoryError:
        raise InputError("the mesh does not fit into memory", file=source.file) from None
    return TriangleSurface(points, sheet.triangles), sheet.notes


def transformed(points: Array, transform: Transform) -> tuple[Array, ...]:
    """Points (n, 3) [m] after the scaling, and after the whole transform."""
    scaled = points * np.asarray(transform.scale)
    turned = scaled if transform.rotate is None else scaled @ _rotation_matrix(transform.rotate).T
    return scaled, turned + np.asarray(transform.translate)


def build_mesh(
    sources: Sequence[MeshSource],
    *,
    file: object | None = None,
    trust_scripts: bool = False,
    report: Callable[[str], None] | None = None,
    sewn: Callable[[Mesh], Mesh] | None = None,
) -> Mesh:
    """Read, transform, check and join the mesh sources of a scene.

    Vertices are numbered consecutively over the sources, in file order within each source. A named source
    is a surface group of its name; its own groups can also be called ``source/group``. Groups of equal name
    in several sources are one group. Where groups of different dimension have one name, the surface (else
    the curve) keeps it and the others become ``name.curve`` and ``name.point``, with a note.

    The rest shape is given by the ``vt`` [m], without the transform; without ``vt`` it is the scaled mesh.

    Parameters
    ----------
    sources : sequence of MeshSource
    file : optional
        The scene file, for messages about keys.
    trust_scripts : bool
        As ``trusted`` of `library_file.read_by_library`.
    report : callable, optional
        Called with a line of progress at intervals while gmsh works.
    sewn : callable, optional
        Returns the mesh of all sources with its seams.

    Raises
    ------
    InputError
        A mesh cannot be read or simulated; the message names the mesh file, or the key of the scene.
    """
    members: Members = {}
    pieces: list[Mesh] = []
    notes: list[str] = []
    listed: list[Source] = []
    tags: list[Ints] = []
    n_vertices = n_triangles = 0
    for number, source in enumerate(sources):
        key = "mesh" if len(sources) == 1 else f"mesh[{number}]"
        if source.grid is not None:
            check_capacity(n_vertices + count_grid_vertices(source.grid), file=file, key=f"{key}.grid")
        try:
            sheet = _read(source, trust_scripts, report)
            piece = _check_and_transform(sheet, source, key, file)
        except MemoryError:
            raise InputError(
                "the mesh does not fit into memory", file=source.file or source.pattern or file, key=key
            ) from None
        label = source.name or (source.file.name if source.file is not None else "grid")
        notes += [f"{label}: {note}" for note in sheet.notes]
        first = n_vertices, n_triangles
        _add_groups(members, sheet.groups, source.name, piece.n_triangles, first)
        pieces.append(piece)
        listed.append(Source(label, piece.n_vertices, piece.n_triangles))
        tags.append(np.zeros(piece.n_vertices, np.int64) if sheet.tags is None else sheet.tags)
        n_vertices += piece.n_vertices
        n_triangles += piece.n_triangles
    mesh = _join(pieces)
    mesh.groups, group_notes = _named_groups(members, mesh.triangles)
    mesh.sources = listed
    mesh.tags = np.concatenate(tags) if any(numbers.any() for numbers in tags) else None
    mesh.notes = notes + group_notes
    if sewn is not None:
        mesh = sewn(mesh)
        sheet = Sheet(mesh.positions, mesh.triangles, mesh.triangle_uv)
        orient(sheet, file=file, key="seams")
        assert sheet.uv is not None
        mesh = replace(mesh, triangles=sheet.triangles, triangle_uv=sheet.uv)
        mesh.notes += sheet.notes
    mesh.coincident, mesh.unconnected = _coincident(mesh)
    mesh.notes += [mesh.unconnected] * (mesh.unconnected != "")
    return mesh


def _read(source: MeshSource, trust_scripts: bool, report: Callable[[str], None] | None) -> Sheet:
    if source.grid is not None:
        return grid_sheet(source.grid)
    if source.pattern is not None:
        from lyra_petsc.mesh.pattern_panel import read_panel  # only patterns need it

        assert source.panel is not None
        assert source.size is not None
        return read_panel(
            source.pattern, source.panel, source.size, algorithm=source.algorithm, report=report
        )
    assert source.file is not None
    suffix = source.file.suffix.lower()
    if suffix == ".msh":
        from lyra_petsc.mesh.msh_file import read_msh

        return read_msh(source.file)
    if suffix == ".obj":
        from lyra_petsc.mesh.obj_file import read_obj

        return read_obj(source.file)
    from lyra_petsc.mesh.library_file import read_by_library

    return read_by_library(
        source.file, source.size, algorithm=source.algorithm, trusted=trust_scripts, report=report
    )


def _check_and_transform(sheet: Sheet, source: MeshSource, key: str, file: object | None) -> Mesh:
    # a grid has no file: messages name the scene and its key
    read_from = source.file or source.pattern
    where = {"file": read_from} if read_from is not None else {"file": file, "key": f"{key}.grid"}
    check_topology(sheet, **where)
    if source.weld is not None:
        _weld(sheet, source, source.weld, where)
    orient(sheet, **where)
    rest, positions = transformed(sheet.points, source.transform)
    if source.uv is not None and sheet.uv is not None:
        sheet.uv = None if source.uv == "ignore" else sheet.uv * source.uv
    uv = sheet.uv
    if uv is not None:
        remedy = ", which the vt give: mesh: {uv: ignore} takes the mesh itself"
        check_shape(uv, "rest", remedy=remedy, **where)
        sheet.notes += _scale_notes(uv, rest[sheet.triangles])
        laid = np.zeros_like(rest)
        laid[sheet.triangles.reshape(-1), :2] = uv.reshape(-1, 2)
        seams = (laid[sheet.triangles][:, :, :2] != uv).any()
        rest = rest if seams else laid
    else:
        check_shape(rest[sheet.triangles], "rest", **where)
        uv = plane_coordinates(rest, sheet.triangles)
    check_shape(positions[sheet.triangles], "start", **where)
    with_uv = sheet.uv is not None
    flat = np.full(len(sheet.triangles), with_uv)
    return Mesh(positions, rest, sheet.triangles, uv, flat, has_uv=with_uv)


def _weld(sheet: Sheet, source: MeshSource, distance: float, where: dict[str, Any]) -> None:
    """Join coincident vertices of the scaled sheet, with a note."""
    dropped = weld(sheet, transformed(sheet.points, source.transform)[0], distance)
    if not dropped:
        sheet.notes.append(f"no vertices coincide within weld = {distance:g} m")
        return
    triangles = sheet.triangles
    if (bad := np.flatnonzero((triangles == np.roll(triangles, 1, axis=1)).any(axis=1))).size:
        raise InputError(
            f"weld = {distance:g} m joins vertices of one triangle: {first_few(bad.tolist())} (counted from "
            "0); give less",
            **where,
        )
    check_topology(sheet, **where)
    sheet.notes.append(f"{dropped} vertices welded to others; vertices are numbered anew")


def _scale_notes(uv: Array, corners: Array) -> list[str]:
    """A note if lengths by ``uv`` (F, 3, 2) and in space (F, 3, 3) [m] are hardly those of one sheet."""
    pattern, space = (np.linalg.norm(at - np.roll(at, 1, axis=1), axis=2).ravel() for at in (uv, corners))
    with np.errstate(divide="ignore"):
        factor = np.abs(np.log(pattern / space))
    ratio = float(np.exp(factor[np.isfinite(factor)].mean())) if np.isfinite(factor).any() else 1.0
    if ratio <= SCALE_RATIO:
        return []
    return [
        f"edges are {pattern.mean():.3g} m long by vt and {space.mean():.3g} m in space, and differ by a "
        f"factor of {ratio:.2g} in the mean: vt are the rest shape in metres; if these are not, take mesh: "
        "{uv: ignore}, or their scale: mesh: {uv: [width, height]}"
    ]


def _coincident(mesh: Mesh) -> tuple[Ints, str]:
    """`Mesh.coincident` and `Mesh.unconnected`; seams connect vertices."""
    x = mesh.positions
    corners = x[mesh.triangles]
    edge = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())
    same = coincident_with(x, SAME_PLACE * edge)
    sewn = connected_components(len(x), mesh.tied[np.diff(same[mesh.tied], axis=1)[:, 0] == 0])
    others = np.flatnonzero((same != np.arange(len(x))) & (sewn != sewn[same]))
    pairs = np.column_stack([others, same[others]])
    if not len(pairs):
        return pairs, ""
    source = np.repeat(np.arange(len(mesh.sources)), [source.n_vertices for source in mesh.sources])
    remedy = f"mesh: {{weld: {2 * SAME_PLACE * edge:.1g}}} joins them"
    same_source = source[pairs[:, 0]] == source[pairs[:, 1]]
    if not same_source.all():
        remedy += " within one file; put sheets that belong together into one, or move them apart"
    pieces, n = int(connected_pieces(mesh.triangles).max()) + 1, len(pairs)
    verb = "vertex coincides with another one" if n == 1 else "vertices coincide with others"
    return pairs[same_source], (
        f"the mesh is in {pieces} piece{'s' * (pieces > 1)}; {n} {verb} without being connected "
        f"(first: {pairs[0, 0]} and {pairs[0, 1]}): {remedy}"
    )


def _join(pieces: list[Mesh]) -> Mesh:
    first = np.cumsum([0, *(piece.n_vertices for piece in pieces)])
    triangles = [piece.triangles + offset for piece, offset in zip(pieces, first, strict=False)]
    return Mesh(
        np.concatenate([piece.positions for piece in pieces]),
        np.concatenate([piece.rest for piece in pieces]),
        np.concatenate(triangles),
        np.concatenate([piece.triangle_uv for piece in pieces]),
        np.concatenate([piece.flat_rest for piece in pieces]),
        has_uv=any(piece.has_uv for piece in pieces),
    )


def _rotation_matrix(rotation: Rotation) -> Array:
    """Right-handed rotation matrix (3, 3); exact for multiples of 90° about x, y or z."""
    direction = np.asarray(rotation.axis)
    direction = direction / np.abs(direction).max()
    direction /= np.linalg.norm(direction)
    quarter, rest = divmod(rotation.degrees, 90.0)
    if rest == 0.0:
        # cos 90° is 6e-17 in floating point: a sheet rotated by 90° would no longer be flat
        cosine, sine = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarter % 4)]
    else:
        cosine, sine = math.cos(math.radians(rotation.degrees)), math.sin(math.radians(rotation.degrees))
    x, y, z = direction
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return cosine * np.eye(3) + sine * cross + (1.0 - cosine) * np.outer(direction, direction)
