"""States of a run in the formats of other programs: OBJ, PLY, npz, vtkhdf, glTF, USD.

In: a run's folder. Out: a folder of files, which is complete or not there.

Positions are exactly those of the states; vertices and triangles are in the order of the mesh file. Of OBJ
and PLY each state has a file; OBJ is written here, as meshio writes neither all digits nor texture
coordinates with seams. The others hold all states in one file: NumPy's .npz and VTK's .vtkhdf as arrays, glTF
2.0 the first state, a morph target for each further one and an animation, USD a mesh whose points and fields
are sampled over time.
"""

from __future__ import annotations

import csv
import os
import re
import shutil
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError, OutputError, suggest
from lyra_petsc.extras import require_packages
from lyra_petsc.output.agreement import HDF5_ERRORS, reason
from lyra_petsc.output.hdf5 import properties
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.output.run_folder import check_creatable
from lyra_petsc.output.stored import import_h5py
from lyra_petsc.output.tensors import in_vtk_order, is_tensor
from lyra_petsc.output.vtkhdf_file import GROUPS, add_offsets, cells, describe
from lyra_petsc.show.render.render_plan import numbers, pick_state
from lyra_petsc.show.render.sheet_geometry import split_at_seams, vertex_normals

if TYPE_CHECKING:
    from lyra_petsc.show.obstacle_surfaces import ObstacleSurface

OURS = re.compile(r".+(_\d{4,}\.(obj|ply)|\.(glb|usdc|npz|vtkhdf))|times\.csv")
"""Files that an export writes: --force removes no folder that holds others."""


@dataclass(frozen=True)
class ExportFormat:
    """A format, which ``write_<name>`` writes.

    Attributes
    ----------
    packages : tuple of str
        What it needs of the extra ``export``.
    fields : bool
        Whether it holds more than positions.
    sequence : bool
        Whether each state has a file, which does not hold its time.
    """

    packages: tuple[str, ...] = ()
    fields: bool = True
    sequence: bool = False


FORMATS = {
    "obj": ExportFormat(fields=False, sequence=True),
    "ply": ExportFormat(("meshio",), sequence=True),
    "gltf": ExportFormat(("pygltflib",), fields=False),
    "usd": ExportFormat(("pxr",)),
    "vtkhdf": ExportFormat(),
    "npz": ExportFormat(),
}
"""Formats by the names that ``--to`` takes."""


@dataclass(frozen=True)
class Exported:
    """What was written.

    Attributes
    ----------
    folder : Path
    files : tuple of str
        Their names, sorted.
    states : int
    """

    folder: Path
    files: tuple[str, ...]
    states: int


def export_run(
    run: str | Path,
    to: str,
    out: Path | None = None,
    *,
    times: str | None = None,
    every: int | None = None,
    displacement: bool = False,
    force: bool = False,
) -> Exported:
    """Write states of a run in another format.

    Parameters
    ----------
    run : path
        A run's folder.
    to : str
        One of ``FORMATS``.
    out : path, optional
        Else a folder in the run's, with the name of the format.
    times : str, optional
        Numbers [s] with commas between: the states nearest to them.
    every : int, optional
        Every nth state.
    displacement : bool
        Add the displacement from the run's first state as a field.
    force : bool
        Replace a former export.

    Raises
    ------
    InputError
        Bad input; nothing is written.
    OutputError
        If the files cannot be written; nothing is left of them.
    """
    if to not in FORMATS:
        raise InputError(f"unknown format {to!r}, {suggest(to, FORMATS)}", key="--to")
    if displacement and not FORMATS[to].fields:
        able = ", ".join(name for name, form in FORMATS.items() if form.fields)
        raise InputError(f"{to} holds positions alone; take --to {able}", key="--displacement")
    require_packages(f"export --to {to}", FORMATS[to].packages, "export")
    found = StoredRun(run)
    folder = out if out is not None else found.folder / to
    check_folder(folder, force=force)
    states = replace(choose(found, times, every), displacement=displacement)
    # without characters that Windows or a shell treats specially; letters of any script stay
    name = re.sub(r"[^\w.+-]", "_", found.name).strip(".") or "run"

    def work(part: Path) -> None:
        globals()[f"write_{to}"](states, part, name)
        if FORMATS[to].sequence and len(states) > 1:
            with open(part / "times.csv", "w", encoding="utf-8", newline="") as file:
                table = csv.writer(file, lineterminator="\n")
                table.writerow(("file", "state", "time"))
                numbered = enumerate(zip(states.chosen, states.times.tolist(), strict=True))
                table.writerows((number, state, repr(time)) for number, (state, time) in numbered)

    fill_folder(folder, work)
    return Exported(folder, tuple(sorted(file.name for file in folder.iterdir())), len(states))


