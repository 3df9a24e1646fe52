"""Values of scene keys that may change in time: a number or vector, points [t, value], or a file of them.

In a scene such a value is a plain number or vector, or a tuple of points; `TimeCurve.of` makes either a
function of time.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, get_args

import numpy as np
from pydantic import BeforeValidator, ValidationInfo, WithJsonSchema
from pydantic_core import PydanticCustomError

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.scene.block import Block, attributes
from lyra_petsc.scene.text import read_text
from lyra_petsc.scene.values import Vec3, cut, number, path_beside, problem, require, shown, vector

NumberPoints = tuple[tuple[float, float], ...]
VectorPoints = tuple[tuple[float, Vec3], ...]

MAX_POINTS = 10_000
"""Limit on the points of a curve: steps end at each where the slope changes."""

STRAIGHT = 1e-9
"""Distance of a point from the chord of its neighbours, over the largest value, below which it is no kink."""

IN_TIME = "may change in time"
"""Mark of the types of such values, by which `curves` knows them from other lists."""

Point = tuple[str, float, Any]
"""Text for messages that locates the point, as file and line; its time, or load factor; its value."""


@dataclass(frozen=True, eq=False)
class TimeCurve:
    """A value that is linear in time between points, and held before the first and after the last.

    In a static analysis the load factor replaces the time.

    Attributes
    ----------
    times : (n,)
        Strictly ascending [s].
    values : (n,) or (n, 3)
    unit : str
        Of the values, for messages.
    grows : bool
        Whether the value is the only one of ``values`` times t instead: that of a load in a static analysis.
    """

    times: Array
    values: Array
    grows: bool = False
    unit: str = ""

    @classmethod
    def of(cls, value: Any, *, grows: bool = False) -> TimeCurve:
        """The curve of a scene's value: of points, or constant. A plain value ``grows`` with the time."""
        if isinstance(value, TimeCurve):  # of a program that drives it
            return value
        points = value if is_curve(value) else ((0.0, value),)
        times, values = (np.array(part, dtype=np.float64) for part in zip(*points, strict=True))
        return cls(times, values, grows=grows and not is_curve(value))

    def at(self, time: float) -> Array:
        """The value, () or (3,), at a time [s]."""
        if self.grows:
            return np.asarray(time * self.values[0])
        i = min(max(int(np.searchsorted(self.times, time, side="right")) - 1, 0), len(self.times) - 1)
        j = min(i + 1, len(self.times) - 1)
        if i == j or time <= self.times[i]:
            return np.asarray(self.values[i])
        part = (time - self.times[i]) / (self.times[j] - self.times[i])
        return np.asarray((1.0 - part) * self.values[i] + part * self.values[j])

    @property
    def varies(self) -> bool:
        """Whether there are several points."""
        return len(self.times) > 1

    @property
    def acts(self) -> bool:
        """Whether it is ever other than zero."""
        return bool(self.values.any())

    @property
    def kinks(self) -> list[float]:
        """Times [s] at which the slope changes."""
        values = self.values.reshape(len(self.times), -1)
        slopes = np.diff(values, axis=0) / np.diff(self.times)[:, None]
        still = np.zeros((1, values.shape[1]))
        changes = np.abs(np.diff(np.concatenate([still, slopes, still]), axis=0))
        spans = np.diff(self.times, prepend=self.times[0], append=self.times[-1])
        reach = np.maximum(spans[:-1], spans[1:])[:, None]
        return [float(t) for t in self.times[(changes * reach > STRAIGHT * np.abs(values).max()).any(axis=1)]]

    def __str__(self) -> str:
        span = f"{len(self.times)} points from {self.times[0]:g} to {self.times[-1]:g}"
        return f"{span}, up to {np.linalg.norm(self.largest):.4g} {self.unit}".rstrip()

    @property
    def largest(self) -> Array:
        """The value, () or (3,), of largest magnitude."""
        sizes = np.linalg.norm(self.values.reshape(len(self.times), -1), axis=1)
        return np.asarray(self.values[int(np.argmax(sizes))])


def curves(block: Block, at: str = "") -> dict[str, TimeCurve]:
    """The values that change in time in a block and the blocks in it, by their keys."""
    result: dict[str, TimeCurve] = {}
    for name, field in type(block).model_fields.items():
        value, key = getattr(block, name), f"{at}{field.alias or name}"
        inner: dict[str, Any] = {}
        if isinstance(value, Block):
            inner = {key: value}
        elif isinstance(value, dict):
            inner = {f"{key}.{part}": entry for part, entry in value.items()}
        elif isinstance(value, list):
            inner = {f"{key}[{number}]": entry for number, entry in enumerate(value)}
        elif is_curve(value) and (IN_TIME in field.metadata or _may_be_curve(field.annotation)):
            result[key] = replace(TimeCurve.of(value), unit=attributes(type(block))[name].unit)
        for part, entry in inner.items():
            if isinstance(entry, Block):
                result |= curves(entry, f"{part}.")
    return result


def _may_be_curve(annotation: Any) -> bool:
    marked = IN_TIME in getattr(annotation, "__metadata__", ())
    return marked or any(map(_may_be_curve, get_args(annotation)))


def kink_times(block: Block) -> list[float]:
    """Times [s], or load factors, at which values in a block have kinks."""
    return [time for curve in curves(block).values() for time in curve.kinks]


