"""Rigid motions with scaling in time, and the time window in which a handle or load acts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.interpolation import hermite, without_overshoot
from lyra_petsc.scene.schema import MAX_SPEED, Handle, Keyframe, Rotation, Scene

SAME_AXIS = 1e-12
"""Squared sine of the angle between two axes below which they count as the same."""


def _scaled_axis(rotation: Rotation) -> Array:
    """Axis of a rotation, scaled to a largest component of 1 so that its square does not overflow."""
    axis = np.asarray(rotation.axis, dtype=np.float64)
    return axis / np.abs(axis).max()


def _quaternion(keyframe: Keyframe) -> Array:
    if keyframe.rotate is None:
        return np.array([1.0, 0.0, 0.0, 0.0])
    half = 0.5 * math.radians(keyframe.rotate.degrees)
    axis = _scaled_axis(keyframe.rotate)
    return np.concatenate([[math.cos(half)], math.sin(half) * axis / np.linalg.norm(axis)])


def _relative_rotation(first: Array, second: Array) -> tuple[Array, float]:
    """Axis and angle [rad] of the rotation from the orientation of one quaternion to that of another."""
    a, b = second, first * np.array([1.0, -1.0, -1.0, -1.0])
    real = a[0] * b[0] - a[1:] @ b[1:]
    imaginary = a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
    size = float(np.linalg.norm(imaginary))
    if size == 0.0:
        return np.array([0.0, 0.0, 1.0]), 0.0
    axis: Array = imaginary / size
    return axis, 2.0 * math.atan2(size, float(real))


def _rotation(q: Array) -> Array:
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _axis(keyframe: Keyframe) -> Array | None:
    """Unit axis of a keyframe's rotation; None without a rotation."""
    if keyframe.rotate is None or keyframe.rotate.degrees == 0.0:
        return None
    axis = _scaled_axis(keyframe.rotate)
    return axis / np.linalg.norm(axis)


def _turn_angles(keyframes: Sequence[Keyframe], key: str, file: object) -> list[float | None]:
    """Rotation angles [degrees] between successive keyframes; None where their axes differ.

    Raises
    ------
    InputError
        If axes differ and an angle exceeds 180°, since the path between them is then undefined.
    """
    turns: list[float | None] = []
    for i, (first, second) in enumerate(pairwise(keyframes)):
        one, other = _axis(first), _axis(second)
        angles = [k.rotate.degrees if k.rotate is not None else 0.0 for k in (first, second)]
        if one is None or other is None:
            turns.append(angles[1] - angles[0])
        elif (along := float(one @ other)) ** 2 > 1.0 - SAME_AXIS:
            turns.append(math.copysign(1.0, along) * angles[1] - angles[0])
        elif max(map(abs, angles)) > 180.0:  # quaternions would turn the other way
            raise InputError(
                f"keyframes {i} and {i + 1} turn about different axes, and one by more than 180°; give the "
                "angle that leads there within 180°, or a keyframe with the same axis between them",
                file=file,
                key=key,
            )
        else:
            turns.append(None)
    return turns


