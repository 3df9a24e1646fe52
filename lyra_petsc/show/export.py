"""Export of a run's states to formats of other programs: OBJ, PLY, USD and NumPy's npz.

In: a run's folder. Out: a folder of files, which appears when it is complete.

Positions are exactly those of the states; vertices and triangles are in the order of the mesh file. OBJ and
PLY have one file per state; OBJ is written here, as meshio writes neither all digits nor texture coordinates
with seams. The other formats hold all states in one file: npz as arrays; USD as a mesh whose points and
fields are sampled over time.
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
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError, OutputError, suggest
from lyra_petsc.extras import require_packages
from lyra_petsc.output.file_operations import reason
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.output.run_folder import check_creatable
from lyra_petsc.output.tensors import is_tensor
from lyra_petsc.scene.time_curve import largest
from lyra_petsc.show.render.render_plan import OBSTACLE_COLOR, parse_numbers, pick_state

if TYPE_CHECKING:
    from lyra_petsc.show.obstacle_surfaces import ObstacleSurface

EXPORTED_FILE = re.compile(r".+(_\d{4,}\.(obj|ply)|\.(usdc|npz))|times\.csv")
"""Names of the files that an export writes; --force removes no folder with other files."""


@dataclass(frozen=True)
class Exported:
    """The result of an export.

    Attributes
    ----------
    folder : Path
    files : tuple of str
        Names of the files, sorted.
    states : int
        Number of states.
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
        By default a folder in the run's folder with the name of the format.
    times : str, optional
        Comma-separated times [s]: export the states nearest to them.
    every : int, optional
        Export every n-th state.
    displacement : bool
        Add the displacement from the run's first state as a field.
    force : bool
        Replace an earlier export.

    Raises
    ------
    InputError
        Bad input; nothing is written.
    OutputError
        If the files cannot be written; incomplete files are removed.
    """
    if to not in FORMATS:
        raise InputError(f"unknown format {to!r}, {suggest(to, FORMATS)}", key="--to")
    if displacement and not FORMATS[to].fields:
        able = ", ".join(name for name, form in FORMATS.items() if form.fields)
        raise InputError(f"{to} holds positions alone; take --to {able}", key="--displacement")
    require_packages(f"export --to {to}", FORMATS[to].packages, "export")
    stored = StoredRun(run)
    folder = out if out is not None else stored.folder / to
    check_folder(folder, force=force)
    states = replace(select_states(stored, times, every), displacement=displacement)
    # without characters that Windows or a shell treats specially; letters of any script are kept
    name = re.sub(r"[^\w.+-]", "_", stored.name).strip(".") or "run"

    def work(part: Path) -> None:
        FORMATS[to].write(states, part, name)
        if FORMATS[to].sequence and len(states) > 1:
            with open(part / "times.csv", "w", encoding="utf-8", newline="") as file:
                table = csv.writer(file, lineterminator="\n")
                table.writerow(("file", "state", "time"))
                numbered = enumerate(zip(states.indices, states.times.tolist(), strict=True))
                table.writerows((number, state, repr(time)) for number, (state, time) in numbered)

    replace_folder(folder, work)
    return Exported(folder, tuple(sorted(file.name for file in folder.iterdir())), len(states))


def check_folder(path: Path, *, force: bool) -> None:
    """Check that a folder can be created or replaced, before any work begins.

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
    foreign = sorted(entry.name for entry in path.iterdir() if not EXPORTED_FILE.fullmatch(entry.name))
    if foreign:
        raise InputError(
            f"holds '{foreign[0]}', which no export wrote; name another folder", file=path, key="--out"
        )


def replace_folder(path: Path, work: Callable[[Path], None]) -> None:
    """Let ``work`` write into a new folder, which at the end replaces the folder ``path``.

    Raises
    ------
    OutputError
        If the files cannot be written; an existing folder is then unchanged.
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


@dataclass(frozen=True)
class ExportedStates:
    """States of a run to be exported.

    Attributes
    ----------
    run : StoredRun
    indices : tuple of int
        Numbers of the states, ascending.
    displacement : bool
        Whether to add the displacement from the run's first state to the fields, if the run lacks it.
    """

    run: StoredRun
    indices: tuple[int, ...]
    displacement: bool = False

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def times(self) -> Array:
        """(n,) times of the states [s]."""
        return self.run.times[list(self.indices)]

    @property
    def positions(self) -> Iterator[Array]:
        """(V, 3) positions [m] of each state."""
        return (self.run.positions[i] for i in self.indices)

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the exported fields besides the positions."""
        written = self.run.fields
        return (*written, "displacement") if self._adds_displacement else written

    @property
    def _adds_displacement(self) -> bool:
        return self.displacement and "displacement" not in self.run.fields

    def field_on(self, name: str) -> str:
        """``vertex`` or ``triangle``: what a field's rows belong to."""
        added = name == "displacement" and self._adds_displacement
        return "vertex" if added else self.run.field_on(name)

    def field(self, name: str) -> Iterator[Array]:
        """The values of a field in each state."""
        if name == "displacement" and self._adds_displacement:
            start = self.run.positions[0]
            return (position - start for position in self.positions)
        return (self.run.field(name)[i] for i in self.indices)

    @cached_property
    def obstacles(self) -> dict[str, ObstacleSurface]:
        """The run's obstacles by unique names of letters, digits and underscores other than ``cloth``."""
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

    def obstacle_points(self, obstacle: ObstacleSurface) -> Iterator[Array]:
        """Positions (n, 3) [m] of an obstacle's points in each state."""
        return (obstacle.positions(float(time)) for time in self.times)

    @property
    def up(self) -> tuple[int, int]:
        """Coordinate axis (0, 1, 2) and sign of the direction against gravity; +z without gravity."""
        gravity = np.zeros(3) + largest(self.run.scene.gravity)
        axis = int(np.abs(gravity).argmax())
        if gravity[axis] == 0.0:
            return 2, 1
        return axis, -1 if gravity[axis] > 0.0 else 1

    @property
    def rate(self) -> float:
        """States per second, from the median of their intervals."""
        spacing = np.diff(self.times)
        usual = 24.0  # of USD, for a single state
        return round(1.0 / float(np.median(spacing)), 6) if len(spacing) else usual


