"""Tubes as rectangles that are rolled, open along a line or closed, as .obj files with curves to sew."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

RADIUS, LENGTH = 0.1, 0.2
"""Of the closed tube [m]."""

GAPING = 0.77
"""Curvature of the front, over that of the closed tube, with a line open by 5 % of the circumference."""


def tube(
    path: Path,
    around: int = 16,
    along: int = 3,
    *,
    closed: bool = False,
    front: float = 1.0,
    flat: bool = True,
    begin: float = 0.0,
) -> dict[str, Any]:
    """A tube along x, sewn along its line in front, at the largest y. Its rest shape is flat or itself.

    Groups are ``one`` and ``other`` of both sides of the line unless it is ``closed``, the ends ``left`` at
    x = ``begin`` and ``right``, and ``back``: the three lines at the smallest y. ``front`` is the curvature
    of the front half over that of the back one.
    """
    columns = around + 1
    s, x = np.meshgrid(np.linspace(-1.0, 1.0, columns), begin + np.linspace(0.0, LENGTH, along + 1))
    angle = np.pi * s.ravel()  # from the back
    beyond = front * (np.abs(angle) - 0.5 * np.pi)
    y = np.where(beyond > 0.0, np.sin(beyond) / front, -np.cos(angle))
    z = np.where(beyond > 0.0, np.sign(angle) * (1.0 - (1.0 - np.cos(beyond)) / front), np.sin(angle))
    points = np.column_stack([x.ravel(), RADIUS * y, RADIUS * z])
    number = np.arange(len(points)).reshape(along + 1, columns)
    place = number.copy()
    if closed:
        place[:, -1] = place[:, 0]
    lines = [f"v {a!r} {b!r} {c!r}" for a, b, c in points.tolist()]
    lines += [f"vt {a!r} {RADIUS * b!r}" for a, b in zip(x.ravel(), angle, strict=True)] if flat else []
    for j in range(along):
        for i in range(around):
            quad = (j, i), (j, i + 1), (j + 1, i + 1), (j + 1, i)
            corners = [f"{place[at] + 1}/{number[at] + 1}" if flat else f"{place[at] + 1}" for at in quad]
            split = ((0, 2, 1), (0, 3, 2)) if (i + j) % 2 else ((0, 3, 1), (1, 3, 2))
            lines += ["f " + " ".join(corners[k] for k in triangle) for triangle in split]
    half = around // 2
    curves = [("left", place[0]), ("right", place[-1])]
    curves += [("back", place[:, half + column]) for column in (-1, 0, 1)]
    if not closed:
        curves += [("one", place[:, 0]), ("other", place[:, -1])]
    for name, vertices in curves:
        lines += [f"g {name}", "l " + " ".join(str(vertex + 1) for vertex in vertices)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return {"file": str(path)}
