"""Cusick's drape test of a whole cloth, over several starts: BS 5058."""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.drape import (
    CLOTH,
    DRAPE_GAP,
    MARGIN,
    NOISE,
    STARTS,
    disc_of,
    drape_coefficient,
    folds,
    shadow,
)
from lyra_petsc.experiments.fabric.records import Number, Record
from lyra_petsc.experiments.fabric.specimens import Fabric, G
from lyra_petsc.experiments.meshes import Array, Ints, irregular_rectangle

CELLS, STEP, STEPS = 12, 0.04, 40
"""Along the diameter; Δt [s], and how many: backward Euler damps what moves."""

REST = 0.01
"""Speed [m/s] of the fastest vertex at which a cloth rests before"""

PIXELS = 240


def _disc(cells: int, seed: int) -> tuple[Array, Ints]:
    """A disc of radius 1, a square of irregular cells mapped smoothly: no direction has more folds for it."""
    flat, faces = irregular_rectangle(cells, cells, 2.0, 2.0, seed)
    i, j = flat[:, 0] - 1.0, flat[:, 1] - 1.0
    return np.column_stack([i * np.sqrt(1.0 - 0.5 * j**2), j * np.sqrt(1.0 - 0.5 * i**2), 0.0 * i]), faces


def cusick(bench: Bench, fabric: Fabric, degrees: float) -> Record:
    """A cloth of 30 cm on a disc of 18 cm: drape coefficient and folds, mean and scatter of five starts."""
    fabric.needs_bending("cusick")
    record, coefficients, counts = Record(), [], []
    disc = {"mesh": bench.mesh(*disc_of(np.radians(np.linspace(0.0, 360.0, 49))))}
    dark = np.zeros((1, 1), dtype=np.bool_)
    for start in range(STARTS):
        flat, faces = _disc(CELLS, start)
        content = {
            "mesh": bench.mesh(CLOTH * flat + [0.0, 0.0, 0.95 * DRAPE_GAP], faces, rest=CLOTH * flat[:, :2]),
            "material": fabric.turned(degrees),
            "time": {"end": STEP * STEPS, "step": STEP},
            "gravity": [0.0, 0.0, -G],
            "initial": {"noise": NOISE, "seed": start},
            "contact": {"gap": DRAPE_GAP, "friction": 0.3, "self": False},
            "obstacles": {"disc": disc},
            # stiff sheets are slow to fold, but shorter steps cost more
            "solver": {"force_tolerance": 1e-5, "step_tolerance": 1e-5, "max_iterations": 200},
        }
        with bench.simulation(content) as trial:
            while not trial.simulation.finished:
                trial.step()
                # by time, not by steps: those of stiff sheets are cut into many
                if trial.simulation.time > 0.5 * STEP * STEPS and np.abs(trial.v).max() < REST:
                    break
            x = trial.x
        dark = shadow(x, faces, PIXELS)
        coefficients.append(100.0 * drape_coefficient(dark))
        counts.append(float(folds(dark)))
    record.numbers = [
        Number(name, float(np.mean(values)), unit, float(np.std(values, ddof=1)))
        for name, values, unit in (("drape coefficient", coefficients, "%"), ("folds", counts, "1"))
    ]
    record.shadow, record.extent = dark.astype(int).tolist(), 100.0 * MARGIN * CLOTH
    if not all(map(math.isfinite, coefficients)):
        record.stopped = "no shadow"
    return record
