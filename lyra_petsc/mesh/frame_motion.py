"""Motion of vertices through frames from files, of which at most four are in memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.frame_files import FrameFile, Source, open_frames
from lyra_petsc.mesh.interpolation import hermite, without_overshoot
from lyra_petsc.scene.schema import Handle

KEPT = 4
"""Number of frames in memory: a cubic polynomial between two frames depends on the four around."""

CLOSED = 1e-6
"""Distance over the size of the first frame below which the last one of a cycle counts as the same."""


class FrameMotion:
    """Positions of vertices in time, linear or smooth between frames as keyframes (`terms.handles.motion`).

    Before the first frame and after the last one the vertices stand still. A motion that repeats goes on from
    the last frame to the first one: in as much time as between the last two frames, or at once if they are
    the same. Every rank reads what it needs, since no rank knows when others need a frame.

    Parameters
    ----------
    frames : FrameFile
    interpolation : str
        ``monotone``, ``hermite`` or ``linear``.
    repeat : bool
    chosen : callable
        Maps positions (V, 3) of a frame [m] to those that are needed (n, 3).

    Attributes
    ----------
    frames : FrameFile
    repeats : bool
    """

    def __init__(
        self,
        frames: FrameFile,
        interpolation: str,
        *,
        repeat: bool = False,
        chosen: Callable[[Array], Array] = np.asarray,
    ) -> None:
        self.frames, self._chosen = frames, chosen
        self._linear, self._monotone = interpolation == "linear", interpolation == "monotone"
        self._kept: dict[int, Array] = {}
        times, self.repeats = frames.times, repeat and len(frames.times) > 1
        if self.repeats:
            if self._is_closed():
                times = times[:-1]
                end = frames.times[-1]
            else:
                end = 2.0 * times[-1] - times[-2]
        else:
            end = times[-1]
        self._n, self._period = len(times), float(end - times[0])
        self._times = np.append(times, end) if self.repeats else times

    def _is_closed(self) -> bool:
        first, last = self.frames.read(0), self.frames.read(len(self.frames.times) - 1)
        return len(self.frames.times) > 2 and bool(np.abs(last - first).max() <= CLOSED * np.ptp(first))

    def _time(self, number: int) -> float:
        """Time [s] of a frame, where those of later cycles are counted on."""
        if not self.repeats:
            return float(self._times[number])
        cycle, frame = divmod(number, self._n)
        return float(self._times[frame]) + cycle * self._period

    def _frame(self, number: int) -> Array:
        """Positions (n, 3) [m] in a frame, where those of later cycles are counted on."""
        frame = number % self._n
        x = self._kept.pop(frame, None)
        if x is None:
            while len(self._kept) >= KEPT:
                del self._kept[next(iter(self._kept))]  # that used least recently
            x = self._chosen(self.frames.read(frame))
            if not np.isfinite(x).all():
                file, where = self.frames.place(frame)
                raise InputError(f"{where}has changed and is not finite", file=file)
        self._kept[frame] = x
        return x

    def _tangent(self, number: int) -> Array | float:
        """Rates (n, 3) [m/s] at a frame: of a smooth motion, which begins and ends at rest."""
        if number == 0 or (number == self._n - 1 and not self.repeats):
            return 0.0
        before, here, after = (self._frame(number + one) for one in (-1, 0, 1))
        t0, t1, t2 = (self._time(number + one) for one in (-1, 0, 1))
        rate = (after - before) / (t2 - t0)
        if not self._monotone:
            return rate
        limited: Array = without_overshoot(rate, (here - before) / (t1 - t0), (after - here) / (t2 - t1))
        return limited

    def _place(self, time: float) -> tuple[int, float, float]:
        """Number of the last frame before a time [s], length [s] of the interval after it, and the part of it
        that has gone; the interval is 0 where the vertices stand still.
        """
        times = self._times
        if time <= times[0] or len(times) == 1:
            return 0, 0.0, 0.0
        cycle = 0
        if self.repeats:
            cycle = int((time - times[0]) // self._period)
            time -= cycle * self._period
        elif time >= times[-1]:
            return len(times) - 1, 0.0, 0.0
        i = min(max(int(np.searchsorted(times, time, side="right")) - 1, 0), len(times) - 2)
        h = float(times[i + 1] - times[i])
        return cycle * self._n + i, h, min(max(float(time - times[i]) / h, 0.0), 1.0)

    def positions(self, time: float) -> Array:
        """Positions (n, 3) [m] at a time [s]."""
        return self._at(time)[0]

    def _at(self, time: float) -> tuple[Array, Array]:
        """Positions (n, 3) [m] and velocities [m/s] at a time [s]."""
        number, h, s = self._place(time)
        p = self._frame(number)
        if h == 0.0:
            return p, np.zeros_like(p)
        q = self._frame(number + 1)
        if self._linear:
            return p + s * (q - p), (q - p) / h
        x, v = hermite(s, h, p, q, self._tangent(number), self._tangent(number + 1))
        return x, v

    def velocities(self, time: float) -> Array:
        """Velocities (n, 3) [m/s] at a time [s]; where they jump, the mean of both sides."""
        step = 1e-9 * float(np.diff(self._times).min(initial=np.inf))
        if not np.isfinite(step):
            return np.zeros_like(self._frame(0))
        step = max(step, 4.0 * np.spacing(abs(time)))
        return 0.5 * (self._at(time - step)[1] + self._at(time + step)[1])

    def kinks(self, end: float, step: float) -> list[float]:
        """Times [s] before ``end`` at which the velocity jumps and steps of ``step`` [s] must end.

        There are none if frames follow each other faster: steps pass over these.
        """
        if not self._linear or not step <= self.interval < np.inf:
            return []
        times, cycle = self._times[: self._n], 0
        out: list[float] = []
        while not out or (self.repeats and out[-1] < end):
            out += (times + cycle * self._period).tolist()
            cycle += 1
        return [t for t in out if t < end]

    @property
    def interval(self) -> float:
        """Mean time [s] between frames; infinite for one frame."""
        times = self.frames.times
        return float(times[-1] - times[0]) / (len(times) - 1) if len(times) > 1 else np.inf


class HandleFrames:
    """The motion of a handle's vertices through frames, from where they are at its start.

    Parameters
    ----------
    motion : FrameMotion
        Of these vertices.
    """

    def __init__(self, motion: FrameMotion) -> None:
        self.motion = motion
        self._start: tuple[float, Array] | None = None

    def moved(self, points: Array, start: float, time: float) -> Array:
        """Positions (n, 3) [m] of ``points``, which move by the frames' displacements since ``start`` [s]."""
        if self._start is None or self._start[0] != start:
            self._start = start, self.motion.positions(start)
        return points + (self.motion.positions(time) - self._start[1])

    def velocity(self, points: Array, start: float, time: float) -> Array:
        """Time derivative (n, 3) [m/s] of ``moved``."""
        return self.motion.velocities(time)


def handle_frames(handle: Handle) -> FrameMotion:
    """The motion of all points in the frames of a handle.

    Raises
    ------
    InputError
        If its files cannot be read as frames.
    """
    assert handle.frames is not None
    return FrameMotion(open_frames(handle.frames, handle.fps), handle.interpolation, repeat=handle.repeat)


def frames_of(handle: Handle, vertices: Ints, group: Ints, n_vertices: int) -> HandleFrames:
    """The motion of some ``vertices`` of a handle's ``group`` (ascending) in a mesh of ``n_vertices``.

    Frames have all vertices of the mesh, or those of the group in the order of the mesh.
    """
    frames = open_frames(cast("Source", handle.frames), handle.fps)
    whole = len(frames.read(0)) == n_vertices
    rows = vertices if whole else np.searchsorted(group, vertices)
    motion = FrameMotion(frames, handle.interpolation, repeat=handle.repeat, chosen=lambda x: x[rows])
    return HandleFrames(motion)
