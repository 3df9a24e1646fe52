"""Sheets that bend over obstacles: a ruck, strips at a pole and at the edge of a table, drapes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.drape import (
    CLOTH,
    DISC,
    STARTS,
    drape_cloth,
    drape_coefficient,
    drape_scene,
    shadow,
)
from lyra_petsc.experiments.meshes import irregular_rectangle, rectangle, ring_disc, square_to_disc
from lyra_petsc.experiments.verification.cases.contacts import placed
from lyra_petsc.experiments.verification.flat_plates import plate_material
from lyra_petsc.experiments.verification.verification_case import (
    FLOOR,
    Measured,
    grid,
    isotropic,
    load_data,
    scene,
)

# -- ruck ------------------------------------------------------------------------------------------------

RUCK = load_data("ruck")


def _small_ruck(s: Array, half_length: float, height: float) -> Array:
    """Positions (n, 2) of a ruck with small slopes at arc length s from its middle: w'''' + k² w'' = −1."""
    k = 4.493409457909064 / half_length  # tan z = z
    x = np.linspace(0.0, half_length, 2001)
    edge = np.cos(k * half_length)
    w = 0.5 * (half_length**2 - x**2) + (edge - np.cos(k * x)) / (k * k * edge)
    w *= height / w[0]
    along = np.append(0.0, np.cumsum(np.hypot(np.diff(x), np.diff(w))))
    beyond = np.maximum(s - along[-1], 0.0)
    return np.column_stack([np.interp(s, along, x) + beyond, np.interp(s, along, w)])


def ruck(bench: Bench, n: float) -> Iterator[Measured]:
    # half the length of the sheet over l, gap over l, C l²/B
    half, ruck_gap, membrane = 3.0, 1e-4, 1e4
    # Δt over √(l/g), long so that backward Euler damps the motion; steps in which the end moves, then rests
    step, steps = 1.0, 8
    cells = round(n)
    flat, faces = rectangle(cells, 1, half, half / n)
    along, rows = flat[:, 0], RUCK["rows"]
    _, half_length, _, height = rows[0]
    start = _small_ruck(along, half_length, height)
    frames: list[dict[str, Any]] = [{"time": 0.0}]
    for force, _, shortening, _ in rows:
        # includes the elastic shortening by the force
        displacement = half * (1.0 - force / membrane) - 0.5 * shortening - float(start[:, 0].max())
        begin = frames[-1]["time"]
        for time in (begin + steps * step, begin + 2 * steps * step):
            frames.append({"time": time, "translate": [displacement, 0.0, 0.0]})
    ends = [[0, cells + 1], [cells, 2 * cells + 1]]
    content = scene(
        bench.mesh(
            np.column_stack([start[:, 0], flat[:, 1], start[:, 1] + 0.95 * ruck_gap]), faces, rest=flat[:, :2]
        ),
        plate_material(membrane),
        {"end": frames[-1]["time"], "step": step},
        gravity=[0.0, 0.0, -1.0],
        handles=[
            {"nodes": ends[0], "symmetry": "x"},
            {"nodes": ends[1], "axes": ["x"], "motion": "push", "interpolation": "linear"},
            {"nodes": list(range(len(flat))), "axes": ["y"]},
        ],
        motions={"push": frames},
        contact={"gap": ruck_gap, "self": False},
        obstacles={"floor": FLOOR},
        solver={"force_tolerance": 1e-7, "step_tolerance": 1e-7},
    )
    with bench.simulation(content) as trial:
        for (force, half_length, _, height), frame in zip(rows, frames[2::2], strict=True):
            trial.run_to(frame["time"])
            push = trial.gather(trial.simulation.energy_balance.reaction)[ends[1], 0]
            z = trial.x[:, 2] - trial.x[ends[1], 2].mean()
            root = np.cbrt(z / z.max())
            foot = (root > 0.1) & (root < 0.45)  # the range in which it is linear along the sheet
            lifted = float(np.polyfit(root[foot], along[foot], 1)[1])
            label = f"P = {force:g} B/l²"
            yield Measured(f"P l²/B, {label}", -float(push.sum()) * n / half, force)
            yield Measured(f"height / l, {label}", float(z.max()), height)
            yield Measured(f"half length / l, {label}", lifted, half_length)


# -- against a pole, over an edge ------------------------------------------------------------------------


def _refined(
    bench: Bench,
    n: float,
    end: float,
    shift: Callable[[float], list[float]],
    degrees: float,
    held: list[dict[str, Any]],
    obstacles: dict[str, Any],
    friction: float = 0.0,
) -> Iterator[Measured]:
    """Change of the ends of a strip at ``end`` [s] when Δt, h or gap are refined from 2/n to 1/n of the
    coarsest.

    The strip is turned by ``degrees`` and moved by ``shift`` [m], a function of the gap [m].
    """
    # length of a strip [m]; cells along it, Δt [s] and gap [m], of which one at a time is refined
    length, coarse_cells, coarse_step, coarse_gap = 0.3, 12, 0.004, 0.002
    fabric = {"density": 0.2, "membrane": isotropic(200.0), "bending": 2e-4}
    falls = {
        "gravity": [0, 0, -9.81],
        "handles": [*held, {"group": "sheet", "axes": ["y"]}],
        "obstacles": obstacles,
        # looser than the default of cases because of the impacts
        "solver": {"force_tolerance": 1e-8, "step_tolerance": 1e-8},
    }
    for label in ("Δt", "h", "gap"):
        ends: list[Array] = []
        for part in (0.5 * n, n):
            # with long steps the friction of bouncing parts would hide the effect of the gap
            step = coarse_step / {"Δt": part, "h": 1.0, "gap": 4.0}[label]
            gap = coarse_gap / part if label == "gap" else coarse_gap
            cells = round(coarse_cells * part) if label == "h" else coarse_cells
            strip = scene(
                placed(grid(length, length / cells, cells, 1, "alternating"), shift(gap), degrees),
                fabric,
                {"end": end, "step": step},
                contact={"gap": gap, "self": False, "friction": friction},
                **falls,
            )
            with bench.simulation(strip) as trial:
                ends.append(trial.run().x[[0, cells]])
        change = float(np.abs(ends[1] - ends[0])[:, ::2].max())
        yield Measured(f"change of the ends, {label} halved", change, 0.0, "m", scale=length)


def pole(bench: Bench, n: float) -> Iterator[Measured]:
    low, high = ([-0.03, y, -0.15] for y in (-1.0, 1.0))
    obstacles = {"pole": {"capsule": {"from": low, "to": high, "radius": 0.02}}}
    yield from _refined(bench, n, 0.3, lambda gap: [0.0, 0.0, 0.0], 30.0, [{"group": "left"}], obstacles)


def table_edge(bench: Bench, n: float) -> Iterator[Measured]:
    obstacles = {"table": {"box": {"min": [-1.0, -1.0, -0.5], "max": [0.0, 1.0, 0.0]}}}

    def on_it(gap: float) -> list[float]:
        return [-0.13, 0.0, 0.95 * gap]

    yield from _refined(bench, n, 0.2, on_it, 0.0, [], obstacles, friction=0.2)


# -- Cusick's drape test ---------------------------------------------------------------------------------

MESHES = ("diagonal", "alternating", "irregular", "rings")


def _disc(kind: str, n: int, random: np.random.Generator) -> tuple[Array, Ints]:
    """A randomly rotated disc of radius 1: rings, or a square of n × n cells mapped smoothly.

    Rotated, since folds of coarse meshes follow edges, which would have a fixed direction to warp and weft.
    """
    if kind == "rings":
        flat, faces = ring_disc(round(n / math.sqrt(3.0)))  # as many triangles as the others
    else:
        if kind == "irregular":
            flat, faces = irregular_rectangle(n, n, 2.0, 2.0, int(random.integers(2**31)))
        else:
            flat, faces = rectangle(n, n, 2.0, 2.0, alternating=kind == "alternating")
        flat = square_to_disc(flat - [1.0, 1.0, 0.0])
    angle = random.uniform(0.0, 2.0 * math.pi)
    cos, sin = math.cos(angle), math.sin(angle)
    return flat @ [[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]], faces


def _wavy(flat: Array, random: np.random.Generator) -> Array:
    """Positions [m] of a cloth with random waves outside the disc, which determine its folds."""
    radius, angle = CLOTH * np.hypot(flat[:, 0], flat[:, 1]), np.arctan2(flat[:, 1], flat[:, 0])
    # amplitude [m] of a wave along the rim, and numbers of waves around it; with 4 mm cloths are stretched so
    # much where they are lifted that they may jump off the disc
    rim, numbers = 1e-3, range(2, 10)
    outside = np.maximum(0.0, (radius - DISC) / (CLOTH - DISC)) ** 2
    parts = random.normal(size=(len(numbers), 2))
    waves = sum(
        a * np.cos(m * angle) + b * np.sin(m * angle) for m, (a, b) in zip(numbers, parts, strict=True)
    )
    return CLOTH * flat + np.outer(rim * outside * (waves - np.min(waves)), [0.0, 0.0, 1.0])


def _drape(bench: Bench, kind: str, n: int, start: int) -> float:
    """Drape coefficient of one simulation; kinds and starts have independent waves; collective."""
    # bending stiffness of the table over the one that the program it belongs to uses (`theory.md`)
    material = {"cloth": "11oz-black-denim", "bending_model": "midedge", "bending_scale": 4.0}
    random = np.random.default_rng([MESHES.index(kind), start])
    flat, faces = _disc(kind, n, random)
    lifted, rest = _wavy(flat, random), CLOTH * flat[:, :2]
    # gap [m], below the shortest edge of the finest mesh; speed [m/s] below which a cloth counts as at rest
    scene = drape_scene(bench, lifted, faces, rest, material, start, 1e-3, iterations=200)
    x = drape_cloth(bench, scene, 1e-3)
    return drape_coefficient(shadow(x, faces))


def scatter_of_means(samples: Sequence[Sequence[float]]) -> float:
    """Standard deviation of the samples' means over twice their standard error.

    Samples are of one size. Four with equal means, of five values each, exceed 1 in 3 % of all cases.
    """
    means = [np.mean(sample) for sample in samples]
    square = np.mean([np.var(sample, ddof=1) / len(sample) for sample in samples])
    return float(np.std(means, ddof=1) / (2.0 * np.sqrt(square)))


def cusick(bench: Bench, n: float) -> Iterator[Measured]:
    samples = []
    for kind in MESHES:
        samples.append([_drape(bench, kind, round(n), start) for start in range(STARTS)])
        # middle of the published range of 70 to 90 %
        yield Measured(f"drape coefficient, {kind}", float(np.mean(samples[-1])), 0.8, scale=1.0)
    if len(samples) > 1:
        yield Measured("scatter of the kinds", scatter_of_means(samples), 0.0, scale=1.0)
