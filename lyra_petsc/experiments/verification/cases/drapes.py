"""Sheets that bend over obstacles: rucks, strips at a pole and a table's edge, drapes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.drape import (
    CLOTH,
    DRAPE_GAP,
    NOISE,
    STARTS,
    disc_of,
    drape_coefficient,
    quarter_shadow,
)
from lyra_petsc.experiments.meshes import irregular_rectangle, rectangle
from lyra_petsc.experiments.verification.answers import (
    Converges,
    Exact,
    Measured,
    at_finest,
    case,
    data,
    grid,
    isotropic,
    scene,
)
from lyra_petsc.experiments.verification.flat_plates import plate_material

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# -- ruck ------------------------------------------------------------------------------------------------

RUCK = data("ruck")

HALF, RUCK_GAP, MEMBRANE = 3.0, 1e-4, 1e4
"""Half of the sheet's length over l, gap over l, C l²/B."""

LONG_STEP, STEPS = 1.0, 8
"""Over √(l/g), of backward Euler, which damps all motion; how many of them the end moves, and then rests."""

FOOT = (0.1, 0.45)
"""Where (height over that of the ruck)^(1/3) is straight along the sheet."""


def _small_ruck(s: Array, half_length: float, height: float) -> Array:
    """Places (n, 2) of a ruck of small slopes at distances s from its middle: w'''' + (k/a)² w'' = −1."""
    k = 4.493409457909064 / half_length  # tan z = z
    x = np.linspace(0.0, half_length, 2001)
    edge = np.cos(k * half_length)
    w = 0.5 * (half_length**2 - x**2) + (edge - np.cos(k * x)) / (k * k * edge)
    w *= height / w[0]
    along = np.append(0.0, np.cumsum(np.hypot(np.diff(x), np.diff(w))))
    beyond = np.maximum(s - along[-1], 0.0)
    return np.column_stack([np.interp(s, along, x) + beyond, np.interp(s, along, w)])


@case(
    "Ruck of a heavy sheet on a plane without friction, its end pushed in steps, bending_model: midedge, a "
    "half: force per width, height, and half length of the lifted part by its height^(1/3)",
    source=RUCK["source"],
    resolutions=(20, 40),
    claim=at_finest(1e-2),
    claims={f"half length / l, P = {row[0]:g} B/l²": at_finest(2e-2) for row in RUCK["rows"]},
    counts="cells along half of the sheet",
    quick=1,
)
def ruck(bench: Bench, n: float) -> Iterator[Measured]:
    cells = round(n)
    flat, faces = rectangle(cells, 1, HALF, HALF / n)
    along, rows = flat[:, 0], RUCK["rows"]
    _, half_length, _, height = rows[0]
    start = _small_ruck(along, half_length, height)
    frames: list[dict[str, Any]] = [{"time": 0.0}]
    for force, _, shortening, _ in rows:
        # what the force shortens the sheet by, which stretches, comes on top
        way = HALF * (1.0 - force / MEMBRANE) - 0.5 * shortening - float(start[:, 0].max())
        begin = frames[-1]["time"]
        for time in (begin + STEPS * LONG_STEP, begin + 2 * STEPS * LONG_STEP):
            frames.append({"time": time, "translate": [way, 0.0, 0.0]})
    ends = [[0, cells + 1], [cells, 2 * cells + 1]]
    content = scene(
        bench.mesh(
            np.column_stack([start[:, 0], flat[:, 1], start[:, 1] + 0.95 * RUCK_GAP]), faces, rest=flat[:, :2]
        ),
        plate_material(MEMBRANE),
        {"end": frames[-1]["time"], "step": LONG_STEP},
        gravity=[0.0, 0.0, -1.0],
        handles=[
            {"nodes": ends[0], "symmetry": "x"},
            {"nodes": ends[1], "axes": ["x"], "motion": "push", "interpolation": "linear"},
            {"nodes": list(range(len(flat))), "axes": ["y"]},
        ],
        motions={"push": frames},
        contact={"gap": RUCK_GAP, "self": False},
        obstacles={"floor": {"plane": {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}}},
        solver={"force_tolerance": 1e-7, "step_tolerance": 1e-7},
    )
    found: list[Measured] = []
    with bench.simulation(content) as trial:
        for (force, half_length, _, height), frame in zip(rows, frames[2::2], strict=True):
            while trial.simulation.time < frame["time"] - 0.01 * LONG_STEP:
                trial.step()
            push = trial.gather(trial.simulation.ledger.reaction)[ends[1], 0]
            z = trial.x[:, 2] - trial.x[ends[1], 2].mean()
            root = np.cbrt(z / z.max())
            foot = (root > FOOT[0]) & (root < FOOT[1])
            words = f"P = {force:g} B/l²"
            found += [
                Measured(f"P l²/B, {words}", -float(push.sum()) * n / HALF, force),
                Measured(f"height / l, {words}", float(z.max()), height),
                Measured(
                    f"half length / l, {words}",
                    float(np.polyfit(root[foot], along[foot], 1)[1]),
                    half_length,
                ),
            ]
    yield from found


