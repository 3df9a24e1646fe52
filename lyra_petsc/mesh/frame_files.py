"""Frames: positions of the vertices of a surface at given times, in files of other programs.

A frame is read when it is needed; no reader keeps one.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.lib import format as npy

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.extras import require_packages
from lyra_petsc.mesh.mesh import FrameSums
from lyra_petsc.mesh.readers import first_few
from lyra_petsc.scene.schema import MAX_SPEED
from lyra_petsc.scene.text import read_bytes

Source = Path | tuple[Path, ...]
"""One file, the pattern of a sequence, or its files."""

LOCAL_HEADER = 30
"""Bytes of the fixed part of a member's header in a zip archive."""


class FrameFile(ABC):
    """Positions of vertices at ascending times.

    Attributes
    ----------
    file : Path
    times : (T,)
        [s].
    """

    file: Path
    times: Array

    @abstractmethod
    def read(self, frame: int) -> Array:
        """The positions (V, 3) [m] of a frame, counted from 0.

        Raises
        ------
        InputError
            If it cannot be read.
        """

    def place(self, frame: int) -> tuple[Path, str]:
        """The file of a frame, and the beginning of a sentence about it."""
        return self.file, f"frame {frame} (t = {self.times[frame]:g} s) "


def open_frames(source: Source, fps: float | None) -> FrameFile:
    """Open frames, of which times and sizes are read.

    Parameters
    ----------
    source : Path or tuple of Path
    fps : float or None
        Frames per second, for files without times.

    Raises
    ------
    InputError
        If the files are no frames; the message names them.
    """
    if isinstance(source, tuple) or source.suffix.lower() == ".obj":
        return ObjSequence(source, fps)
    if source.suffix.lower() == ".npz":
        return NpzFrames(source, fps)
    return UsdFrames(source)


def _regular_times(count: int, fps: float | None, file: Path, kind: str) -> Array:
    if fps is None:
        raise InputError(f"{kind}: give fps, the frames per second", file=file)
    return np.arange(count) / fps


def _check_times(times: Array, file: Path) -> None:
    if not (np.isfinite(times).all() and (np.diff(times) > 0.0).all()):
        bad = int(np.argmax(~np.isfinite(times) | (np.diff(times, prepend=-np.inf) <= 0.0)))
        raise InputError(
            f"frame {bad} is at {times[bad]:g} s: times must be numbers, each later than the one before",
            file=file,
        )


class _Member(NamedTuple):
    """An array in an npz file: its shape, type, place in the file, and whether columns come first."""

    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype[Any]
    offset: int


