"""Plane walls that meet at an angle, two or more at an edge, with directors on edges; closed forms."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.meshes import walls
from lyra_petsc.experiments.verification.cases.cantilevers import critical
from lyra_petsc.experiments.verification.flat_plates import MEMBRANE, lowest_squares, plate_material
from lyra_petsc.experiments.verification.verification_case import (
    ASSEMBLED,
    STATIC,
    Measured,
    scene,
)

PATTERNS = ("diagonal", "alternating")

Section = list[tuple[tuple[float, float], tuple[float, float]]]
FOOT, TOP, SIDE, END = (0.0, 0.0), (0.0, 1.0), (-1.0, 1.0), (1.0, 1.0)
SHARP = math.radians(20.0)
BACK = (math.sin(SHARP), 1.0 - math.cos(SHARP))

FRAMES: dict[str, tuple[Section, int, float]] = {
    "right angle": ([(FOOT, TOP), (TOP, END)], 2, 1.0 / 3.0 + 1.0),
    "folded by 160°": (
        [(FOOT, TOP), (TOP, BACK)],
        0,
        (math.cos(SHARP) ** 2 + math.cos(SHARP) ** 3 + BACK[1] ** 3) / 3.0,
    ),
    "three strips": ([(FOOT, TOP), (TOP, END), (SIDE, TOP)], 2, 1.0 / 3.0 + 1.0 / 8.0),
}
"""Frames of strips of 1 m that are clamped at foot and side: the strips, the direction of a force at the
end of the second strip, and the displacement of this end over P L³/B."""


def frames(bench: Bench, n: float) -> Iterator[Measured]:
    width, force = 0.25, 1e-5
    for label, (section, axis, exact) in FRAMES.items():
        for pattern in PATTERNS:
            rows = max(1, round(n * width))
            vertices, faces = walls(section, round(n), rows, width, alternating=pattern == "alternating")
            end = np.flatnonzero(np.isclose(vertices[:, [0, 2]], section[1][1]).all(axis=1))
            near = [[[x - 1e-6, -1.0, z - 1e-6], [x + 1e-6, 1.0, z + 1e-6]] for x, z in (FOOT, SIDE)]
            content = scene(
                bench.mesh(vertices, faces),
                plate_material(MEMBRANE),
                STATIC | {"step": 1.0},
                gravity=[0, 0, 0],
                handles=[{"box": box, "clamp": True} for box in near[: len(section) - 1]],
                loads=[{"nodes": end.tolist(), "force": (force * width * np.eye(3)[axis]).tolist()}],
            )
            with bench.simulation(content) as trial:
                deflection = float((trial.run().x - vertices)[end, axis].mean()) / force
            yield Measured(f"displacement over P L³/B, {label}, {pattern}", deflection, exact)


def _legs(*degrees: float) -> Section:
    return [(FOOT, (math.cos(angle), math.sin(angle))) for angle in map(math.radians, degrees)]


LENGTH, POISSON = 2.0, 0.3
SECTIONS: dict[str, tuple[Section, float, tuple[tuple[float, float], ...]]] = {
    "angle": (_legs(0.0, 90.0), LENGTH, (FOOT,)),
    "Y": (_legs(90.0, 210.0, 330.0), LENGTH, (FOOT,)),
    "cross": (_legs(0.0, 90.0, 180.0, 270.0), LENGTH, (FOOT,)),
    "square tube": ([(FOOT, (1, 0)), ((1, 0), END), (END, TOP), (TOP, FOOT)], 1.0, (FOOT, (1, 0), END, TOP)),
}
"""Columns of walls 1 m wide: the walls, the length of the column [m], and the edges that stay straight."""


def flange(length: float, poisson: float) -> float:
    """Buckling load over π² D/b² of a plate of width b with one free and three supported sides.

    ``length`` is the length of the free side over b.
    """
    from scipy.optimize import brentq

    along = math.pi / length

    def condition(k: float) -> float:
        root = along * math.pi * math.sqrt(k)
        a, b = math.sqrt(root + along**2), math.sqrt(root - along**2)
        one, two = a * a - poisson * along**2, b * b + poisson * along**2
        return b * one**2 * math.tanh(a) * math.cos(b) - a * two**2 * math.sin(b)

    lower = length**-2
    return float(brentq(condition, lower * (1.0 + 1e-9), lower + 1.0))


def sections(bench: Bench, n: float) -> Iterator[Measured]:
    for label, (section, length, straight) in SECTIONS.items():
        rows = round(n * length)
        vertices, faces = walls(section, round(n), rows, length)
        lines = [np.isclose(vertices[:, [0, 2]], place).all(axis=1) for place in straight]
        ends = np.isclose(vertices[:, 1] % length, 0.0)
        held = np.flatnonzero(np.any(lines, axis=0) | ends)
        content = scene(
            bench.mesh(vertices, faces),
            plate_material(MEMBRANE, poisson=POISSON),
            ASSEMBLED,
            handles=[{"nodes": held.tolist(), "axes": ["x", "z"]}, {"nodes": [0], "axes": ["y"]}],
        )
        exact = math.pi**2 * (flange(length, POISSON) if len(straight) == 1 else 4.0)
        # shift of the eigenvalue problem over the lowest squared frequency without compression, larger than
        # any negative square
        shift = 0.4 * exact * (math.pi / length) ** 2
        with bench.simulation(content) as trial:

            def lowest(load: float, trial: Trial = trial, shift: float = shift) -> float:
                strain = load / (MEMBRANE * (1.0 - POISSON**2))
                aside = 1.0 + POISSON * strain
                trial.set_state(x=trial.start * [aside, 1.0 - strain, aside])
                return float(lowest_squares(trial, 1, shift)[0][0])

            load = critical(lowest, 0.8 * exact, 0.95 * exact)
        yield Measured(f"N b²/D, {label}", load, exact)