# -- against a pole, over an edge ------------------------------------------------------------------------

LENGTH, CELLS, STEP, GAP = 0.3, 12, 0.004, 0.002
"""Of a strip [m]; cells along, Δt [s] and gap [m], of which one is refined at a time"""

FABRIC = {"density": 0.2, "membrane": isotropic(200.0), "bending": 2e-4}

ALONG_Y = [-1.0, 1.0]
"""Ends of what strips meet, which are one cell wide and stay in the xz plane"""


def _strip(
    cells: int, step: float, gap: float, end: float, transform: dict[str, Any], **more: Any
) -> dict[str, Any]:
    """A strip that falls until ``end`` [s]; ``more`` are further keys."""
    mesh = grid(LENGTH, LENGTH / cells, cells, 1, "alternating") | {"transform": transform}
    held = [*more.pop("handles", []), {"group": "sheet", "axes": ["y"]}]
    contact = {"gap": gap, "self": False, "friction": more.pop("friction", 0.0)}
    # tighter than needed, and not as tight as without impacts
    solver = {"force_tolerance": 1e-8, "step_tolerance": 1e-8}
    time = {"end": end, "step": step}
    return scene(
        mesh, FABRIC, time, gravity=[0, 0, -9.81], handles=held, contact=contact, solver=solver, **more
    )


def _refined(bench: Bench, n: float, of: Callable[[int, float, float], dict[str, Any]]) -> Iterator[Measured]:
    """By how much the ends of a strip move when Δt, cells or gap go from 2/n to 1/n of the coarsest."""
    for words in ("Δt", "h", "gap"):
        ends: list[Array] = []
        for part in (0.5 * n, n):
            step = STEP / part if words == "Δt" else STEP
            gap = GAP / part if words == "gap" else GAP
            cells = round(CELLS * part) if words == "h" else CELLS
            with bench.simulation(of(cells, step, gap)) as trial:
                ends.append(trial.run().x[[0, cells]])
        change = float(np.abs(ends[1] - ends[0])[:, ::2].max())
        yield Measured(f"change of the ends, {words} halved", change, 0.0, "m", scale=LENGTH)


REFINED: dict[str, Any] = {
    "source": "order of backward Euler, and of the distance at which the barrier holds",
    "resolutions": (2, 4, 8),
    "claim": Converges(1.0, 1e-2, slack=0.4),
    # corners of the polygon that a strip is arrive one by one
    "claims": {"change of the ends, h halved": Converges(1.0, 5e-3, slack=math.inf)},
    "counts": "refinements",
    "quick": 1,
}


