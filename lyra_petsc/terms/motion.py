"""Rigid (and scaling) motions in time, and the window in which a handle or load acts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.scene.schema import Handle, Keyframe, Scene

Array = NDArray[np.float64]


def _quaternion(keyframe: Keyframe) -> Array:
    if keyframe.rotate is None:
        return np.array([1.0, 0.0, 0.0, 0.0])
    axis = np.asarray(keyframe.rotate.axis, dtype=np.float64)
    axis = axis / np.abs(axis).max()  # whose square may not be a number
    half = 0.5 * math.radians(keyframe.rotate.degrees)
    return np.concatenate([[math.cos(half)], math.sin(half) * axis / np.linalg.norm(axis)])


def _rotation(q: Array) -> Array:
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


class Motion:
    """T(t) = translate ∘ rotate ∘ scale through keyframes.

    Translation, scale and the quaternion of the rotation are interpolated component by component,
    either linearly or by the cubic Hermite polynomial with central-difference tangents that vanish at
    both ends (as the original Lyra does; a keyframe's ``velocity`` replaces the tangent of the
    translation). Before the first and after the last keyframe the transform stands still. Quaternions
    are taken as the angles are given, so that a turn of up to 360° between two keyframes goes the way
    it says.

    Raises
    ------
    InputError
        If two keyframes are a full turn apart (the interpolated quaternion would vanish), or their
        scales differ in sign.
    """

    def __init__(self, keyframes: Sequence[Keyframe], interpolation: str, *, key: str = "motions") -> None:
        self._times = np.array([k.time for k in keyframes], dtype=np.float64)
        rows = []
        for k in keyframes:
            scale = np.broadcast_to(np.asarray(k.scale, dtype=np.float64), (3,))
            rows.append(np.concatenate([k.translate, scale, _quaternion(k)]))
        self._values = np.array(rows)
        n = len(rows)
        for i in range(n - 1):
            if self._values[i, 6:] @ self._values[i + 1, 6:] < -0.98:
                raise InputError(
                    f"keyframes {i} and {i + 1} are nearly a full turn apart; put a keyframe between them",
                    key=key,
                )
            if np.any(self._values[i, 3:6] * self._values[i + 1, 3:6] < 0.0):
                raise InputError(
                    f"scale changes its sign between keyframes {i} and {i + 1}; it would vanish between them",
                    key=key,
                )
        self._tangents = np.zeros_like(self._values)
        self._linear = interpolation == "linear"
        if not self._linear and n > 2:
            spans = (self._times[2:] - self._times[:-2])[:, None]
            self._tangents[1:-1] = (self._values[2:] - self._values[:-2]) / spans
        for i, k in enumerate(keyframes):
            if k.velocity is not None:
                self._tangents[i, :3] = k.velocity

    def _at(self, time: float) -> tuple[Array, Array]:
        """Interpolated components and their time derivatives, each (10,)."""
        times, values = self._times, self._values
        if time <= times[0] or len(times) == 1:
            return values[0], np.zeros(10)
        if time >= times[-1]:
            return values[-1], np.zeros(10)
        i = int(np.searchsorted(times, time, side="right")) - 1
        h = times[i + 1] - times[i]
        s = (time - times[i]) / h
        p, q = values[i], values[i + 1]
        if self._linear:
            return p + s * (q - p), (q - p) / h
        m, n = h * self._tangents[i], h * self._tangents[i + 1]
        value = (
            (1 + 2 * s) * (1 - s) ** 2 * p
            + s * (1 - s) ** 2 * m
            + s * s * (3 - 2 * s) * q
            - s * s * (1 - s) * n
        )
        slope = 6 * s * (s - 1) * (p - q) + (1 - s) * (1 - 3 * s) * m + s * (3 * s - 2) * n
        return value, slope / h

    def transform(self, time: float) -> tuple[Array, Array]:
        """Matrix (3, 3) and translation (3,) [m] of T(t): x ↦ A x + d."""
        value, _ = self._at(time)
        return _rotation(value[6:]) * value[3:6], value[:3]

    def carried(self, points: Array, start: float, time: float) -> Array:
        """T(time) T(start)⁻¹ applied to ``points`` (n, 3) [m]."""
        if len(self._times) == 1:  # most handles: nothing moves
            return points.copy()
        a0, d0 = self.transform(start)
        a, d = self.transform(time)
        moved: Array = (points - d0) @ (a @ np.linalg.inv(a0)).T + d
        return moved

    def velocity(self, points: Array, start: float, time: float) -> Array:
        """Time derivative [m/s] of ``carried`` (n, 3), by differences of 1e-6 of the shortest interval."""
        if len(self._times) == 1:
            return np.zeros_like(points)
        step = 1e-6 * float(np.diff(self._times).min())
        before, after = self.carried(points, start, time - step), self.carried(points, start, time + step)
        rate: Array = (after - before) / (2 * step)
        return rate


@dataclass(frozen=True)
class Window:
    """The time span from ≤ t ≤ until in which something acts; ``fade`` [s] after it."""

    start: float
    until: float
    fade: float = 0.0

    @classmethod
    def of(cls, handle: Handle) -> Window:
        """The window of a scene's handle; one that starts before t = 0 starts at 0."""
        return cls(max(handle.start, 0.0), handle.until, handle.fade)

    def holds(self, t0: float, t1: float) -> bool:
        """Whether the step from t0 to t1 lies within the window (steps land on its ends)."""
        slack = 1e-9 * max(t1 - t0, 0.0)
        return t0 >= self.start - slack and t1 <= self.until + slack

    def strength(self, t0: float, t1: float, at: float | None = None) -> float:
        """1 within the window, (1 − (t − until)/fade)⁴ at t = ``at`` (t1) while it fades, else 0."""
        if self.holds(t0, t1):
            return 1.0
        time = t1 if at is None else at
        if self.fade > 0.0 and t1 > self.until and t0 >= self.start:
            return max(0.0, min(1.0, 1.0 - (time - self.until) / self.fade)) ** 4
        return 0.0

    def events(self) -> list[float]:
        """Times on which a step must end."""
        ends = [self.start, self.until]
        if self.fade > 0.0:
            ends.append(self.until + self.fade)
        return [t for t in ends if math.isfinite(t)]


STILL = Motion([Keyframe(time=0.0)], "linear")


def motion_of(scene: Scene, index: int) -> Motion:
    """The motion of the scene's handle ``index``; without one the handle stands still."""
    handle = scene.handles[index]
    if handle.motion is None:
        return STILL
    return Motion(scene.motions[handle.motion], handle.interpolation, key=f"motions.{handle.motion}")