def is_curve(value: Any) -> bool:
    """Whether a scene's value is a list of points, or driven by a program; not a number or vector."""
    if isinstance(value, TimeCurve):
        return True
    return isinstance(value, (list, tuple)) and len(value) > 0 and isinstance(value[0], (list, tuple))


def plain_values(value: Any) -> Iterator[Any]:
    """The number or vector of a scene's value, or those of all its points."""
    if is_curve(value):
        yield from (entry for _, entry in value)
    else:
        yield value


def largest(value: Any) -> Array:
    """The number or vector of largest magnitude of a scene's value; zero if it is absent."""
    return np.zeros(()) if value is None else TimeCurve.of(value).largest


def acts(value: Any) -> bool:
    """Whether a scene's value is ever other than zero."""
    return value is not None and TimeCurve.of(value).acts


def read_points(path: Path, columns: int) -> list[Point]:
    """Read a file with a time and ``columns`` numbers in each line below a heading.

    They are separated by commas, semicolons or blanks; # begins a comment, quotes are ignored.

    Raises
    ------
    InputError
        The file cannot be read, or a line does not have these numbers.
    """
    text = read_text(path, largest=2**22, remedy=f"thin the curve out to at most {MAX_POINTS} points")
    names = "time [s] and value" if columns == 1 else "time [s] and x, y, z"
    points: list[Point] = []
    heading = False
    for line_number, line in enumerate(text.splitlines(), start=1):
        words = re.sub("[;,\"']", " ", line.split("#")[0]).split()
        where = f"{path}, line {line_number}"
        if not words:
            continue
        if not heading:
            heading = True
            if all(map(_is_number, words)):
                raise InputError(f"{where}: put a heading before the numbers, as in 'time, value'")
            continue
        try:
            time, *values = [number(float(word)) for word in words]
        except ValueError:
            values = []
        if len(values) != columns:
            count = f"{columns + 1} finite numbers with decimal points"
            raise InputError(f"{where}: must be {count}, {names}, not {cut(line)!r}")
        points.append((where, time, values[0] if columns == 1 else tuple(values)))
    return points


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _checked(points: list[Point], whole: str) -> tuple[tuple[float, Any], ...]:
    """The points, in the order of their times; ``whole`` names the curve in messages."""
    if not 1 <= len(points) <= MAX_POINTS:
        raise InputError(f"{whole} has {len(points)} points; give 1 to {MAX_POINTS}")
    for (_, before, _), (where, time, _) in pairwise(points):
        if not time > before:
            raise InputError(
                f"{where}: time {time:g} is not later than {before:g} before it; sort by time, and give each "
                "time once (a jump as two times near each other)"
            )
    curve = tuple((time, value) for _, time, value in points)
    with np.errstate(all="ignore"):
        times, values = (np.array(part) for part in zip(*curve, strict=True))
        slopes = np.diff(values.reshape(len(times), -1), axis=0) / np.diff(times)[:, None]
    require(np.isfinite(slopes).all(), f"{whole} has slopes that are no numbers; move its points apart")
    return curve


def _in_time(value: Any, info: ValidationInfo, *, of_vector: bool) -> Any:
    """A plain value, or points; stored scenes have points, and so do not need a file."""
    plain: Any = vector if of_vector else number
    form = "[[0, [0, 0, 0]], [1, [0, 0, 5]]]" if of_vector else "[[0, 0], [1, 5]]"
    try:
        if isinstance(value, str) and value.strip().lower().endswith(".csv") and "\0" not in value:
            path = path_beside(value, info)
            return _checked(read_points(path, 3 if of_vector else 1), str(path))
        if is_curve(value) or (isinstance(value, (list, tuple)) and not of_vector):
            points = []
            for count, point in enumerate(value, start=1):
                pair = isinstance(point, (list, tuple)) and len(point) == 2
                require(pair, f"point {count} must be [time, value], as in {form}, not {shown(point)}")
                try:
                    points.append((f"point {count}", number(point[0]), plain(point[1])))
                except PydanticCustomError as error:
                    raise problem(f"point {count}: {error.message()}") from None
            return _checked(points, "the curve")
    except InputError as error:
        raise problem(": ".join(part for part in (error.file, error.message) if part)) from None
    return plain(value)


def _schema(plain: dict[str, Any]) -> WithJsonSchema:
    """JSON Schema of a plain value, points of it, or a file of them."""
    point = {"type": "array", "prefixItems": [{"type": "number"}, plain], "minItems": 2, "maxItems": 2}
    file = {"type": "string", "pattern": r"\.[cC][sS][vV]\s*$"}
    return WithJsonSchema({"anyOf": [plain, {"type": "array", "items": point, "minItems": 1}, file]})


_NUMBER: dict[str, Any] = {"type": "number"}
_VECTOR: dict[str, Any] = {"type": "array", "items": _NUMBER, "minItems": 3, "maxItems": 3}

NumberInTime = Annotated[
    float | NumberPoints, BeforeValidator(partial(_in_time, of_vector=False)), _schema(_NUMBER), IN_TIME
]
VectorInTime = Annotated[
    Vec3 | VectorPoints, BeforeValidator(partial(_in_time, of_vector=True)), _schema(_VECTOR), IN_TIME
]
