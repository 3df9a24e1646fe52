"""Cusick's drape test: a cloth of 30 cm on a disc of 18 cm, and its shadow.

G. E. Cusick, The measurement of fabric drape, Journal of the Textile Institute 59 (1968) 253-260; BS 5058.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.fabric.specimens import G

Picture = Mask

CLOTH, DISC, DRAPE_GAP = 0.15, 0.09, 2e-3
"""Radii and gap [m]"""

STARTS, NOISE = 5, 2e-4
"""How many, and the standard deviation [m] of their heights"""

STEP, STEPS = 0.04, 40
"""Δt [s], and how many: backward Euler damps what moves."""

SPEED = 0.01
"""Of the fastest vertex [m/s], at which a cloth rests before"""

LEAST_FOLD = 1e-3
"""Amplitude [m] of a rim below which it has no folds"""

MARGIN = 1.05
"""Half the side of a shadow's picture over the radius of the cloth"""


def disc_of(angle: Array) -> tuple[Array, Ints]:
    """The disc with a rim at these angles: vertices (n, 3) [m] and triangles (m, 3)."""
    rim = DISC * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    fan = np.array([[k, k + 1, len(rim)] for k in range(len(rim) - 1)])
    return np.vstack([rim, np.zeros((1, 3))]), fan


def draped(
    bench: Bench,
    start: Array,
    faces: Ints,
    rest: Array,
    material: dict[str, Any],
    seed: int,
    *,
    gap: float = DRAPE_GAP,
    speed: float = SPEED,
) -> Array:
    """Positions (V, 3) [m] of a cloth that rests on the disc; collective.

    Parameters
    ----------
    start : (V, 3)
        Positions [m] over the disc.
    faces : (F, 3)
    rest : (V, 2)
        Material coordinates [m].
    material : dict
        As in a scene.
    seed : int
        Of the noise of the start.
    gap : float
        Of the contact [m]; below the shortest edge.
    speed : float
        Of the fastest vertex [m/s], at which the cloth counts as at rest.
    """
    disc = {"mesh": bench.mesh(*disc_of(np.radians(np.linspace(0.0, 360.0, 49))))}
    content = {
        "mesh": bench.mesh(start + [0.0, 0.0, 0.95 * gap], faces, rest=rest),
        "material": material,
        "time": {"end": STEP * STEPS, "step": STEP},
        "gravity": [0.0, 0.0, -G],
        "initial": {"noise": NOISE, "seed": seed},
        "contact": {"gap": gap, "friction": 0.3, "self": False},
        "obstacles": {"disc": disc},
        # stiff sheets are slow to fold, but shorter steps cost more
        "solver": {"force_tolerance": 1e-5, "step_tolerance": 1e-5, "max_iterations": 200},
    }
    with bench.simulation(content) as trial:
        while not trial.simulation.finished:
            trial.step()
            # by time, not by steps: those of stiff sheets are cut into many
            if trial.simulation.time > 0.5 * STEP * STEPS and np.abs(trial.v).max() < speed:
                break
        return trial.x


def shadow(x: Array, faces: Ints, pixels: int) -> Picture:
    """Pixels (pixels, pixels), rows along y, below the disc or the triangles of vertices x (V, 3) [m]."""
    middles = MARGIN * CLOTH * ((2.0 * np.arange(pixels) + 1.0) / pixels - 1.0)
    dark = np.hypot(middles, middles[:, None]) < DISC
    for corners in x[faces][:, :, :2]:
        first, last = (
            np.searchsorted(middles, corners.min(axis=0)),
            np.searchsorted(middles, corners.max(axis=0)),
        )
        columns, rows = slice(first[0], last[0]), slice(first[1], last[1])
        at = np.stack(np.meshgrid(middles[columns], middles[rows]), axis=-1)
        sides, beside = np.roll(corners, -1, axis=0) - corners, at[..., None, :] - corners
        turn = sides[:, 0] * beside[..., 1] - sides[:, 1] * beside[..., 0]
        dark[rows, columns] |= (turn >= 0.0).all(axis=-1) | (turn <= 0.0).all(axis=-1)
    return dark


def drape_coefficient(dark: Picture) -> float:
    """Share of the ring beside the disc that lies in the shadow."""
    area = float(dark.mean()) * (2.0 * MARGIN * CLOTH) ** 2
    return (area - math.pi * DISC**2) / (math.pi * (CLOTH**2 - DISC**2))


def folds(dark: Picture) -> int:
    """How often the rim of a shadow goes outwards beyond its mean, small ripples left out."""
    half, last = MARGIN * CLOTH, len(dark) - 1
    angle, radius = np.radians(np.arange(0.0, 360.0, 2.0)), np.linspace(0.9 * DISC, half, 150)
    places = [
        np.clip((np.outer(f(angle), radius) / half + 1.0) * 0.5 * len(dark), 0, last).astype(int)
        for f in (np.cos, np.sin)
    ]
    rim = (dark[places[1], places[0]] * radius).max(axis=1)
    waves = np.fft.rfft(rim - rim.mean())
    waves[13:] = 0.0  # shorter than 30°
    smooth = np.fft.irfft(waves, len(rim))
    least = max(LEAST_FOLD, 0.1 * float(np.abs(smooth).max()))
    states = np.where(smooth > least, 1, np.where(smooth < -least, -1, 0))
    seen = states[states != 0]
    return int(np.sum((seen == 1) & (np.roll(seen, 1) == -1)))
