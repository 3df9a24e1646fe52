"""The stiff limit of a membrane: a strip between two supports becomes a chain that does not stretch.

Both are stepped by backward Euler: in the limit each step minimises ½ ‖x − x_n − Δt v_n − Δt² g‖²_M over
the chains whose links keep their lengths. What a strip of stiffness C differs by is its stretch, at most
some times weight/C.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.case import Verdict
from lyra_petsc.experiments.stress.step_balance import Record
from lyra_petsc.experiments.stress.stress_scenes import QUICK, USUAL, Content, Setting, StressCase, family
from lyra_petsc.experiments.verification.answers import isotropic
from lyra_petsc.experiments.verification.flat_plates import LENGTH, WIDTH, G, hung

Array = NDArray[np.float64]

LINKS, SPAN, RISE, DENSITY = 10, 0.7, 0.25, 0.15
"""Links, m and m between the supports, kg/m²"""

JOINT = 0.5 * DENSITY * WIDTH * LENGTH / LINKS
"""Mass of a vertex, kg."""

STEP, STEPS = 0.005, 40
BOUND = 2.0
"""Times weight/C."""


def _strip(setting: Setting, bench: Bench, stiffness: float) -> Content:
    return hung(bench, LINKS, 1.0, SPAN, RISE) | {
        "title": "A strip between two supports",
        "material": {"density": DENSITY, "membrane": isotropic(stiffness)},
        "time": {"end": STEPS * STEP, "step": STEP},
    }


def _edge(trial: Trial) -> Array:
    """One edge of the strip, (LINKS + 1, 2) [m]."""
    return trial.x[: LINKS + 1, [0, 2]]


def inextensible(x: Array, v: Array, dt: float, length: float) -> tuple[Array, Array]:
    """One step of a chain whose inner joints have equal masses and whose ends are held.

    Newton's method on the multipliers' equations, from the unconstrained step on.

    Parameters
    ----------
    x, v : (n + 1, 2)
        Joints [m] and their velocities [m/s].
    dt : float [s]
    length : float
        Of a link [m].
    """
    n = len(x) - 1
    rows = 2 * (n - 1)
    aim = x + dt * v + dt**2 * np.array([0.0, -G])
    new, force = x.copy(), np.zeros(n)
    # of the inner joints, to the links between them
    difference = np.diff(np.eye(n + 1), axis=0)[:, 1:-1]
    for _ in range(100):
        links = np.diff(new, axis=0)
        slope = (difference[:, :, None] * links[:, None, :]).reshape(n, rows)
        curvature = np.kron(difference.T @ (force[:, None] * difference), np.eye(2))
        matrix = np.block([[np.eye(rows) + curvature, slope.T], [slope, np.zeros((n, n))]])
        too_short = 0.5 * (length**2 - np.sum(links**2, axis=1))
        right = np.concatenate([(aim - new)[1:-1].ravel() - slope.T @ force, too_short])
        change = np.linalg.solve(matrix, right)
        new[1:-1] += change[:rows].reshape(-1, 2)
        force += change[rows:]
        if np.abs(change[:rows]).max() < 1e-15 * LENGTH:
            break
    return new, (new - x) / dt


def _tends(setting: Setting, bench: Bench, record: Record, stiffness: float) -> Mapping[str, Verdict]:
    x, v = np.asarray(record.observed[0]), np.zeros((LINKS + 1, 2))
    apart = 0.0
    for seen in record.observed[1:]:
        x, v = inextensible(x, v, STEP, LENGTH / LINKS)
        apart = max(apart, float(np.linalg.norm(seen - x, axis=1).max()))
    stretched = BOUND * DENSITY * G * LENGTH / stiffness * LENGTH
    # what a step leaves unsolved is a push that moves the joints on to the end
    pushes = [b.residual * (STEPS - k) for k, b in enumerate(record.balances)]
    unsolved = sum(pushes) * STEP**2 / JOINT
    words = (
        f"{apart:.2e} m from the chain that does not stretch, {stretched:.2e} m allowed for its stretch "
        f"and {unsolved:.2e} m for what was left unsolved"
    )
    return {"stiff limit": Verdict(apart <= stretched + unsolved, words)}


chain = family(
    "chain",
    "a strip between two supports against the chain that does not stretch",
    *(
        StressCase(
            f"chain-{stiffness}",
            f"C {stiffness} N/m, swinging",
            partial(_strip, stiffness=float(stiffness)),
            steps=STEPS,
            step=STEP,
            level=level,
            own=True,
            observe=_edge,
            judge=partial(_tends, stiffness=float(stiffness)),
        )
        for stiffness, level in (("1e4", USUAL), ("1e6", QUICK), ("1e8", USUAL), ("1e10", USUAL))
    ),
)
