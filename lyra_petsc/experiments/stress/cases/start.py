"""Shapes that no sheet starts from, and sheets that nothing holds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.meshes import rectangle
from lyra_petsc.experiments.stress.base import CELLS
from lyra_petsc.experiments.stress.case import QUICK, Case, Content, Setting, family
from lyra_petsc.experiments.stress.changes import changed, release

Array = NDArray[np.float64]

NOISE = 0.3
"""Standard deviation of each coordinate over the mean edge length."""

FOLDS = 12
RISE = 0.15
"""Of the dome, m."""


def _noisy(x: Array, spacing: float) -> Array:
    return np.asarray(x + NOISE * spacing * np.random.default_rng(1).standard_normal(x.shape))


def _crumpled(x: Array, spacing: float) -> Array:
    """Folded again and again, at random planes near the middle of what the folds before have left."""
    random = np.random.default_rng(2)
    y = x - x.mean(axis=0)
    for _ in range(FOLDS):
        normal = random.standard_normal(3)
        normal /= np.linalg.norm(normal)
        height = y @ normal
        height -= height.mean() + 0.1 * np.ptp(height) * random.uniform(-1.0, 1.0)
        y = y - 2.0 * np.maximum(height, 0.0)[:, None] * normal
    return np.asarray(y + x.mean(axis=0))


def _folded(x: Array, spacing: float) -> Array:
    """Flat on itself: what is beyond the vertex nearest to the middle of the longest side, mirrored there."""
    axis = int(np.argmax(np.ptp(x, axis=0)))
    middle = 0.5 * (x[:, axis].min() + x[:, axis].max())
    # through a vertex: cells cut in their middle would lose all their area
    crease = x[np.argmin(np.abs(x[:, axis] - middle)), axis]
    y = x.copy()
    y[:, axis] = crease - np.abs(x[:, axis] - crease)
    return y


def _mirrored(x: Array, spacing: float) -> Array:
    """The other way up, where a curved shell would rather not be."""
    y = x.copy()
    y[:, 2] = 2.0 * x[:, 2].min() - x[:, 2]
    return y


def _dome(setting: Setting, bench: Bench) -> Content:
    """A shell held at its rim; of a given scene its own sheet, without handles."""
    content = setting.content()
    if setting.given:
        return release(content)
    n = CELLS[setting.level]
    vertices, triangles = rectangle(n, n, 1.0, 1.0)
    u, v = 2.0 * vertices[:, 0] - 1.0, 2.0 * vertices[:, 1] - 1.0
    vertices[:, 2] = RISE * (1.0 - u**2) * (1.0 - v**2)
    rim = np.flatnonzero(np.maximum(np.abs(u), np.abs(v)) > 1.0 - 1e-9)
    return content | {"mesh": bench.mesh(vertices, triangles), "handles": [{"nodes": rim.tolist()}]}


start = family(
    "start",
    "start shapes: noise, a crumpled ball, a flat fold, a shell turned inside out",
    Case("noise", "random noise of 0.3 elements, no handle", changed(release), shape=_noisy),
    Case("crumpled", "crumpled into a ball", changed(release), shape=_crumpled),
    Case("folded", "folded flat, a crease of 180°", changed(release), shape=_folded, level=QUICK),
    Case("inside-out", "a shell turned inside out", _dome, shape=_mirrored),
)

SPIN = [3.0, 20.0, 1.0]
"""rad/s"""


def _tumbling(setting: Setting, bench: Bench) -> Content:
    content = changed(release)(setting, bench)
    content["initial"] = {**(content.get("initial") or {}), "angular_velocity": SPIN}
    return content


free = family(
    "free",
    "no handle: falling, and tumbling",
    Case("falling", "no handle, released at rest", changed(release), level=QUICK),
    Case("tumbling", "no handle, thrown with 20 rad/s", _tumbling),
)