class NpzFrames(FrameFile):
    """Arrays ``position`` (T, V, 3) and ``time`` (T,) of an npz file, as `numpy.savez` and ``export`` write.

    Arrays are stored there without compression, so that one frame can be read without the others.
    """

    def __init__(self, file: Path, fps: float | None) -> None:
        self.file = file
        try:
            with zipfile.ZipFile(file) as archive:
                self._position = self._member(archive, "position")
                timed = "time.npy" in archive.namelist()
                times = self._member(archive, "time") if timed else None
        except FileNotFoundError:
            raise InputError("no such file", file=file) from None
        except (
            OSError,
            ValueError,
            EOFError,
            RuntimeError,
            zipfile.BadZipFile,
        ) as error:
            raise InputError(f"cannot be read as an npz file ({error})", file=file) from None
        shape = self._position.shape
        if len(shape) != 3 or shape[2] != 3 or 0 in shape:
            raise InputError(f"position has the shape {shape}; must be (frames, vertices, 3)", file=file)
        if times is None:
            self.times = _regular_times(shape[0], fps, file, "has no array time")
            return
        if times.shape != shape[:1]:
            text = f"time has the shape {times.shape} for {shape[0]} frames; must be {shape[:1]}"
            raise InputError(text, file=file)
        self.times = self._values(times, 0, shape[0])
        _check_times(self.times, file)

    def _member(self, archive: zipfile.ZipFile, name: str) -> _Member:
        try:
            entry = archive.getinfo(f"{name}.npy")
        except KeyError:
            names = first_few(sorted(Path(one).stem for one in archive.namelist()))
            raise InputError(f"has no array {name} (but {names or 'nothing'})", file=self.file) from None
        if entry.compress_type != zipfile.ZIP_STORED:
            raise InputError(
                "is compressed, so that no frame can be read without all before it; write it by numpy.savez "
                "instead of numpy.savez_compressed",
                file=self.file,
            )
        with archive.open(entry) as member:
            readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
            version = npy.read_magic(member)  # type: ignore[no-untyped-call]
            if version not in readers:
                raise ValueError(f"{name}.npy is of version {version}")
            shape, fortran, dtype = readers[version](member)  # type: ignore[no-untyped-call]
            begin = member.tell()
        if dtype.kind not in "fiu":
            raise InputError(f"{name} holds {dtype}, not numbers", file=self.file)
        if fortran and len(shape) > 1:
            raise InputError(
                f"{name} is in Fortran's order, in which no frame is in one piece; write "
                f"numpy.ascontiguousarray({name})",
                file=self.file,
            )
        if entry.file_size != begin + int(np.prod(shape, dtype=object)) * dtype.itemsize:
            raise InputError(f"{name} holds less or more than its shape {shape}", file=self.file)
        with self.file.open("rb") as whole:
            whole.seek(entry.header_offset)
            header = whole.read(LOCAL_HEADER)
        lengths = np.frombuffer(header[26:30], dtype="<u2")
        return _Member(shape, fortran, dtype, entry.header_offset + LOCAL_HEADER + int(lengths.sum()) + begin)

    def _values(self, member: _Member, first: int, count: int) -> Array:
        size = member.dtype.itemsize
        try:
            with self.file.open("rb") as whole:
                whole.seek(member.offset + first * size)
                data = whole.read(count * size)
        except OSError as error:
            raise InputError(f"cannot be read ({error.strerror})", file=self.file) from None
        if len(data) != count * size:
            raise InputError("is cut off", file=self.file)
        return np.frombuffer(data, dtype=member.dtype).astype(np.float64)

    def read(self, frame: int) -> Array:
        size = 3 * self._position.shape[1]
        return self._values(self._position, frame * size, size).reshape(-1, 3)


class ObjSequence(FrameFile):
    """The vertices of .obj files: those of a list, or those whose numbers a pattern as ``body_*.obj`` has."""

    def __init__(self, source: Source, fps: float | None) -> None:
        self._files = list(source) if isinstance(source, tuple) else _numbered(source)
        self.file = self._files[0]
        self.times = _regular_times(len(self._files), fps, self.file, "has no time")

    def place(self, frame: int) -> tuple[Path, str]:
        return self._files[frame], ""

    def read(self, frame: int) -> Array:
        file = self._files[frame]
        lines = (line.split() for line in read_bytes(file).splitlines())
        rows = [words[1:4] for words in lines if words[:1] == [b"v"]]
        try:
            points = np.array(rows, dtype=np.float64)
        except ValueError:
            raise InputError("a line with v does not have three numbers", file=file) from None
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError("has no vertices (lines with v and three numbers)", file=file)
        return points


def _numbered(pattern: Path) -> list[Path]:
    """The files of a pattern with one ``*`` for their numbers, ascending."""
    before, after = pattern.name.split("*")
    name = re.compile(re.escape(before) + r"(\d+)" + re.escape(after))
    try:
        names = sorted(path.name for path in pattern.parent.iterdir())
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", file=pattern.parent) from None
    files: dict[int, str] = {}
    for one in names:
        if (match := name.fullmatch(one)) is not None:
            number = int(match[1])
            if number in files:
                text = f"{files[number]} and {one} are both number {number} of {pattern.name}"
                raise InputError(text, file=pattern.parent)
            files[number] = one
    if not files:
        raise InputError(
            f"no such files; * stands for the number of a frame: {pattern.name}", file=pattern.parent
        )
    numbers = np.array(sorted(files))
    if len(numbers) < numbers[-1] - numbers[0] + 1:
        gap = int(numbers[:-1][np.diff(numbers) > 1][0])
        text = f"{pattern.name}: number {gap + 1} is missing between {files[gap]} and its successor"
        raise InputError(text, file=pattern.parent)
    return [pattern.parent / files[number] for number in numbers.tolist()]