def check_folder(path: Path, *, force: bool) -> None:
    """Check that a folder can be created or replaced, before anything is done.

    Raises
    ------
    InputError
    """
    if not os.fspath(path).strip() or path == Path():
        raise InputError("is empty; give the folder to write to", key="--out")
    try:
        if os.path.lexists(path):
            _check_replaceable(path, force=force)
        check_creatable(path, "--out")
        if path.exists() and not os.access(path.absolute().parent, os.W_OK | os.X_OK):
            raise InputError("cannot be replaced: no permission in the folder above", file=path, key="--out")
    except OSError as error:
        raise InputError(f"cannot be used: {reason(error)}", file=path, key="--out") from None


def _check_replaceable(path: Path, *, force: bool) -> None:
    if path.is_symlink() or not path.is_dir():
        raise InputError("is a file; name a folder", file=path, key="--out")
    if not force:
        raise InputError("exists; name another folder, or give --force to replace it", file=path, key="--out")
    foreign = sorted(entry.name for entry in path.iterdir() if not OURS.fullmatch(entry.name))
    if foreign:
        raise InputError(
            f"holds '{foreign[0]}', which no export wrote; name another folder", file=path, key="--out"
        )


def fill_folder(path: Path, work: Callable[[Path], None]) -> None:
    """Let ``work`` write into a new folder, which gets its name at the end and replaces a former one.

    Raises
    ------
    OutputError
        If it could not be written; a former folder is left as it was.
    """
    part, old = (path.with_name(path.name + ending) for ending in (".part", ".old"))
    created = [folder for folder in path.absolute().parents if not folder.exists()]
    try:
        _remove(part)  # left by a process that was killed
        part.mkdir(parents=True)
        work(part)
        for file in part.iterdir():
            with open(file, "rb") as written:
                os.fsync(written.fileno())
        _remove(old)
        if path.exists():
            path.rename(old)
        part.rename(path)
        _remove(old)
    except BaseException as error:
        with suppress(OSError):
            _remove(part)
        for folder in created:
            with suppress(OSError):  # no longer empty
                folder.rmdir()
        if isinstance(error, OSError):
            raise OutputError(f"{path}: cannot be written: {reason(error)}") from error
        if isinstance(error, OutputError):
            raise OutputError(f"{path}: {error}") from error
        raise


def _remove(folder: Path) -> None:
    if folder.exists():
        shutil.rmtree(folder)


SINGLE_RATE = 24.0
"""ExportedStates a second where there is a single state."""