class Motion:
    """T(t) = translate ∘ rotate ∘ scale through keyframes.

    Translation, scale and the quaternion of the rotation are interpolated component by component, either
    linearly or by the cubic Hermite polynomial with central-difference tangents that vanish at both ends (as
    the original Lyra does; a keyframe's ``velocity`` replaces the tangent of the translation). ``monotone``
    limits the tangents such that no component leaves the range of the neighbouring keyframes. Before the
    first and after the last keyframe the transform is constant. Between keyframes with the same axis the
    rotation angle changes by the difference of their angles. Since quaternions represent at most 180°, the
    angles of the whole motion are interpolated instead if one difference is larger, and by ``monotone`` also
    if the axis does not change. Between different axes the rotation takes the shortest path.

    Raises
    ------
    InputError
        If the axes of two keyframes differ and one of their angles exceeds 180°, scales differ in sign, or
        the translation is faster than `MAX_SPEED`.
    """

    def __init__(
        self,
        keyframes: Sequence[Keyframe],
        interpolation: str,
        *,
        key: str = "motions",
        file: object | None = None,
    ) -> None:
        self._times = np.array([k.time for k in keyframes], dtype=np.float64)
        n = len(keyframes)
        turns = _turn_angles(keyframes, key, file)
        rows: list[Array] = []
        side = 1.0  # a quaternion and its negative are the same rotation
        for i, k in enumerate(keyframes):
            scale = np.broadcast_to(np.asarray(k.scale, dtype=np.float64), (3,))
            q = side * _quaternion(k)
            if i and turns[i - 1] is None and q @ rows[-1][6:] < 0.0:
                side, q = -side, -q
            rows.append(np.concatenate([k.translate, scale, q]))
        self._values = np.array(rows)
        for i in range(n - 1):
            if np.any(self._values[i, 3:6] * self._values[i + 1, 3:6] < 0.0):
                raise InputError(
                    f"scale changes its sign between keyframes {i} and {i + 1}; it would vanish between them",
                    file=file,
                    key=key,
                )
        speeds = np.abs(np.diff(self._values[:, :3], axis=0)) / np.diff(self._times)[:, None]
        if not np.all(speeds <= MAX_SPEED):
            i = int(np.argmax(~(speeds <= MAX_SPEED).all(axis=1)))
            raise InputError(
                f"goes at {speeds[i].max():.3g} m/s from keyframe {i} to {i + 1}; at most {MAX_SPEED:g} m/s",
                file=file,
                key=key,
            )
        self._tangents = np.zeros_like(self._values)
        self._linear, self._monotone = interpolation == "linear", interpolation == "monotone"
        if not self._linear and n > 2:
            spans = (self._times[2:] - self._times[:-2])[:, None]
            self._tangents[1:-1] = (self._values[2:] - self._values[:-2]) / spans
        if self._monotone and n > 2:
            slopes = np.diff(self._values, axis=0) / np.diff(self._times)[:, None]
            self._tangents[1:-1] = without_overshoot(self._tangents[1:-1], slopes[:-1], slopes[1:])
        for i, k in enumerate(keyframes):
            if k.velocity is not None:
                self._tangents[i, :3] = k.velocity
        self._rotations: list[tuple[Array, float, float, float]] | None = None
        same_axis = self._monotone and None not in turns and any(turns)
        if same_axis or any(turn is not None and abs(turn) > 180.0 for turn in turns):
            self._set_rotations(keyframes, turns)

    def _set_rotations(self, keyframes: Sequence[Keyframe], turns: list[float | None]) -> None:
        """Set axis, angle [rad] and the rates [rad/s] at both ends of the rotation in each interval."""
        rates = [0.0] * len(keyframes)
        axes: list[Array] = []
        angles: list[float] = []
        for i, turn in enumerate(turns):
            axis, angle = _relative_rotation(self._values[i, 6:], self._values[i + 1, 6:])
            if turn is not None:
                of_keys = [own for own in map(_axis, keyframes[i : i + 2]) if own is not None]
                axis, angle = of_keys[0] if of_keys else axis, math.radians(turn)
            axes.append(axis)
            angles.append(angle)
        if not self._linear:
            for i in range(1, len(turns)):
                along = float(axes[i - 1] @ axes[i])
                if along**2 > 1.0 - SAME_AXIS:  # else the rotation stops before the axis changes
                    spans = np.diff(self._times[i - 1 : i + 2])
                    turned = np.array([angles[i - 1] * math.copysign(1.0, along), angles[i]])
                    rates[i] = float(turned.sum() / spans.sum())
                    if self._monotone:
                        rates[i] = float(without_overshoot(rates[i], *(turned / spans)))
        signs = [1.0 if i == 0 or axes[i - 1] @ axes[i] > 0.0 else -1.0 for i in range(len(turns))]
        self._rotations = []
        for i, angle in enumerate(angles):
            end = rates[i + 1] * (signs[i + 1] if i + 1 < len(signs) else 1.0)
            self._rotations.append((axes[i], angle, rates[i], end))

    @property
    def velocity_jumps(self) -> list[float]:
        """Times [s] at which the velocity is discontinuous."""
        n = len(self._times)
        if n == 1:
            return []
        if not self._linear:
            return [float(self._times[i]) for i in (0, n - 1) if self._tangents[i].any()]
        slopes = np.diff(self._values, axis=0) / np.diff(self._times)[:, None]
        slopes = np.concatenate([np.zeros((1, 10)), slopes, np.zeros((1, 10))])
        differ = np.abs(np.diff(slopes, axis=0)) > 1e-9 * np.abs(slopes).max(initial=0.0)
        wound = np.full(n, self._rotations is not None)
        return [float(time) for time in self._times[differ.any(axis=1) | wound]]

    def _interpolate(self, time: float) -> tuple[Array, Array]:
        """Interpolated components and their time derivatives, each (10,)."""
        times, values = self._times, self._values
        if time <= times[0] or len(times) == 1:
            return values[0], np.zeros(10)
        if time >= times[-1]:
            return values[-1], np.zeros(10)
        i, h, s = self._place(time)
        p, q = values[i], values[i + 1]
        if self._linear:
            return p + s * (q - p), (q - p) / h
        return hermite(s, h, p, q, self._tangents[i], self._tangents[i + 1])

    def _place(self, time: float) -> tuple[int, float, float]:
        """Number and length [s] of the interval between keyframes at ``time``, and the part of it before."""
        i = int(np.searchsorted(self._times, time, side="right")) - 1
        h = float(self._times[i + 1] - self._times[i])
        return i, h, float(time - self._times[i]) / h

    @property
    def times(self) -> list[float]:
        """Times [s] of the keyframes."""
        return [float(time) for time in self._times]

    def transform(self, time: float) -> tuple[Array, Array]:
        """Matrix (3, 3) and translation (3,) [m] of T(t): x ↦ A x + d."""
        value, rate = self._interpolate(time)
        return self._rotation_at(time, value[6:], rate[6:])[0] * value[3:6], value[:3]

    def _rotation_at(self, time: float, quaternion: Array, rate: Array) -> tuple[Array, Array]:
        """Rotation matrix (3, 3) and angular velocity (3,) [rad/s], from the interpolated quaternion and its
        rate, or from the interpolated angle.
        """
        times = self._times
        if self._rotations is None or not times[0] < time < times[-1]:
            real, imaginary = quaternion[0], quaternion[1:]
            turn = real * rate[1:] - rate[0] * imaginary + np.cross(imaginary, rate[1:])
            return _rotation(quaternion), 2.0 * turn / (quaternion @ quaternion)
        i, h, s = self._place(time)
        axis, angle, first, last = self._rotations[i]
        part, speed = (s * angle, angle / h) if self._linear else hermite(s, h, 0.0, angle, first, last)
        turn = np.concatenate([[math.cos(0.5 * part)], math.sin(0.5 * part) * axis])
        return _rotation(turn) @ _rotation(self._values[i, 6:]), speed * axis

    def moved(self, points: Array, start: float, time: float) -> Array:
        """Positions T(time) T(start)⁻¹ of ``points`` (n, 3) [m]."""
        if len(self._times) == 1:  # most handles do not move
            return points.copy()
        a0, d0 = self.transform(start)
        a, d = self.transform(time)
        return (points - d0) @ (a @ np.linalg.inv(a0)).T + d

    def velocity(self, points: Array, start: float, time: float) -> Array:
        """Time derivative (n, 3) [m/s] of ``moved``; where it jumps, the mean of both sides."""
        if len(self._times) == 1:
            return np.zeros_like(points)
        step = 1e-9 * float(np.diff(self._times).min())  # much shorter than steps in time
        a0, d0 = self.transform(start)
        rates = [self._rate(instant) for instant in (time - step, time + step)]
        a, d = (0.5 * (before + after) for before, after in zip(*rates, strict=True))
        return (points - d0) @ (a @ np.linalg.inv(a0)).T + d

    def _rate(self, time: float) -> tuple[Array, Array]:
        """Time derivatives of the matrix (3, 3) [1/s] and the translation (3,) [m/s] of `transform`."""
        value, rate = self._interpolate(time)
        rotation, angular = self._rotation_at(time, value[6:], rate[6:])
        turning = np.cross(angular, rotation.T).T
        return np.asarray(turning * value[3:6] + rotation * rate[3:6], dtype=np.float64), rate[:3]


