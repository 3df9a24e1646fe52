"""Cases with bad elements, with shapes that no sheet starts from, with nothing held, and with violent
handles.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.case import Verdict
from lyra_petsc.experiments.meshes import rectangle
from lyra_petsc.experiments.stress.step_balance import Record
from lyra_petsc.experiments.stress.stress_scenes import (
    CELLS,
    QUICK,
    Content,
    Setting,
    StressCase,
    changed,
    family,
    move,
    release,
    scale,
)
from lyra_petsc.terms.stretch import SOFTENS_BELOW

Array = NDArray[np.float64]

NOISE = 0.3
"""Standard deviation of each coordinate over the mean edge length."""

FOLDS = 12
RISE = 0.15
"""Of the dome, m."""


def _noisy(x: Array, spacing: float) -> Array:
    return np.asarray(x + NOISE * spacing * np.random.default_rng(1).standard_normal(x.shape))


def _crumpled(x: Array, spacing: float) -> Array:
    """Folded repeatedly along random planes near the middle of the shape that previous folds have left."""
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
    """Turned inside out, where a curved shell is not at rest."""
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
    StressCase("noise", "random noise of 0.3 elements, no handle", changed(release), shape=_noisy),
    StressCase("crumpled", "crumpled into a ball", changed(release), shape=_crumpled),
    StressCase("folded", "folded flat, a crease of 180°", changed(release), shape=_folded, level=QUICK),
    StressCase("inside-out", "a shell turned inside out", _dome, shape=_mirrored),
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
    StressCase("falling", "no handle, released at rest", changed(release), level=QUICK),
    StressCase("tumbling", "no handle, thrown with 20 rad/s", _tumbling),
)


ASPECT, RATIO = 1e3, 1e4
"""Of a sliver's sides, and of the sizes of elements in one mesh."""


def _slivers(setting: Setting, bench: Bench) -> Content:
    """A strip held at one end, two cells long and a hundred high."""
    nx, ny = 2, 100
    mesh = bench.mesh(*rectangle(nx, ny, 1.0, ny / nx / ASPECT))
    return setting.content() | {"mesh": mesh, "handles": [{"nodes": [j * (nx + 1) for j in range(ny + 1)]}]}


def _graded(setting: Setting, bench: Bench) -> Content:
    """A square held at two corners whose cells grow from one corner on."""
    n = 24
    sizes = RATIO ** (np.arange(n) / (n - 1.0))
    places = np.concatenate([[0.0], np.cumsum(sizes)]) / sizes.sum()
    vertices, triangles = rectangle(n, n, float(n), float(n))
    vertices[:, :2] = places[np.rint(vertices[:, :2]).astype(np.int64)]
    return setting.content() | {"mesh": bench.mesh(vertices, triangles), "handles": [{"nodes": [0, n]}]}


def _one_triangle(setting: Setting, bench: Bench) -> Content:
    """Hung by one corner, a thousand times as stiff."""
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.3, 0.9, 0.0]])
    content = scale(setting.content(), stretching=1e3)
    return content | {"mesh": bench.mesh(vertices, np.array([[0, 1, 2]])), "handles": [{"nodes": [0]}]}


elements = family(
    "elements",
    "slivers, elements of very different sizes, a single one",
    StressCase("slivers", "triangles with sides as 1 to 1000", _slivers, own=True, level=QUICK),
    StressCase("graded", "elements whose sizes differ by 1e4", _graded, own=True),
    StressCase("one-triangle", "a single stiff triangle", _one_triangle, steps=40, own=True, level=QUICK),
)


JUMP = (0.15, 0.1, 0.2)
"""Over the size of the sheet."""

TURNS = 10.0
"""1/s"""

SIDES = [{"group": "left"}, {"group": "right"}]
STEPS = 40


def _jump(setting: Setting, bench: Bench) -> Content:
    far = [part * setting.size for part in JUMP]
    still = {"time": 2.0 * setting.step}
    return move(setting.content(), [{"time": 0.0}, still, {"time": 3.0 * setting.step, "translate": far}])


def spinning(setting: Setting, bench: Bench) -> Content:
    quarters = int(4.0 * TURNS * STEPS * setting.step) + 2
    turn = [
        {"time": k / (4.0 * TURNS), "rotate": {"axis": [0.0, 0.0, 1.0], "degrees": 90.0 * k}}
        for k in range(quarters)
    ]
    return move(setting.content(), turn)


def _pull(setting: Setting, bench: Bench, to: float) -> Content:
    """Scale the handles' places along x; without a scene of the user, both sides are held."""
    content = setting.content()
    if not setting.given:
        content["handles"] = [dict(side) for side in SIDES]
    end = 0.75 * STEPS * setting.step
    return move(content, [{"time": 0.0}, {"time": end, "scale": [to, 1.0, 1.0]}])


handles = family(
    "handles",
    "handles that jump, spin, squeeze and stretch",
    StressCase("jump", "handles jump by a quarter of the sheet in one step", _jump, level=QUICK),
    StressCase("spin", "handles turn ten times a second", spinning, steps=STEPS),
    StressCase("squeeze", "handles come together to a tenth", partial(_pull, to=0.1), steps=STEPS),
    StressCase("stretch", "handles go apart threefold", partial(_pull, to=3.0), steps=STEPS, level=QUICK),
)

# -- a membrane that cannot buckle, pressed beyond where its model softens -------------------------------

TO = 0.4
"""Of the width, well below 1/√3."""


def _pressed(setting: Setting, bench: Bench) -> Content:
    content = setting.content() | {"handles": [dict(side) for side in SIDES]}
    move(content, [{"time": 0.0}, {"time": STEPS * setting.step, "scale": [TO, 1.0, 1.0]}])
    # a plane that the sheet cannot leave
    content["handles"].append({"group": "sheet", "axes": ["z"]})
    return content


def _reached(setting: Setting, bench: Bench, record: Record) -> Mapping[str, Verdict]:
    smallest = record.stretches[0]
    return {"compressed": Verdict(smallest < SOFTENS_BELOW, f"to {smallest:.3f} of its length")}


compression = family(
    "compression",
    "a membrane pressed in its plane beyond a stretch of 1/√3",
    StressCase(
        "pressed", "pressed in its plane to 0.4 of its width", _pressed, steps=STEPS, own=True,
        judge=_reached, level=QUICK,
    ),
)  # fmt: skip