class UsdFrames(FrameFile):
    """The points with time samples of the one mesh that has any in a USD file, in the mesh's coordinates."""

    def __init__(self, file: Path) -> None:
        require_packages("frames", ("pxr",), "export")
        from pxr import Tf, Usd, UsdGeom

        self.file = file
        if not file.is_file():
            raise InputError("no such file", file=file)
        try:
            stage = Usd.Stage.Open(str(file), Usd.Stage.LoadNone)
        except Tf.ErrorException as error:
            why = " ".join(str(error).split())[:200]
            raise InputError("cannot be read as USD" + (f" ({why})" if why else ""), file=file) from None
        layers = [layer.realPath for layer in stage.GetUsedLayers() if layer.realPath]
        if others := [one for one in layers if Path(one).resolve() != file.resolve()]:
            raise InputError(f"refers to another file ({others[0]}); flatten it", file=file)
        moving = {
            str(prim.GetPath()): points
            for prim in stage.Traverse()
            if prim.IsA(UsdGeom.Mesh) and (points := UsdGeom.Mesh(prim).GetPointsAttr()).GetNumTimeSamples()
        }
        if len(moving) != 1:
            which = f"{len(moving)} ({first_few(sorted(moving))})" if moving else "none"
            raise InputError(f"must have one mesh with points that change in time, not {which}", file=file)
        self._stage, (self._points,) = stage, moving.values()  # a stage ends with its last reference
        self._codes = self._points.GetTimeSamples()
        self.times = np.array(self._codes) / stage.GetTimeCodesPerSecond()
        _check_times(self.times, file)

    def read(self, frame: int) -> Array:
        points = self._points.Get(self._codes[frame])
        return np.array(points, dtype=np.float64).reshape(-1, 3)


def check_frames(frames: FrameFile, counts: tuple[int, ...], of: str) -> FrameSums:
    """Read all frames once, one after another, and refuse those that cannot be used; returns what they were.

    Parameters
    ----------
    frames : FrameFile
    counts : tuple of int
        Numbers of vertices that a frame may have.
    of : str
        Of what, for the message.

    Raises
    ------
    InputError
        A frame has another number of vertices, or coordinates that are no finite numbers, or leads to a
        speed beyond `MAX_SPEED`; the message names frame and file.
    """
    before, sums, size = np.empty((0, 3)), [], 0
    for frame in range(len(frames.times)):
        x, (file, where) = frames.read(frame), frames.place(frame)
        if len(x) not in counts or (frame and len(x) != size):
            expected = " or ".join(map(str, dict.fromkeys(counts)))
            raise InputError(f"{where}has {len(x)} vertices; {of} {expected}", file=file)
        if (bad := np.flatnonzero(~np.isfinite(x).all(axis=1))).size:
            text = f"{where}has coordinates that are not finite: vertices {first_few(bad.tolist())}"
            raise InputError(f"{text} (counted from 0)", file=file)
        size = len(x)
        if frame:
            with np.errstate(over="ignore", invalid="ignore"):
                moved = float(np.sqrt(((x - before) ** 2).sum(axis=1).max()))
            fastest = moved / float(frames.times[frame] - frames.times[frame - 1])
            if not fastest <= MAX_SPEED:
                text = f"{where}goes there at {fastest:.3g} m/s; at most {MAX_SPEED:g} m/s"
                raise InputError(text, file=file)
        before = x
        sums.append(zlib.crc32(x.tobytes()))
    return FrameSums(frames.times, np.array(sums, dtype=np.int64))