def select_states(run: StoredRun, times: str | None, every: int | None) -> ExportedStates:
    """The states nearest to given times, every n-th state, or all states.

    Parameters
    ----------
    run : StoredRun
    times : str or None
        ``--times``: comma-separated times [s].
    every : int or None
        ``--every``.

    Raises
    ------
    InputError
        If both options are given, or for invalid numbers or times outside the run.
    """
    if times is not None and every is not None:
        raise InputError("choose states either by --times or by --every", key="--every")
    if every is not None and every < 1:
        raise InputError(f"must be at least 1, not {every}", key="--every")
    if times is None:
        return ExportedStates(run, tuple(range(0, len(run), every or 1)))
    indices = {pick_state(run, time, "--times") for time in parse_numbers(times, "--times", "0,0.5,1")}
    return ExportedStates(run, tuple(sorted(indices)))


def write_obj(states: ExportedStates, folder: Path, name: str) -> None:
    """Write ``<name>_0000.obj``, …, with the mesh's texture coordinates if it has any.

    In a scene with obstacles, the cloth and the obstacles are objects (``o``), the cloth first.
    """
    texture, faces = _texture_and_faces(states)
    moving = {label: states.obstacle_points(obstacle) for label, obstacle in states.obstacles.items()}
    for number, (time, position) in enumerate(zip(states.times, states.positions, strict=True)):
        text = [f"# state {states.indices[number]}, t = {time!r} s; m\n", "o cloth\n" if moving else ""]
        text += [_vertex_lines(position), texture, faces]
        first = len(position) + 1
        for label, points in moving.items():
            x = next(points)
            text += [f"o {label}\n", _vertex_lines(x), _face_lines(states.obstacles[label].triangles + first)]
            first += len(x)
        (folder / f"{name}_{number:04d}.obj").write_text("".join(text), encoding="utf-8")


def _vertex_lines(x: Array) -> str:
    return "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in x.tolist())


def _face_lines(corners: Ints) -> str:
    return "".join(f"f {a} {b} {c}\n" for a, b, c in corners.tolist())


def _texture_and_faces(states: ExportedStates) -> tuple[str, str]:
    """The ``vt`` lines and the ``f`` lines, which all states share; indices count from 1."""
    run = states.run
    corners = run.triangles + 1
    if run.corner_uv is None:
        return "", _face_lines(corners)
    if run.uv is not None:
        uv, uv_corners = run.uv, corners
    else:
        uv, inverse = np.unique(run.corner_uv.reshape(-1, 2), axis=0, return_inverse=True)
        uv_corners = inverse.reshape(-1, 3) + 1
    texture = "".join(f"vt {u!r} {v!r}\n" for u, v in uv.tolist())
    rows = np.stack([corners, uv_corners], axis=2).reshape(-1, 6).tolist()
    return texture, "".join(f"f {a}/{p} {b}/{q} {c}/{r}\n" for a, p, b, q, c, r in rows)


def write_ply(states: ExportedStates, folder: Path, name: str) -> None:
    """Write ``<name>_0000.ply``, …: binary, double precision, with the fields on vertices.

    Texture coordinates are ``s`` and ``t``; those with seams are omitted. Obstacles have files of their own,
    ``<name>-<obstacle>_0000.ply``, ….
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
        for number, x in enumerate(states.obstacle_points(obstacle)):
            meshio.write(folder / f"{name}-{label}_{number:04d}.ply", meshio.Mesh(x, cells), binary=True)


def write_npz(states: ExportedStates, folder: Path, name: str) -> None:
    """Write ``<name>.npz``, one state in memory at a time.

    Arrays: ``time`` (T,), ``position`` (T, V, 3), each field (T, …), ``triangles`` (F, 3), ``rest`` (V, 3);
    texture coordinates ``uv`` (V, 2) or ``corner_uv`` (F, 3, 2), if the mesh has any; ``obstacle_<name>``
    (T, n, 3) and ``triangles_of_<name>`` (m, 3) of each obstacle; ``names`` and ``units`` (n,) of the arrays.
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
        moving[f"obstacle_{label}"] = states.obstacle_points(obstacle)
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


