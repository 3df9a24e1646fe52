"""Cusick's drape test: a cloth of 30 cm diameter on a disc of 18 cm, and its shadow.

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

CLOTH, DISC = 0.15, 0.09
"""Radii of cloth and disc [m]"""

STARTS = 5
"""Number of start shapes"""

STEP, STEPS = 0.04, 40
"""Δt [s] and number of steps; backward Euler with these long steps damps the motion."""


MARGIN = 1.05
"""Half the side of the picture of a shadow, over the radius of the cloth"""


def disc_mesh(angle: Array) -> tuple[Array, Ints]:
    """A fan of triangles with rim vertices at these angles [rad]: vertices (n, 3) [m], triangles (m, 3)."""
    rim = DISC * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    fan = np.array([[k, k + 1, len(rim)] for k in range(len(rim) - 1)])
    return np.vstack([rim, np.zeros((1, 3))]), fan


def drape_scene(
    bench: Bench,
    start: Array,
    faces: Ints,
    rest: Array,
    material: dict[str, Any],
    seed: int,
    gap: float = 2e-3,
    iterations: int = 50,
) -> dict[str, Any]:
    """The scene of a cloth that falls over the disc; collective.

    Parameters
    ----------
    start : (V, 3)
        Positions [m] over the disc.
    faces : (F, 3)
    rest : (V, 2)
        Material coordinates [m].
    material : dict
        Material block of a scene.
    seed : int
        Seed of the noise that is added to the start.
    gap : float
        Contact gap [m]; must be below the shortest edge.
    iterations : int
        Newton iterations after which a step is halved. Many steps of soft cloths on fine meshes do not
        converge in 200; stiff sheets fold slowly, and shorter steps would cost more.
    """
    disc = {"mesh": bench.mesh(*disc_mesh(np.radians(np.linspace(0.0, 360.0, 49))))}
    return {
        "mesh": bench.mesh(start + [0.0, 0.0, 0.95 * gap], faces, rest=rest),
        "material": material,
        "time": {"end": STEP * STEPS, "step": STEP},
        "gravity": [0.0, 0.0, -G],
        "initial": {"noise": 2e-4, "seed": seed},
        "contact": {"gap": gap, "friction": 0.3, "self": False},
        "obstacles": {"disc": disc},
        "solver": {"force_tolerance": 1e-5, "step_tolerance": 1e-5, "max_iterations": iterations},
    }


# speed [m/s] of the fastest vertex below which the cloth counts as at rest and the simulation ends early
def drape_cloth(bench: Bench, scene: dict[str, Any], speed: float = 0.01) -> Array:
    """Simulate a `drape_scene` until the cloth is at rest; returns positions (V, 3) [m]; collective.

    It is if its fastest vertex is slower than ``speed`` [m/s].
    """
    with bench.simulation(scene) as trial:
        while not trial.simulation.finished:
            trial.step()
            # a bound on time, not on steps: steps of stiff sheets may be cut into many
            if trial.simulation.time > 0.5 * STEP * STEPS and np.abs(trial.v).max() < speed:
                break
        return trial.x


def shadow(x: Array, faces: Ints, pixels: int = 240) -> Picture:
    """Pixels (pixels, pixels), rows along y, covered by the disc or by triangles of vertices x (V, 3) [m]."""
    centres = MARGIN * CLOTH * ((2.0 * np.arange(pixels) + 1.0) / pixels - 1.0)
    dark = np.hypot(centres, centres[:, None]) < DISC
    for corners in x[faces][:, :, :2]:
        first, last = (
            np.searchsorted(centres, bound) for bound in (corners.min(axis=0), corners.max(axis=0))
        )
        columns, rows = slice(first[0], last[0]), slice(first[1], last[1])
        points = np.stack(np.meshgrid(centres[columns], centres[rows]), axis=-1)
        sides, offsets = np.roll(corners, -1, axis=0) - corners, points[..., None, :] - corners
        cross = sides[:, 0] * offsets[..., 1] - sides[:, 1] * offsets[..., 0]
        dark[rows, columns] |= (cross >= 0.0).all(axis=-1) | (cross <= 0.0).all(axis=-1)
    return dark


def drape_coefficient(dark: Picture) -> float:
    """Fraction of the ring between the rims of disc and flat cloth that lies in the shadow."""
    area = float(dark.mean()) * (2.0 * MARGIN * CLOTH) ** 2
    return (area - math.pi * DISC**2) / (math.pi * (CLOTH**2 - DISC**2))


def count_folds(dark: Picture) -> int:
    """Number of folds: how often the radius of the shadow's rim rises above its mean, ignoring ripples."""
    half, last = MARGIN * CLOTH, len(dark) - 1
    angle, radius = np.radians(np.arange(0.0, 360.0, 2.0)), np.linspace(0.9 * DISC, half, 150)
    column, row = (
        np.clip((np.outer(f(angle), radius) / half + 1.0) * 0.5 * len(dark), 0, last).astype(int)
        for f in (np.cos, np.sin)
    )
    rim = (dark[row, column] * radius).max(axis=1)
    waves = np.fft.rfft(rim - rim.mean())
    waves[13:] = 0.0  # waves shorter than 30°
    smooth = np.fft.irfft(waves, len(rim))
    # amplitude [m] of the rim below which it has no folds
    threshold = max(1e-3, 0.1 * float(np.abs(smooth).max()))
    signs = np.where(smooth > threshold, 1, np.where(smooth < -threshold, -1, 0))
    signs = signs[signs != 0]
    return int(np.sum((signs == 1) & (np.roll(signs, 1) == -1)))