@dataclass(frozen=True)
class ExportedStates:
    """Some states of a run.

    Attributes
    ----------
    run : StoredRun
    chosen : tuple of int
        Numbers of the states, ascending.
    displacement : bool
        Whether the displacement from the run's first state is among the fields, if it was not written.
    """

    run: StoredRun
    chosen: tuple[int, ...]
    displacement: bool = False

    def __len__(self) -> int:
        return len(self.chosen)

    @property
    def times(self) -> Array:
        """(n,) [s]."""
        return self.run.times[list(self.chosen)]

    @property
    def positions(self) -> Iterator[Array]:
        """(V, 3) positions [m] of each state."""
        return (self.run.positions[i] for i in self.chosen)

    @property
    def fields(self) -> tuple[str, ...]:
        """What is exported besides positions."""
        written = self.run.fields
        return (*written, "displacement") if self._adds_displacement else written

    @property
    def _adds_displacement(self) -> bool:
        return self.displacement and "displacement" not in self.run.fields

    def field_on(self, name: str) -> str:
        """``vertex`` or ``triangle``."""
        added = name == "displacement" and self._adds_displacement
        return "vertex" if added else self.run.field_on(name)

    def field(self, name: str) -> Iterator[Array]:
        """The values of a field in each state."""
        if name == "displacement" and self._adds_displacement:
            start = self.run.positions[0]
            return (position - start for position in self.positions)
        return (self.run.field(name)[i] for i in self.chosen)

    @cached_property
    def obstacles(self) -> dict[str, ObstacleSurface]:
        """The run's obstacles by unique names of letters, digits and underscores, none of them ``cloth``."""
        if not self.run.scene.obstacles:
            return {}
        from lyra_petsc.show.obstacle_surfaces import obstacle_surfaces

        boxes = [(x.min(axis=0), x.max(axis=0)) for x in self.positions]
        low, high = np.min([a for a, _ in boxes], axis=0), np.max([b for _, b in boxes], axis=0)
        named: dict[str, ObstacleSurface | None] = {"cloth": None}
        for surface in obstacle_surfaces(self.run, (low + high) / 2.0, float(np.linalg.norm(high - low))):
            label = re.sub(r"\W", "_", surface.name, flags=re.ASCII)
            label = f"_{label}" if label[:1].isdigit() else label
            while label in named:
                label += "_"
            named[label] = surface
        return {label: surface for label, surface in named.items() if surface is not None}

    def places(self, obstacle: ObstacleSurface) -> Iterator[Array]:
        """(n, 3) positions [m] of an obstacle's points in each state."""
        return (obstacle.positions(float(time)) for time in self.times)

    @property
    def up(self) -> tuple[int, int]:
        """Axis (0, 1, 2) and sign of the direction against gravity; +z without gravity."""
        gravity = np.asarray(self.run.scene.gravity or (0.0, 0.0, -1.0))
        axis = int(np.abs(gravity).argmax())
        if gravity[axis] == 0.0:
            return 2, 1
        return axis, -1 if gravity[axis] > 0.0 else 1

    @property
    def rate(self) -> float:
        """States a second, from the median of their intervals."""
        spacing = np.diff(self.times)
        return round(1.0 / float(np.median(spacing)), 6) if len(spacing) else SINGLE_RATE


def choose(run: StoredRun, times: str | None, every: int | None) -> ExportedStates:
    """The states nearest to some times, every nth state, or all.

    Parameters
    ----------
    run : StoredRun
    times : str or None
        ``--times``: numbers [s] with commas between.
    every : int or None
        ``--every``.

    Raises
    ------
    InputError
        If both are given, for text that is not a number, or a time outside the run.
    """
    if times is not None and every is not None:
        raise InputError("choose states either by --times or by --every", key="--every")
    if every is not None and every < 1:
        raise InputError(f"must be at least 1, not {every}", key="--every")
    if times is None:
        return ExportedStates(run, tuple(range(0, len(run), every or 1)))
    found = {pick_state(run, time, "--times") for time in numbers(times, "--times", "0,0.5,1")}
    return ExportedStates(run, tuple(sorted(found)))


def turned_up(up: tuple[int, int], target: int) -> tuple[float, float, float, float]:
    """Quaternion x, y, z, w of the rotation from the axis ``up``, with its sign, to the axis ``target``."""
    start, end = np.zeros(3), np.zeros(3)
    start[up[0]], end[target] = up[1], 1.0
    if start @ end < -0.5:  # half a turn about either of the other axes
        about = np.zeros(3)
        about[(target + 1) % 3] = 1.0
        return (*about.tolist(), 0.0)
    turn = np.append(np.cross(start, end), 1.0 + start @ end)
    x, y, z, w = (turn / np.linalg.norm(turn)).tolist()
    return x, y, z, w


def write_obj(states: ExportedStates, folder: Path, name: str) -> None:
    """Write ``<name>_0000.obj``, …; texture coordinates where the mesh came with them.

    Where there are obstacles, they and the cloth are objects (``o``), the cloth first.
    """
    texture, faces = _texture_and_faces(states)
    moving = {label: states.places(obstacle) for label, obstacle in states.obstacles.items()}
    for number, (time, position) in enumerate(zip(states.times, states.positions, strict=True)):
        text = [f"# state {states.chosen[number]}, t = {time!r} s; m\n", "o cloth\n" if moving else ""]
        text += [_points(position), texture, faces]
        before = len(position)
        for label, places in moving.items():
            x = next(places)
            text += [f"o {label}\n", _points(x), _faces(states.obstacles[label].triangles + before + 1)]
            before += len(x)
        (folder / f"{name}_{number:04d}.obj").write_text("".join(text), encoding="utf-8")