@dataclass(frozen=True)
class Window:
    """The time span start ≤ t ≤ until [s] in which a handle or load acts, and ``fade`` [s] after it."""

    start: float
    until: float
    fade: float = 0.0

    @classmethod
    def of(cls, handle: Handle) -> Window:
        """The window of a scene's handle; one that starts before t = 0 starts at 0."""
        return cls(max(handle.start, 0.0), handle.until, handle.fade)

    def holds(self, t0: float, t1: float) -> bool:
        """Whether the step from t0 to t1 [s] lies within the window; steps end at its start and end."""
        slack = 1e-9 * max(t1 - t0, 0.0)
        return t0 >= self.start - slack and t1 <= self.until + slack

    def strength(self, t0: float, t1: float, at: float | None = None) -> float:
        """1 within the window, (1 − (t − until)/fade)⁴ at t = ``at`` (default t1) while fading, else 0."""
        if self.holds(t0, t1):
            return 1.0
        time = t1 if at is None else at
        if self.fade > 0.0 and t1 > self.until and t0 >= self.start:
            return max(0.0, min(1.0, 1.0 - (time - self.until) / self.fade)) ** 4
        return 0.0

    def events(self) -> list[float]:
        """Times [s] at which a step must end."""
        ends = [self.start, self.until]
        if self.fade > 0.0:
            ends.append(self.until + self.fade)
        return [t for t in ends if math.isfinite(t)]


STILL = Motion([Keyframe(time=0.0)], "linear")


def motion_of(scene: Scene, index: int) -> Motion:
    """The motion of the scene's handle ``index``; `STILL` for a handle without one."""
    handle = scene.handles[index]
    if handle.motion is None:
        return STILL
    if isinstance(handle.motion, Motion):  # of a program that drives it
        return handle.motion
    keyframes, key = scene.motions[handle.motion], f"motions.{handle.motion}"
    return Motion(keyframes, handle.interpolation, key=key, file=scene.source)
