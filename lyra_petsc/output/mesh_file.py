"""mesh.h5: the mesh, groups and obstacle surfaces, which all states of a run share."""

from __future__ import annotations

import os
from collections.abc import Iterable
from itertools import starmap
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.mesh import Group, Mesh
from lyra_petsc.output.hdf5 import create_file
from lyra_petsc.output.layout import MESH_FILE
from lyra_petsc.output.stored import SUM, StoredMesh, check_sum
from lyra_petsc.parallel import on_root

ROUNDING = 1e-9
"""Allowed rounding differences of coordinates between machines, relative to the size of the mesh."""

GROUP_ARRAYS = ("vertices", "edges", "triangles")


def write_mesh(folder: str | os.PathLike[str], mesh: Mesh | None, comm: MPI.Comm) -> None:
    """Write ``mesh.h5`` from the mesh on rank 0. Collective.

    ``/mesh/triangles`` (F, 3) int64, ``/mesh/rest`` (V, 3) [m] and the material coordinates
    [m]: ``/mesh/uv`` (V, 2) where each vertex has one, else ``/mesh/corner_uv`` (F, 3, 2).
    The attribute ``vt`` of ``/mesh`` is 1 if they came with the mesh, as texture coordinates.
    For `check_same_mesh` also ``/start`` (V, 3), the start positions [m]; for each group
    ``/groups/<number>`` with an attribute ``name`` and its non-empty arrays ``vertices`` (n,),
    ``edges`` (k, 2) and ``triangles`` (m,); for each obstacle that is a mesh ``/obstacles/<number>``
    with an attribute ``name``, ``points`` (n, 3) [m] at t = 0 and ``triangles`` (m, 3).
    Frames have groups ``/frames/<number>`` with an attribute ``key``, ``time`` (T,) [s] and check sums
    ``sums`` (T,). Lengths have an attribute ``units``.

    Parameters
    ----------
    folder : path
        The run's folder.
    mesh : Mesh or None
        Needed on rank 0 only.
    comm : MPI.Comm
        All ranks.

    Raises
    ------
    OutputError
        On every rank, if it could not be written.
    """

    def work() -> None:
        assert mesh is not None
        datasets = _arrays(mesh)
        names: dict[str, dict[str, int | float | str | np.uint64]] = {"mesh": {"vt": int(mesh.has_uv)}}
        for number, (name, group) in enumerate(mesh.groups.items()):
            names[f"groups/{number}"] = {"name": name}
            parts = _group_arrays(group)
            datasets |= {f"groups/{number}/{part}": rows for part, rows in parts.items() if len(rows)}
        for number, (name, surface) in enumerate(mesh.obstacles.items()):
            names[f"obstacles/{number}"] = {"name": name}
            datasets |= {f"obstacles/{number}/{part}": rows for part, rows in surface._asdict().items()}
        for number, (key, frames) in enumerate(mesh.frames.items()):
            names[f"frames/{number}"] = {"key": key}
            datasets |= {f"frames/{number}/{part}": rows for part, rows in frames._asdict().items()}
        names |= {name: {SUM: np.uint64(check_sum(rows))} for name, rows in datasets.items()}
        for name, rows in datasets.items():
            if rows.dtype.kind == "f":  # the others are numbers of vertices and triangles, and sums
                names[name]["units"] = "s" if name.endswith("time") else "m"
        create_file(Path(folder) / MESH_FILE, datasets, names)

    on_root(comm, work)


def vertex_uv(mesh: Mesh) -> Array | None:
    """(V, 2) material coordinates [m], or ``None`` if a vertex has several."""
    uv = np.zeros((mesh.n_vertices, 2))
    uv[mesh.triangles] = mesh.triangle_uv
    return uv if np.array_equal(uv[mesh.triangles], mesh.triangle_uv) else None