def _points(x: Array) -> str:
    return "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in x.tolist())


def _faces(corners: Ints) -> str:
    return "".join(f"f {a} {b} {c}\n" for a, b, c in corners.tolist())


def _texture_and_faces(states: ExportedStates) -> tuple[str, str]:
    """The ``vt`` lines and the ``f`` lines, which all states share; numbers count from 1."""
    run = states.run
    corners = run.triangles + 1
    if run.corner_uv is None:
        return "", _faces(corners)
    if run.uv is not None:
        uv, places = run.uv, corners
    else:
        uv, found = np.unique(run.corner_uv.reshape(-1, 2), axis=0, return_inverse=True)
        places = found.reshape(-1, 3) + 1
    texture = "".join(f"vt {u!r} {v!r}\n" for u, v in uv.tolist())
    rows = np.stack([corners, places], axis=2).reshape(-1, 6).tolist()
    return texture, "".join(f"f {a}/{p} {b}/{q} {c}/{r}\n" for a, p, b, q, c, r in rows)


def write_ply(states: ExportedStates, folder: Path, name: str) -> None:
    """Write ``<name>_0000.ply``, …: binary, double precision, with the fields on vertices.

    Texture coordinates are ``s`` and ``t``; a texture with seams is left out. Obstacles have files of their
    own, ``<name>-<obstacle>_0000.ply``, ….
    """
    import meshio

    run = states.run
    fields = {field: states.field(field) for field in states.fields if states.field_on(field) == "vertex"}
    texture = {} if run.uv is None else {"s": run.uv[:, 0], "t": run.uv[:, 1]}
    triangles = run.triangles.astype(np.int32)
    for number, position in enumerate(states.positions):
        data = dict(texture)
        for field, values in fields.items():
            rows = next(values)
            if rows.ndim == 1:
                data[field] = rows
            else:
                data |= {f"{field}_{axis}": rows[:, i] for i, axis in enumerate("xyz")}
        mesh = meshio.Mesh(position, [("triangle", triangles)], point_data=data)
        meshio.write(folder / f"{name}_{number:04d}.ply", mesh, binary=True)
    for label, obstacle in states.obstacles.items():
        cells = [("triangle", obstacle.triangles.astype(np.int32))]
        for number, x in enumerate(states.places(obstacle)):
            meshio.write(folder / f"{name}-{label}_{number:04d}.ply", meshio.Mesh(x, cells), binary=True)


OVERHEAD = 1 << 17
"""Bytes that an HDF5 file needs beyond its data."""


def write_npz(states: ExportedStates, folder: Path, name: str) -> None:
    """Write ``<name>.npz``, one state in memory at a time.

    ``time`` (T,), ``position`` (T, V, 3), each field (T, …), ``triangles`` (F, 3), ``rest`` (V, 3), where the
    mesh has them ``uv`` (V, 2) or ``corner_uv`` (F, 3, 2), of each obstacle ``obstacle_<name>`` (T, n, 3) and
    ``triangles_of_<name>`` (m, 3), and ``names`` and ``units`` (n,) of all of these.
    """
    run = states.run
    fixed = {"time": states.times, "triangles": run.triangles, "rest": run.rest}
    if run.uv is not None:
        fixed["uv"] = run.uv
    elif run.corner_uv is not None:
        fixed["corner_uv"] = run.corner_uv
    units = {"time": "s", "triangles": "1", "rest": "m", "uv": "m", "corner_uv": "m", "position": "m"}
    units |= {field: run.field_units(field) for field in states.fields}
    moving = {"position": states.positions} | {field: states.field(field) for field in states.fields}
    for label, obstacle in states.obstacles.items():
        moving[f"obstacle_{label}"] = states.places(obstacle)
        fixed[f"triangles_of_{label}"] = obstacle.triangles
        units |= {f"obstacle_{label}": "m", f"triangles_of_{label}": "1"}
    names = [*fixed, *moving]
    fixed |= {"names": np.array(names), "units": np.array([units[one] for one in names])}
    with zipfile.ZipFile(folder / f"{name}.npz", "w", zipfile.ZIP_STORED) as archive:
        for one, array in fixed.items():
            _write_array(archive, one, iter([array]), array.shape)
        for one, arrays in moving.items():
            first = next(arrays)
            _write_array(archive, one, chain([first], arrays), (len(states), *first.shape))


