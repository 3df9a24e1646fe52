"""Sheets that bend over obstacles: a ruck on a plane."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.meshes import rectangle
from lyra_petsc.experiments.verification.answers import Measured, at_finest, case, data, scene
from lyra_petsc.experiments.verification.flat_plates import plate_material

Array = NDArray[np.float64]

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
