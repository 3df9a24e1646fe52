"""Contact of sheets with obstacles and each other: thin, thick, fast, stiff, squeezed, in a ring, in a knot.

No triangles may cross in any state, and steps take at most `MAX_NEWTON` Newton iterations in the median.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from lyra_petsc.contact.crossings import self_crossings
from lyra_petsc.contact.overlaps import find_overlaps
from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.case import Verdict
from lyra_petsc.experiments.meshes import rectangle, resample_polyline
from lyra_petsc.experiments.stress.stress_scenes import (
    STEP,
    Content,
    Setting,
    scale,
)
from lyra_petsc.experiments.stress.verdicts import RunRecord
from lyra_petsc.experiments.verification.verification_case import FLOOR, grid
from lyra_petsc.parallel import on_root

MAX_NEWTON = 12
"""Allowed Newton iterations of a step, in the median."""

CELLS, RADIUS = 12, 0.3
"""Cells along a side of the sheet, and radius of the ball [m]."""


def _scene(setting: Setting, mesh: Any, contact: Content, obstacles: Content, **more: Any) -> Content:
    """A scene with the material of the base scene and without handles."""
    content = setting.content()
    return content | {"mesh": mesh, "handles": [], "contact": contact, "obstacles": obstacles} | more


def over_ball(
    setting: Setting,
    bench: Bench,
    stiffer: float = 1.0,
    speed: float = 0.0,
    thickness_in_edges: float = 0.0,
    gap: float = 0.01,
    friction: float = 0.0,
) -> Content:
    """A sheet of one square metre that falls on a ball."""
    ball = {"ball": {"sphere": {"center": [0.0, 0.0, 0.0], "radius": RADIUS}}}
    thickness = thickness_in_edges / CELLS
    contact = {"gap": gap, "thickness": thickness, "friction": friction}
    initial = {"velocity": [0.0, 0.0, -speed]}
    content = _scene(setting, _square(RADIUS + thickness + 0.02), contact, ball, initial=initial)
    return scale(content, stretching=stiffer)


def _square(height: float, side: float = 1.0, cells: int = CELLS, y: float = -0.48) -> Content:
    """The mesh of a square [m] whose centre is nearly above the origin."""
    shift = [-0.5 * side, y * side, height]
    return grid(side, side, cells, cells, "alternating") | {"transform": {"translate": shift}}


def on_needles(setting: Setting, bench: Bench) -> Content:
    """A sheet on a roof of triangles that are a thousand times as long as wide."""
    n = 1400
    x = np.linspace(-1.0, 1.0, n + 1)
    below = np.column_stack([x, np.full(n + 1, -1.0), np.full(n + 1, -1.0)])
    ridge = np.column_stack([x + 0.5 / n, np.zeros(n + 1), np.zeros(n + 1)])
    opposite = below * [1.0, -1.0, 1.0]
    i = np.arange(n)
    sides = []
    for first in (0, 2 * (n + 1)):
        sides += [[first + i, first + i + 1, n + 1 + i], [first + i + 1, n + 2 + i, n + 1 + i]]
    triangles = np.concatenate([np.stack(side, axis=1) for side in sides])
    roof = bench.mesh(np.concatenate([below, ridge, opposite]), triangles)
    return _scene(setting, _square(0.02), {"gap": 0.01}, {"roof": {"mesh": roof}})


def through_ring(setting: Setting, bench: Bench) -> Content:
    """A sheet that is pulled by its centre through a ring of 0.4 of its width."""
    n, radius, thick = 16, 0.1, 0.02
    angle = 2.0 * math.pi * np.arange(n + 1) / n
    corners = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(n + 1)]).tolist()
    ring = {
        f"part{k}": {"capsule": {"from": corners[k], "to": corners[k + 1], "radius": thick}} for k in range(n)
    }
    mesh = _square(thick + 0.02, 0.5, y=-0.5)
    middle = {"nodes": [(CELLS + 1) * (CELLS // 2) + CELLS // 2], "motion": "pull"}
    pull = [{"time": 0.0}, {"time": 80 * STEP, "translate": [0.0, 0.0, -0.6]}]
    scene = _scene(setting, mesh, {"gap": 0.005}, ring)
    return scene | {"handles": [middle], "motions": {"pull": pull}}


def pressed_layers(setting: Setting, bench: Bench) -> Content:
    """Ten layers on a plane with a pressure on the top one."""
    # pressure [Pa], and number of steps in which it grows
    pressure, ramp, layers, meshes = 1e5, 20, 10, []
    for layer in range(layers):
        shift = [-0.05 + 0.002 * (layer % 3), 0.003 * (layer % 2), 0.005 + 0.006 * layer]
        meshes.append(grid(0.1, 0.1, 3, 3) | {"name": f"layer{layer}", "transform": {"translate": shift}})
    group = f"layer{layers - 1}"
    # each step adds an increment of the pressure
    loads = [
        {"group": group, "traction": [0.0, 0.0, -increment], "from": STEP * k}
        for k, increment in enumerate(np.diff(np.geomspace(1e-4, 1.0, ramp + 1)) * pressure)
    ]
    return _scene(setting, meshes, {"gap": 0.004}, {"floor": FLOOR}, loads=loads)


def knot(setting: Setting, bench: Bench) -> Content:
    """A strip in an overhand knot, whose ends are pulled: a trefoil knot that is cut open at its outside."""
    # size of the knot [m], half the angle that is cut out of it [rad], length of its tails over its size
    size, cut, tail = 0.04, 0.2, 3.0
    # edge length [m], cells across, displacement of each end [m]
    edge, wide, pulled = 0.01, 2, 0.25
    t = np.linspace(cut, 2.0 * math.pi - cut, 2000) + math.pi / 3.0
    knot = np.column_stack(
        [np.sin(t) + 2.0 * np.sin(2.0 * t), np.cos(t) - 2.0 * np.cos(2.0 * t), -np.sin(3.0 * t)]
    )
    # tails that bend outwards from the cut
    s = np.linspace(0.0, tail, 200)[1:, None]
    outwards = np.array([math.sqrt(0.75), 0.5, 0.0])
    pull = knot[0] - knot[-1]
    pull /= np.linalg.norm(pull)
    tails = []
    for end, before in ((knot[0], knot[1]), (knot[-1], knot[-2])):
        tangent = (end - before) / np.linalg.norm(end - before)
        tails.append(end + 0.3 * (1.0 - np.exp(-s / 0.3)) * tangent + s * outwards)
    line = size * np.concatenate([tails[0][::-1], knot, tails[1]])
    length = float(np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))[-1])
    cells = round(length / edge)
    middle = resample_polyline(line, cells + 1)
    along = np.gradient(middle, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.array([0.0, 0.0, 1.0]) - along[:, 2:] * along
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    flat, faces = rectangle(cells, wide, length, wide * edge)
    side = np.arange(wide + 1.0) - 0.5 * wide
    start = (middle + edge * side[:, None, None] * across).reshape(-1, 3)
    row = (cells + 1) * np.arange(wide + 1)
    ends = {"first": (row, pulled * pull), "last": (row + cells, -pulled * pull)}
    handles = [{"nodes": nodes.tolist(), "motion": name} for name, (nodes, _) in ends.items()]
    motions = {
        name: [{"time": 0.0}, {"time": 80 * STEP, "translate": displacement.tolist()}]
        for name, (_, displacement) in ends.items()
    }
    mesh = bench.mesh(start, faces, rest=flat[:, :2])
    contact = {"gap": 0.4 * edge, "friction": 0.3}
    return _scene(setting, mesh, contact, {}) | {"handles": handles, "motions": motions}


def stack(setting: Setting, bench: Bench) -> Content:
    """A stack of sheets on a plane, in which vertices are in contact with sheets above and below."""
    layers, cells = 5, 107
    gap = 0.2 / cells
    # no sheet has its vertices above those of the sheet below
    shifts = [
        [0.3 * gap * (layer % 3), 0.4 * gap * (layer % 2), gap * (layer + 0.9)] for layer in range(layers)
    ]
    square = grid(1.0, 1.0, cells, cells, "alternating")
    meshes = [square | {"transform": {"translate": shift}} for shift in shifts]
    return _scene(setting, meshes, {"gap": gap, "friction": 0.3}, {"floor": FLOOR})


def contacts(trial: Trial) -> tuple[int, float]:
    """Numbers of crossings and of contacts."""
    return crossings(trial), trial.simulation.energy_balance.columns()["contacts"]


def many_contacts(setting: Setting, bench: Bench, record: RunRecord) -> Mapping[str, Verdict]:
    crossed, touching = zip(*record.observed, strict=True)
    largest, required = max(touching), 100_000
    return {
        **no_crossings(setting, bench, replace(record, observed=list(crossed))),
        "contacts": Verdict(largest >= required, f"{largest:.6g} contacts at most, asked for {required}"),
    }


def crossings(trial: Trial) -> int:
    """Number of pairs of crossing triangles, plus overlaps with obstacles, in the present state."""
    simulation, x = trial.simulation, trial.x
    mesh = simulation.problem.mesh  # on rank 0
    term: Any = simulation.problem.terms["contact"]

    def count() -> int:
        assert mesh is not None
        triangles = mesh.triangles.astype(np.int64)
        total = len(self_crossings(x, triangles))
        for one in term.obstacles.bodies:
            box = (simulation.scene.obstacles or {})[one.name].box is not None
            total += sum(map(len, find_overlaps(one, x, triangles, simulation.time, is_box=box)))
        return total

    return on_root(simulation.comm, count)


def no_crossings(setting: Setting, bench: Bench, record: RunRecord) -> Mapping[str, Verdict]:
    number, median = sum(record.observed), statistics.median(record.newton)
    iterations = f"{median:g} Newton iterations in the median, at most {MAX_NEWTON}"
    return {
        "crossings": Verdict(number == 0, f"{number} crossings in {len(record.observed)} states"),
        "iterations": Verdict(median <= MAX_NEWTON, iterations),
    }