ROOT = "/run"
MESH = f"{ROOT}/cloth"


def write_usd(states: ExportedStates, folder: Path, name: str) -> None:
    """Write ``<name>.usdc`` in single precision; units are metres, and seconds times ``timeCodesPerSecond``.

    The stage's up axis is the direction against gravity. Velocities are the mesh's ``velocities``, other
    fields primvars. Obstacles are further meshes.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    from pxr import Tf, Usd

    path = folder / f"{name}.usdc"
    try:
        stage = Usd.Stage.CreateNew(str(path))
        _fill_stage(stage, states)
        stage.GetRootLayer().Save()
    except Tf.ErrorException as error:
        raise OutputError(f"{path.name}: cannot be written: {reason(error)}") from error


def _fill_stage(stage: Any, states: ExportedStates) -> None:
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
        upwards = Gf.Vec3d(*(states.up[1] * np.eye(3)[states.up[0]]))
        root.AddOrientOp().Set(Gf.Quatf(Gf.Rotation(upwards, Gf.Vec3d(0.0, 0.0, 1.0)).GetQuat()))

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
        uv, interpolation = run.uv, UsdGeom.Tokens.vertex
        if uv is None:  # the texture has seams
            uv, interpolation = run.corner_uv.reshape(-1, 2), UsdGeom.Tokens.faceVarying
        st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, interpolation)
        st.Set(Vt.Vec2fArray.FromNumpy(uv.astype(np.float32)))

    for code, position in zip(codes, states.positions, strict=True):
        _set_points(mesh, position, code)
    for field in states.fields:
        _set_field(mesh, primvars, states, field, codes)
    colour = Gf.Vec3f(*(channel / 255.0 for channel in bytes.fromhex(OBSTACLE_COLOR[1:])))
    for label, obstacle in states.obstacles.items():
        mesh = _mesh(stage, f"{ROOT}/{label}", obstacle.triangles)
        mesh.GetPrim().SetDisplayName(obstacle.name)
        mesh.CreateDisplayColorAttr([colour])
        mesh.CreateDisplayOpacityAttr([obstacle.opacity])
        obstacle_codes = [Usd.TimeCode.Default()] if obstacle.fixed else codes
        for code, position in zip(obstacle_codes, states.obstacle_points(obstacle), strict=False):
            _set_points(mesh, position, code)


def _mesh(stage: Any, path: str, triangles: Ints) -> Any:
    """Create a mesh without points, visible from both sides."""
    from pxr import UsdGeom, Vt

    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(triangles), 3))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(triangles.astype(np.int32).ravel()))
    mesh.CreateSubdivisionSchemeAttr("none")
    mesh.CreateDoubleSidedAttr(True)
    return mesh


def _set_points(mesh: Any, x: Array, code: Any) -> None:
    """Set the points (n, 3) [m] of a mesh at a time code."""
    from pxr import Vt

    single = np.ascontiguousarray(x, dtype=np.float32)
    mesh.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(single), code)
    corners = np.stack([single.min(axis=0), single.max(axis=0)])
    mesh.CreateExtentAttr().Set(Vt.Vec3fArray.FromNumpy(corners), code)


def _set_field(mesh: Any, primvars: Any, states: ExportedStates, field: str, codes: list[float]) -> None:
    """Set a field at each time code."""
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
                interpolation = UsdGeom.Tokens.vertex if on_vertices else UsdGeom.Tokens.uniform
                primvar = primvars.CreatePrimvar(field, kind, interpolation)
                if is_tensor(rows.shape):
                    primvar.SetElementSize(rows.shape[1])
                attribute = primvar.GetAttr()
            attribute.SetCustomDataByKey("unit", states.run.field_units(field))
        values: NDArray[np.float32] = np.ascontiguousarray(rows, dtype=np.float32)
        attribute.Set(
            Vt.Vec3fArray.FromNumpy(values) if vector else Vt.FloatArray.FromNumpy(values.ravel()), code
        )


@dataclass(frozen=True)
class ExportFormat:
    """A format of ``--to``.

    Attributes
    ----------
    write : callable
        Writes states into a folder, to files that begin with a name.
    packages : tuple of str
        Packages of the extra ``export`` that it needs.
    fields : bool
        Whether it can hold fields besides positions.
    sequence : bool
        Whether each state has a file of its own, without its time.
    """

    write: Callable[[ExportedStates, Path, str], None]
    packages: tuple[str, ...] = ()
    fields: bool = True
    sequence: bool = False


FORMATS = {
    "obj": ExportFormat(write_obj, fields=False, sequence=True),
    "ply": ExportFormat(write_ply, ("meshio",), sequence=True),
    "usd": ExportFormat(write_usd, ("pxr",)),
    "npz": ExportFormat(write_npz),
}
"""Formats by their names in ``--to``."""