def _write_array(
    archive: zipfile.ZipFile, name: str, arrays: Iterator[NDArray[Any]], shape: tuple[int, ...]
) -> None:
    """Write an array (as .npy) from pieces along its first axis."""
    first = np.ascontiguousarray(next(arrays))
    header = {"shape": shape, "fortran_order": False, "descr": first.dtype.str}
    with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
        npy.write_array_header_2_0(file, header)  # type: ignore[no-untyped-call]
        file.write(first.data.cast("B") if first.size else b"")
        for array in arrays:
            file.write(np.ascontiguousarray(array, dtype=first.dtype).data.cast("B"))


def write_vtkhdf(states: ExportedStates, folder: Path, name: str) -> None:
    """Write ``<name>.vtkhdf``: times, positions, rest shape and all fields, in double precision.

    Obstacles have files of their own, ``<name>-<obstacle>.vtkhdf``.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    run = states.run
    fields = {field: (states.field_on(field), states.field(field)) for field in states.fields}
    moving = {"Points": ("vertex", states.positions), **fields}
    _write_moving(folder / f"{name}.vtkhdf", states.times, run.triangles, {"rest": run.rest}, moving)
    for label, obstacle in states.obstacles.items():
        path, places = folder / f"{name}-{label}.vtkhdf", states.places(obstacle)
        _write_moving(path, states.times, obstacle.triangles, {}, {"Points": ("vertex", places)})


def _write_moving(
    path: Path,
    times: Array,
    triangles: Ints,
    fixed: dict[str, Array],
    moving: dict[str, tuple[str, Iterator[NDArray[Any]]]],
) -> None:
    """Write a file of triangles.

    Parameters
    ----------
    path : Path
    times : (T,)
        Of the states [s].
    triangles : (F, 3)
    fixed : dict of arrays
        On vertices, the same in all states.
    moving : dict of (str, iterator)
        For each state an array on the vertices or triangles; ``Points`` are the positions [m].
    """
    n, arrays, samples = len(times), {}, {}
    for field, (_, each) in moving.items():
        samples[field] = next(each)
        arrays[field] = chain([samples[field]], each)
    size = n * sum(array.nbytes for array in samples.values()) + 2 * triangles.nbytes + 64 * n + OVERHEAD
    try:
        _reserve(path, size + 2 * sum(array.nbytes for array in fixed.values()))
        places = {}
        with import_h5py().File(path, "w") as file:
            root = describe(file, times.tolist(), len(samples["Points"]), len(triangles))
            for key, array in cells(triangles).items():
                root[key] = array
            for key, array in fixed.items():
                root[f"PointData/{key}"] = array
                add_offsets(root, "vertex", key, n, 0)
            for field, first in samples.items():
                on = moving[field][0]
                places[field] = field if field == "Points" else f"{GROUPS[on]}/{field}"
                _allocate(root, places[field], (n * len(first), *first.shape[1:]), first.dtype)
                if field != "Points":
                    add_offsets(root, on, field, n, len(first))
        _reserve(path, path.stat().st_size)
        with import_h5py().File(path, "r+") as file:
            for field, each in arrays.items():
                stored = file[f"VTKHDF/{places[field]}"]
                for i, array in enumerate(each):
                    stored[i * len(array) : (i + 1) * len(array)] = in_vtk_order(array)
    except InputError:
        raise
    except HDF5_ERRORS as error:
        raise OutputError(f"{path.name}: cannot be written: {reason(error)}") from error


def _reserve(path: Path, size: int) -> None:
    """Allocate a file's bytes first: HDF5 crashes if the disk is full when a file is closed."""
    with open(path, "r+b" if path.exists() else "wb") as raw:
        os.posix_fallocate(raw.fileno(), 0, size)


