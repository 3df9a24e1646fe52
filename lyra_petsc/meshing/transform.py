"""The start position of a source: scale, then rotate, then translate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError

Floats = NDArray[np.float64]


class Rotation(Protocol):
    """A rotation about an axis through the origin."""

    @property
    def axis(self) -> Sequence[float]: ...
    @property
    def degrees(self) -> float: ...


class Transform(Protocol):
    """The ``mesh.transform`` block of a scene, applied in this order."""

    @property
    def scale(self) -> float | Sequence[float]: ...
    @property
    def rotate(self) -> Rotation | None: ...
    @property
    def translate(self) -> Sequence[float]: ...


def scaled(points: Floats, transform: Transform | None, *, key: str, file: object | None) -> Floats:
    """``points`` (n, 3) times the scale (one factor, or one per axis).

    Raises
    ------
    InputError
        A factor that is 0 or not finite.
    """
    if transform is None:
        return points
    factor = np.asarray(transform.scale, dtype=np.float64)
    if factor.shape not in ((), (3,)) or not np.isfinite(factor).all() or (factor == 0).any():
        raise InputError(
            "one factor or three, finite and not 0, are needed", key=f"{key}.transform.scale", file=file
        )
    return points * factor


def moved(points: Floats, transform: Transform | None, *, key: str, file: object | None) -> Floats:
    """``points`` (n, 3) [m] after rotation and translation.

    Raises
    ------
    InputError
        An axis of no length, or numbers that are not finite.
    """
    if transform is None:
        return points
    translate = np.asarray(transform.translate, dtype=np.float64)
    if translate.shape != (3,) or not np.isfinite(translate).all():
        raise InputError("three finite numbers [m] are needed", key=f"{key}.transform.translate", file=file)
    if transform.rotate is None:
        return points + translate
    try:
        matrix = rotation_matrix(transform.rotate.axis, transform.rotate.degrees)
    except ValueError as error:
        raise InputError(str(error), key=f"{key}.transform.rotate", file=file) from None
    return points @ matrix.T + translate


def rotation_matrix(axis: Sequence[float], degrees: float) -> Floats:
    """Rotation matrix (3, 3) about ``axis``, right-handed; exact for multiples of 90° about x, y or z.

    Raises
    ------
    ValueError
        If the axis has no length or a number is not finite.
    """
    direction = np.asarray(axis, dtype=np.float64)
    if direction.shape != (3,) or not np.isfinite(direction).all() or not math.isfinite(degrees):
        raise ValueError("an axis of three finite numbers and a finite angle [°] are needed")
    largest = float(np.abs(direction).max())
    if largest == 0.0:
        raise ValueError("the axis has no length")
    direction = direction / largest
    direction /= np.linalg.norm(direction)
    quarter, rest = divmod(degrees, 90.0)
    if rest == 0.0:
        # cos 90° is 6e-17 in floating point: a sheet turned upright would no longer be flat
        cosine, sine = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarter % 4)]
    else:
        cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    x, y, z = direction
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix: Floats = cosine * np.eye(3) + sine * cross + (1.0 - cosine) * np.outer(direction, direction)
    return matrix
