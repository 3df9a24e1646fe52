"""Measured curves of force over strain: reading, checks, and monotonic interpolation."""

from __future__ import annotations

import math
import re
from itertools import pairwise
from pathlib import Path

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.scene.text import read_text
from lyra_petsc.scene.values import cut

Points = tuple[tuple[float, float], ...]
LocatedPoint = tuple[str, float, float]
"""Text for messages that locates the point, as file and line; strain; force [N/m]."""

MAX_POINTS = 1000
"""Limit on the points of a curve: every triangle searches its strain among them."""


OTHER_UNITS = ("%", "°", "gf", "/cm", "/mm")
"""Units that a heading must not contain."""


def read_curve(path: Path) -> list[LocatedPoint]:
    """Read a file with strain and force in each line, separated by commas, semicolons or blanks.

    A first line without numbers is a heading, # begins a comment; quotes are ignored.

    Raises
    ------
    InputError
        The file cannot be read, or a line does not have two numbers.
    """
    points: list[LocatedPoint] = []
    remedy = f"thin the curve out to at most {MAX_POINTS} points"
    # limit on the bytes of a file
    text = read_text(path, largest=2**20, remedy=remedy)
    for number, line in enumerate(text.splitlines(), start=1):
        columns = re.sub("[;,\"']", " ", line.split("#")[0]).split()
        try:
            strain, force = map(float, columns)
            if not math.isfinite(strain + force):
                raise ValueError
        except ValueError:
            if not columns or (not points and columns[0][0].isalpha()):
                _refuse_units(line, path)
                continue
            raise InputError(
                f"{path}, line {number}: must be two numbers with decimal points, strain and force [N/m], "
                f"not {cut(line)!r}"
            ) from None
        points.append((f"{path}, line {number}", strain, force))
    return points


def _refuse_units(heading: str, path: Path) -> None:
    for unit in OTHER_UNITS:
        if unit in heading:
            raise InputError(
                f"{path}: its heading says {unit!r}; give strain as a fraction (0.05, not 5 %), "
                "force in N/m, and name no other units"
            )


def checked_points(points: list[LocatedPoint], whole: str = "the curve") -> Points:
    """Check a curve and insert (0, 0) if it is missing; ``whole`` names the curve in messages.

    Raises
    ------
    InputError
        Strain or force does not increase, or is not a curve in these units; the message locates the point.
    """
    count = sum(strain != 0.0 for _, strain, _ in points)
    if not points or count > MAX_POINTS:
        raise InputError(f"{whole} has {count} points; give 1 to {MAX_POINTS} (beside that at no strain)")
    where, strain, force = points[0]
    if strain == 0.0 and force != 0.0:
        raise InputError(f"{where}: the force at zero strain must be 0; subtract {force:g} N/m from all")
    if strain > 0.0:
        points = [("the origin", 0.0, 0.0), *points]
    elif strain < 0.0:
        raise InputError(
            f"{where}: strain {strain:g} is negative; begin at 0, under compression a curve is straight"
        )
    if len(points) == 1:
        raise InputError(f"{whole} has no point but the origin; give some with strain")
    for (_, x0, y0), (location, x1, y1) in pairwise(points):
        for column, before, after in (("strain", x0, x1), ("force", y0, y1)):
            if not after > before:
                raise InputError(
                    f"{location}: {column} {after:g} is not more than {before:g} before it; sort by strain "
                    "and leave out or smooth what does not grow"
                )
    location, strain, _ = points[-1]
    # limit on strains; larger numbers are percent or degrees
    if strain > 10.0:
        raise InputError(
            f"{location}: strain {strain:g} is {100.0 * strain:g} %; give fractions, as 0.05 for 5 %"
        )
    curve = tuple((x, y) for _, x, y in points)
    with np.errstate(all="ignore"):
        if not np.isfinite(interpolation(curve)).all():
            raise InputError(f"{whole} has slopes that are no numbers; points are too near one another")
    return curve


def force_at(points: Points, strain: float) -> float:
    """Force [N/m] of a curve at a strain ≥ 0."""
    rows = interpolation(points)
    i = min(int(np.searchsorted(rows[:, 0], strain)), len(rows)) - 1
    if i + 1 == len(rows):
        x, y, slope, _ = rows[-1]
        return float(y + slope * (strain - x))
    (x0, y0, d0, _), (x1, y1, d1, _) = rows[max(i, 0) : max(i, 0) + 2]
    h = x1 - x0
    t = (strain - x0) / h
    rise = (1.0 - t) ** 2 * h * d0 - t * (1.0 - t) * h * d1 + t * (3.0 - 2.0 * t) * (y1 - y0)
    return float(y0 + t * rise)


def interpolation(points: Points) -> Array:
    """Strain, force [N/m], slope [N/m] and integral of the force [N/m] at the points of a curve, (n, 4).

    The interpolation is cubic and monotonic (F. N. Fritsch, J. Butland, SIAM J. Sci. Stat. Comput. 5 (1984)
    300-304). Slopes at the ends are those of the first and last chord.
    """
    x, y = np.array(points).T
    width = np.diff(x)
    chord = np.diff(y) / width
    one, two = 2.0 * width[1:] + width[:-1], width[1:] + 2.0 * width[:-1]
    inside = (one + two) / (one / chord[:-1] + two / chord[1:])
    slope = np.concatenate([chord[:1], inside, chord[-1:]])
    area = width * (0.5 * (y[:-1] + y[1:]) + width * (slope[:-1] - slope[1:]) / 12.0)
    return np.column_stack([x, y, slope, np.concatenate([[0.0], np.cumsum(area)])])