def _allocate(root: Any, name: str, shape: tuple[int, ...], kind: np.dtype[Any]) -> None:
    """Create a dataset whose place in the file is allocated at once; its values are written later."""
    h5py = import_h5py()
    space, stored = h5py.h5s.create_simple(shape), h5py.h5t.py_create(kind, logical=True)
    h5py.h5d.create(root.id, name.encode(), stored, space, properties()[0])


LARGEST = 2**32
"""Bytes of a file; the format counts them in 32 bits."""

CLOTH = {"baseColorFactor": [0.75, 0.72, 0.66, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
OBSTACLE = [0.35, 0.37, 0.4]
"""Looks of the materials, which are seen from both sides."""

VERTICES, INDICES, UNSIGNED_INT, FLOAT = 34962, 34963, 5125, 5126
"""Numbers of the format: targets ARRAY_BUFFER and ELEMENT_ARRAY_BUFFER, and component types."""


def write_gltf(states: ExportedStates, folder: Path, name: str) -> None:
    """Write ``<name>.glb``, single precision. Vertices on a texture seam are stored once for each side.

    ``extras.vertex`` of the mesh then holds the number of each of its vertices in the mesh file. Obstacles
    are meshes and nodes of their own.

    Raises
    ------
    InputError
        If the states are too large for the format.
    """
    from pygltflib import GLTF2

    run, n = states.run, len(states)
    source, triangles, uv = np.arange(len(run.rest)), run.triangles, run.uv
    if uv is None and run.corner_uv is not None:
        source, triangles, uv = split_at_seams(triangles, run.corner_uv)
    # positions are not changed; a rotation makes y, the format's upward axis, point up
    document = _Document(states.times, turned_up(states.up, 1))
    document.check_size(n * len(source) + sum(len(s.positions(0.0)) * n for s in states.obstacles.values()))
    title = run.scene.title or run.name
    cloth = document.add(title, 0, triangles, (position[source] for position in states.positions))
    if uv is not None:  # v runs downwards
        texture = np.column_stack([uv[:, 0], 1.0 - uv[:, 1]])
        cloth["primitives"][0]["attributes"]["TEXCOORD_0"] = document.buffer.add(texture, target=VERTICES)
    if len(source) != len(run.rest):
        cloth["extras"] = {"vertex": source.tolist()}
    for obstacle in states.obstacles.values():
        places = islice(states.places(obstacle), 1 if obstacle.still else n)
        material = 1 if obstacle.opacity == 1.0 else 2
        document.add(obstacle.name, material, obstacle.triangles, places)
    gltf = GLTF2.from_dict(document.content(title, obstacles=bool(states.obstacles)))
    gltf.set_binary_blob(bytes(document.buffer.data))
    gltf.save_binary(str(folder / f"{name}.glb"))


class _Document:
    """Meshes that move, each with a node of its own; see `write_gltf`.

    Parameters
    ----------
    times : (n,) float64
        Of the states [s].
    rotation : (4,) float
        Quaternion of all nodes.
    """

    def __init__(self, times: Array, rotation: tuple[float, ...]) -> None:
        self.buffer = _Buffer()
        self._times, self._rotation = times, rotation
        self._meshes: list[dict[str, Any]] = []
        self._nodes: list[dict[str, Any]] = []
        self._moving: list[int] = []

    def check_size(self, points: int) -> None:
        """Refuse more ``points`` in all states than the format can count."""
        if (size := points * 24) >= LARGEST:
            raise InputError(
                f"{len(self._times)} states take {size / 2**30:.0f} GiB, 4 are the most; choose fewer by "
                "--every, or another format",
                key="gltf",
            )

    def add(
        self,
        name: str,
        material: int,
        triangles: Ints,
        positions: Iterator[Array],
    ) -> dict[str, Any]:
        """Add a mesh: positions and normals of the first state, differences from them for the others.

        ``positions`` has one for each state, or a single one of what stands still.
        """
        start = next(positions)
        position, normal = start.astype(np.float32), _normals(start, triangles).astype(np.float32)

        def stored(x: NDArray[Any], normals: NDArray[Any]) -> dict[str, int]:
            return {
                "POSITION": self.buffer.add(x, target=VERTICES, bounds=True),
                "NORMAL": self.buffer.add(normals, target=VERTICES),
            }

        primitive: dict[str, Any] = {"attributes": stored(position, normal), "material": material}
        targets = [stored(moved - position, _normals(moved, triangles) - normal) for moved in positions]
        primitive["indices"] = self.buffer.add(triangles.astype(np.uint32).ravel(), target=INDICES)
        mesh: dict[str, Any] = {"name": name, "primitives": [primitive]}
        if targets:
            primitive["targets"] = targets
            mesh["weights"] = [0.0] * len(targets)
            self._moving.append(len(self._nodes))
        self._nodes.append({"name": name, "mesh": len(self._meshes), "rotation": self._rotation})
        self._meshes.append(mesh)
        return mesh

    def content(self, title: str, *, obstacles: bool) -> dict[str, Any]:
        """The whole document, after which nothing is added."""
        materials = [{"name": "cloth", "pbrMetallicRoughness": CLOTH, "doubleSided": True}]
        for name, opacity in (("obstacle", 1.0), ("see-through obstacle", 0.3)) if obstacles else ():
            look = {**CLOTH, "baseColorFactor": [*OBSTACLE, opacity]}
            blend = {} if opacity == 1.0 else {"alphaMode": "BLEND"}
            materials.append({"name": name, "pbrMetallicRoughness": look, "doubleSided": True, **blend})
        document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "lyra_petsc"},
            "materials": materials,
            "meshes": self._meshes,
            "nodes": self._nodes,
            "scenes": [{"name": title, "nodes": list(range(len(self._nodes)))}],
            "scene": 0,
        }
        n = len(self._times)
        if self._moving:
            times = self.buffer.add(self._times.astype(np.float32), bounds=True)
            weights = self.buffer.add(np.eye(n, dtype=np.float32)[:, 1:].ravel())
            sampler = {"input": times, "output": weights, "interpolation": "LINEAR"}
            channels = [{"sampler": 0, "target": {"node": i, "path": "weights"}} for i in self._moving]
            document["animations"] = [{"name": "run", "samplers": [sampler], "channels": channels}]
        document |= {"bufferViews": self.buffer.views, "accessors": self.buffer.accessors}
        return document | {"buffers": [{"byteLength": len(self.buffer.data)}]}


