"""The stiff limit of a membrane: a strip between two supports becomes a chain that does not stretch.

Both are stepped by backward Euler: in the limit each step minimises ½ ‖x − x_n − Δt v_n − Δt² g‖²_M over
the chains whose links keep their lengths. What a strip of stiffness C differs by is its stretch, at most
some times weight/C.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.stress.case import Case, Content, Family, Judge, Level, Maker, Setting
from lyra_petsc.stress.record import Record
from lyra_petsc.verification.bar_strip import LENGTH, WIDTH, G, hung
from lyra_petsc.verification.bench import Bench, Trial
from lyra_petsc.verification.claims import Verdict

Array = NDArray[np.float64]

LINKS, SPAN, RISE, DENSITY = 10, 0.7, 0.25, 0.15
"""Links, m and m between the supports, kg/m²"""

JOINT = 0.5 * DENSITY * WIDTH * LENGTH / LINKS
"""Mass of a vertex, kg."""

STEP, STEPS = 0.005, 40
BOUND = 2.0
"""Times weight/C."""


def _strip(stiffness: float) -> Maker:
    def scene(setting: Setting, bench: Bench) -> Content:
        membrane = {"c11": stiffness, "c22": stiffness, "c12": 0.0, "c33": 0.5 * stiffness}
        content = hung(bench, LINKS, 1.0, SPAN, RISE)
        return content | {
            "title": "A strip between two supports",
            "material": {"density": DENSITY, "membrane": membrane},
            "time": {"end": STEPS * STEP, "step": STEP},
        }

    return scene


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
    aim = x + dt * v + dt**2 * np.array([0.0, -G])
    new, force = x.copy(), np.zeros(n)
    rows = 2 * (n - 1)
    for _ in range(100):
        links = np.diff(new, axis=0)
        matrix = np.zeros((rows + n, rows + n))
        right = np.zeros(rows + n)
        right[:rows] = (aim - new)[1:-1].ravel()
        matrix[:rows, :rows] = np.eye(rows)
        for k in range(n):
            right[rows + k] = 0.5 * (length**2 - links[k] @ links[k])
            for joint, sign in ((k, -1.0), (k + 1, 1.0)):
                if 0 < joint < n:
                    at = slice(2 * joint - 2, 2 * joint)
                    matrix[rows + k, at] = matrix[at, rows + k] = sign * links[k]
                    right[at] -= sign * links[k] * force[k]
                    for other, factor in ((k, -1.0), (k + 1, 1.0)):
                        if 0 < other < n:
                            there = slice(2 * other - 2, 2 * other)
                            matrix[at, there] += sign * factor * force[k] * np.eye(2)
        change = np.linalg.solve(matrix, right)
        new[1:-1] += change[:rows].reshape(-1, 2)
        force += change[rows:]
        if np.abs(change[:rows]).max() < 1e-15 * LENGTH:
            break
    return new, (new - x) / dt


def _tends(stiffness: float) -> Judge:
    def judge(setting: Setting, bench: Bench, record: Record) -> Mapping[str, Verdict]:
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
        allowed = stretched + unsolved
        return {"stiff limit": Verdict(apart <= allowed, words)}

    return judge


FAMILY = Family(
    "chain",
    "a strip between two supports against the chain that does not stretch",
    [
        Case(
            f"chain-{stiffness}",
            f"C {stiffness} N/m, swinging",
            _strip(float(stiffness)),
            steps=STEPS,
            step=STEP,
            level=level,
            own=True,
            observe=_edge,
            judge=_tends(float(stiffness)),
        )
        for stiffness, level in (
            ("1e4", Level.USUAL),
            ("1e6", Level.QUICK),
            ("1e8", Level.USUAL),
            ("1e10", Level.USUAL),
        )
    ],
)
