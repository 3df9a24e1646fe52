"""One source as its file has it: what the readers give to ``build``."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass
class NamedSet:
    """A group as read.

    Attributes
    ----------
    name : str
    dimension : int
        0 points, 1 curves, 2 surfaces.
    members : int64
        Points: vertices (n,); curves: vertex pairs (n, 2); surfaces: triangle indices (n,).
    """

    name: str
    dimension: int
    members: NDArray[np.int64]


@dataclass
class Sheet:
    """Vertices and triangles of one source, before transform and checks.

    Attributes
    ----------
    points : (V, 3) float64
        As in the file.
    triangles : (F, 3) int64
    uv : (F, 3, 2) float64 or None
        ``vt`` of each triangle's corners [m], where the file has them.
    groups : list of NamedSet
    notes : list of str
        What the reader dropped or split.
    tags : (V,) int64 or None
        Numbers that the file itself gives its vertices, where they are not 1, 2, 3, …
    """

    points: NDArray[np.float64]
    triangles: NDArray[np.int64]
    uv: NDArray[np.float64] | None = None
    groups: list[NamedSet] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    tags: NDArray[np.int64] | None = None