def _normals(x: Array, triangles: Ints) -> Array:
    """(V, 3) unit normals; z where the triangles have no area."""
    normals = vertex_normals(x, triangles)
    normals[~normals.any(axis=1)] = 0.0, 0.0, 1.0
    return normals


class _Buffer:
    """The binary part of the file, with the views and accessors that say what is where in it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: NDArray[Any], *, target: int | None = None, bounds: bool = False) -> int:
        """Append (n,), (n, 2) or (n, 3) numbers; the number of their accessor."""
        rows = array if array.dtype == np.uint32 else array.astype(np.float32)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": rows.nbytes, "target": target}
        accessor = {
            "bufferView": len(self.views),
            "componentType": UNSIGNED_INT if rows.dtype == np.uint32 else FLOAT,
            "count": len(rows),
            "type": "SCALAR" if rows.ndim == 1 else f"VEC{rows.shape[1]}",
        }
        if bounds:
            accessor["min"] = np.atleast_1d(rows.min(axis=0)).tolist()
            accessor["max"] = np.atleast_1d(rows.max(axis=0)).tolist()
        self.data += rows.tobytes()
        self.views.append(view)
        self.accessors.append(accessor)
        return len(self.accessors) - 1


ROOT = "/run"
MESH = f"{ROOT}/cloth"
OBSTACLE_COLOUR = (0.6, 0.63, 0.66)


def write_usd(states: ExportedStates, folder: Path, name: str) -> None:
    """Write ``<name>.usdc``, single precision; metres, seconds times ``timeCodesPerSecond``.

    Up is the direction against gravity. Velocities are the mesh's, other fields primvars of their names.
    Obstacles are meshes beside the cloth.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    from pxr import Tf, Usd

    path = folder / f"{name}.usdc"
    try:
        stage = Usd.Stage.CreateNew(str(path))
        _fill(stage, states)
        stage.GetRootLayer().Save()
    except Tf.ErrorException as error:
        words = " ".join(str(error).split())
        raise OutputError(f"{path.name}: cannot be written: {words[:200]}") from error