@case("Hanging strip that swings against a pole: ends, when Δt, h or the gap is halved", **REFINED)
def pole(bench: Bench, n: float) -> Iterator[Measured]:
    def swings(cells: int, step: float, gap: float) -> dict[str, Any]:
        low, high = ([-0.03, y, -0.15] for y in ALONG_Y)
        return _strip(
            cells,
            step,
            gap,
            0.3,
            {"rotate": {"axis": [0.0, 1.0, 0.0], "degrees": 30.0}},
            handles=[{"group": "left"}],
            obstacles={"pole": {"capsule": {"from": low, "to": high, "radius": 0.02}}},
        )

    yield from _refined(bench, n, swings)


@case("Strip that slides off a table's edge with friction: ends, when Δt, h or the gap is halved", **REFINED)
def table_edge(bench: Bench, n: float) -> Iterator[Measured]:
    def slides(cells: int, step: float, gap: float) -> dict[str, Any]:
        low, high = ALONG_Y
        return _strip(
            cells,
            step,
            gap,
            0.2,
            {"translate": [-0.13, 0.0, 0.95 * gap]},
            friction=0.2,
            obstacles={"table": {"box": {"min": [-1.0, low, -0.5], "max": [0.0, high, 0.0]}}},
        )

    yield from _refined(bench, n, slides)


# -- Cusick's drape test ---------------------------------------------------------------------------------

MESHES = ("diagonal", "alternating", "irregular")
PIXELS = 600
"""Along the side of the shadow's picture, of which a quarter is seen"""


def _quarter(kind: str, n: int) -> tuple[Array, Ints]:
    """The quarter x, y ≥ 0 of a disc of radius 1, a square of n × n cells mapped smoothly."""
    if kind == "irregular":
        flat, faces = irregular_rectangle(n, n, 1.0, 1.0)
    else:
        flat, faces = rectangle(n, n, 1.0, 1.0, alternating=kind == "alternating")
    i, j = flat[:, 0], flat[:, 1]
    return np.column_stack([i * np.sqrt(1.0 - 0.5 * j**2), j * np.sqrt(1.0 - 0.5 * i**2), 0.0 * i]), faces


@case(
    "Denim (11oz-black-denim) of 30 cm over a disc of 18 cm, a quarter of it, bending_model: midedge: drape "
    "coefficients, mean of five starts, on three kinds of meshes, against the mean of all",
    source="G. E. Cusick, Journal of the Textile Institute 59 (1968) 253-260; agreement of meshes",
    resolutions=(4, 6),
    claim=Exact(0.1),
    counts="cells along the radius",
    quick=1,
)
def cusick(bench: Bench, n: float) -> Sequence[Measured]:
    disc = {"mesh": bench.mesh(*disc_of(np.radians(np.linspace(-35.0, 125.0, 17))))}
    means: dict[str, float] = {}
    for kind in MESHES:
        flat, faces = _quarter(kind, round(n))
        mesh = bench.mesh(CLOTH * flat + [0.0, 0.0, 0.95 * DRAPE_GAP], faces, rest=CLOTH * flat[:, :2])
        found = []
        for start in range(STARTS):
            content = scene(
                mesh,
                {"cloth": "11oz-black-denim", "bending_model": "midedge"},
                {"end": 1.2, "step": 0.04},
                gravity=[0.0, 0.0, -9.81],
                initial={"noise": NOISE, "seed": start},
                handles=[
                    {"nodes": np.flatnonzero(flat[:, axis] < 1e-9).tolist(), "symmetry": "xy"[axis]}
                    for axis in (0, 1)
                ],
                contact={"gap": DRAPE_GAP, "friction": 0.3, "self": False},
                obstacles={"disc": disc},
                solver={"force_tolerance": 1e-6, "step_tolerance": 1e-6},
            )
            with bench.simulation(content) as trial:
                found.append(drape_coefficient(quarter_shadow(trial.run().x, faces, PIXELS)))
        means[kind] = float(np.mean(found))
    common = float(np.mean(list(means.values())))
    return [Measured(f"drape coefficient, {kind}", mean, common, scale=1.0) for kind, mean in means.items()]