def check_same_mesh(
    folder: str | os.PathLike[str], mesh: Mesh | None, groups: Iterable[str], comm: MPI.Comm
) -> None:
    """Check that the scene's mesh is the one that the run was begun with. Collective.

    Parameters
    ----------
    folder : path
        The run's folder, with its ``mesh.h5``.
    mesh : Mesh or None
        The scene's mesh; needed on rank 0 only.
    groups : iterable of str
        Names of the groups that the scene uses.
    comm : MPI.Comm
        All ranks.

    Raises
    ------
    InputError
        On every rank, if the meshes differ or ``mesh.h5`` cannot be read.
    """
    file = Path(folder) / MESH_FILE

    def work() -> None:
        assert mesh is not None
        try:
            difference = _difference(StoredMesh(file.parent), mesh, set(groups))
        except InputError as error:
            raise InputError(
                f"{error.message}, so nothing shows that the mesh is still the same: "
                "put it back, or run without --resume",
                file=file,
            ) from error
        if difference:
            raise InputError(
                f"the scene's mesh is not the one that the run was begun with: {difference}; "
                "give that one, or run without --resume into a new folder",
                file=file,
                key="mesh",
            )

    on_root(comm, work)


def frame_changes(folder: str | os.PathLike[str], mesh: Mesh | None) -> list[str]:
    """Texts on the frames of a scene that are others than when the run was begun; call on rank 0.

    Raises
    ------
    InputError
        If ``mesh.h5`` cannot be read.
    """
    assert mesh is not None
    stored, texts = StoredMesh(Path(folder)).frames if mesh.frames else {}, []
    for key in stored.keys() & mesh.frames.keys():
        (times, sums), (times_now, sums_now) = stored[key], mesh.frames[key]
        common = min(len(times), len(times_now))
        differs = (times[:common] != times_now[:common]) | (sums[:common] != sums_now[:common])
        first = int(np.argmax(differs)) if differs.any() else common
        if first < max(len(times), len(times_now)):
            longer = times if first >= len(times_now) else times_now
            texts.append(f"{key}: other frames from number {first} (t = {longer[first]:g} s) on")
    return sorted(texts)


def _arrays(mesh: Mesh) -> dict[str, NDArray[Any]]:
    uv = vertex_uv(mesh)
    material = {"mesh/corner_uv": mesh.triangle_uv} if uv is None else {"mesh/uv": uv}
    return {
        "mesh/triangles": mesh.triangles,
        "mesh/rest": mesh.rest,
        **material,
        "start": mesh.positions,
    }


def _group_arrays(group: Group) -> dict[str, Ints]:
    return {part: getattr(group, part) for part in GROUP_ARRAYS}


def _difference(stored: StoredMesh, mesh: Mesh, used: set[str]) -> str:
    """A text that names the first difference between a mesh and the stored one; empty if they agree."""
    counts = len(stored.rest), len(stored.triangles)
    if counts != (mesh.n_vertices, mesh.n_triangles):
        now = f"{mesh.n_vertices} vertices and {mesh.n_triangles} triangles"
        return f"it has {now}, not {counts[0]} and {counts[1]}"
    size = _extent(mesh.rest) + _extent(mesh.positions)
    agreement = {
        "other triangles": np.array_equal(stored.triangles, mesh.triangles),
        "another shape at rest": _agree(stored.rest, mesh.rest, size),
        "another shape at the start": _agree(stored.start, mesh.positions, size),
        "other material coordinates": _agree(stored.corner_uv, mesh.triangle_uv, size),
    }
    for name, group in stored.groups.items():
        if name in used and name in mesh.groups:
            pairs = zip(_group_arrays(group).values(), _group_arrays(mesh.groups[name]).values(), strict=True)
            agreement[f"group {name!r} has other members"] = all(starmap(np.array_equal, pairs))
    obstacles = stored.obstacles if mesh.obstacles else {}
    for name, surface in mesh.obstacles.items():
        agreement[f"obstacle {name!r} is another mesh"] = (
            name in obstacles
            and np.array_equal(obstacles[name].triangles, surface.triangles)
            and _agree(obstacles[name].points, surface.points, _extent(surface.points))
        )
    return next((difference for difference, agrees in agreement.items() if not agrees), "")


def _extent(points: Array) -> float:
    return float(np.abs(points).max(initial=0.0))


def _agree(before: Array, after: Array, size: float) -> bool:
    return before.shape == after.shape and np.allclose(before, after, rtol=0.0, atol=ROUNDING * size)