def _fill(stage: Any, states: ExportedStates) -> None:
    from pxr import Gf, Sdf, Usd, UsdGeom, Vt

    run = states.run
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, ROOT)
    root.GetPrim().SetDisplayName(run.scene.title or run.name)
    stage.SetDefaultPrim(root.GetPrim())
    if states.up in ((1, 1), (2, 1)):
        UsdGeom.SetStageUpAxis(stage, "XYZ"[states.up[0]])
    else:
        UsdGeom.SetStageUpAxis(stage, "Z")
        x, y, z, w = turned_up(states.up, 2)
        root.AddOrientOp().Set(Gf.Quatf(w, x, y, z))

    rate = states.rate
    codes = states.times * rate
    whole = np.round(codes)
    codes = np.where(np.abs(codes - whole) < 1e-6, whole, codes).tolist()
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(codes[0])
    stage.SetEndTimeCode(codes[-1])

    mesh = _mesh(stage, MESH, run.triangles)
    primvars = UsdGeom.PrimvarsAPI(mesh)
    if run.corner_uv is not None:
        uv, place = run.uv, UsdGeom.Tokens.vertex
        if uv is None:  # the texture has seams
            uv, place = run.corner_uv.reshape(-1, 2), UsdGeom.Tokens.faceVarying
        st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, place)
        st.Set(Vt.Vec2fArray.FromNumpy(uv.astype(np.float32)))

    for moment, position in zip(codes, states.positions, strict=True):
        _put(mesh, position, moment)
    for field in states.fields:
        _sample(mesh, primvars, states, field, codes)
    for label, obstacle in states.obstacles.items():
        mesh = _mesh(stage, f"{ROOT}/{label}", obstacle.triangles)
        mesh.GetPrim().SetDisplayName(obstacle.name)
        mesh.CreateDisplayColorAttr([Gf.Vec3f(*OBSTACLE_COLOUR)])
        mesh.CreateDisplayOpacityAttr([obstacle.opacity])
        moments = codes[:1] if obstacle.still else codes
        for moment, position in zip(moments, states.places(obstacle), strict=False):
            _put(mesh, position, Usd.TimeCode.Default() if obstacle.still else moment)


def _mesh(stage: Any, place: str, triangles: Ints) -> Any:
    """A mesh without points, seen from both sides."""
    from pxr import UsdGeom, Vt

    mesh = UsdGeom.Mesh.Define(stage, place)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(triangles), 3))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(triangles.astype(np.int32).ravel()))
    mesh.CreateSubdivisionSchemeAttr("none")
    mesh.CreateDoubleSidedAttr(True)
    return mesh


def _put(mesh: Any, x: Array, code: Any) -> None:
    """The points (n, 3) [m] of a mesh at a time code."""
    from pxr import Vt

    single = np.ascontiguousarray(x, dtype=np.float32)
    mesh.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(single), code)
    corners = np.stack([single.min(axis=0), single.max(axis=0)])
    mesh.CreateExtentAttr().Set(Vt.Vec3fArray.FromNumpy(corners), code)


def _sample(mesh: Any, primvars: Any, states: ExportedStates, field: str, codes: list[float]) -> None:
    """A field at each time code."""
    from pxr import Sdf, UsdGeom, Vt

    attribute: Any = None
    for code, rows in zip(codes, states.field(field), strict=True):
        vector = rows.ndim == 2 and not is_tensor(rows.shape)
        if attribute is None:
            if field == "velocity":
                attribute = mesh.CreateVelocitiesAttr()
            else:
                kind = Sdf.ValueTypeNames.Float3Array if vector else Sdf.ValueTypeNames.FloatArray
                on_vertices = states.field_on(field) == "vertex"
                place = UsdGeom.Tokens.vertex if on_vertices else UsdGeom.Tokens.uniform
                primvar = primvars.CreatePrimvar(field, kind, place)
                if is_tensor(rows.shape):
                    primvar.SetElementSize(rows.shape[1])
                attribute = primvar.GetAttr()
            attribute.SetCustomDataByKey("unit", states.run.field_units(field))
        values: NDArray[np.float32] = np.ascontiguousarray(rows, dtype=np.float32)
        attribute.Set(
            Vt.Vec3fArray.FromNumpy(values) if vector else Vt.FloatArray.FromNumpy(values.ravel()), code
        )
