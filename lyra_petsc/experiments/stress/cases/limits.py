"""Stiff sheets against what is known of them: a chain, a rigid plate, the converged paper scene.

The stiff limit of a membrane: a strip between two supports becomes a chain that does not stretch. Both are
stepped by backward Euler: in the limit each step minimises ½ ‖x − x_n − Δt v_n − Δt² g‖²_M over the chains
whose links keep their lengths. What a strip of stiffness C differs by is its stretch, at most some times
weight/C.

A sheet stiff in membrane and bending falls like the rigid plate it is: a uniform plate of length L, hinged at
one edge and released horizontal, passes the vertical after √(2 L/3 g) K(1/√2), K(1/√2) = 1.8541: 0.4836 s for
1 m and 9.8 m/s².

The paper scene is chaotic; its converged value and what single correct calculations are apart are those of an
ensemble of 18 explicit fourth-order calculations (scripts/references/paper.py). At the same Δt its kinetic
energy errs by no more than that of soft cloth, the same sheet with a thousandth of the stiffness, whose
converged value is that of a second-order integrator with a quarter of the Δt. Both are stepped by backward
Euler, whose error stands clear of the scatter of single calculations.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import cast

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.case import Verdict
from lyra_petsc.experiments.stress.step_balance import Record
from lyra_petsc.experiments.stress.stress_scenes import (
    FULL,
    QUICK,
    USUAL,
    Content,
    Scope,
    Setting,
    StressCase,
    family,
    scale,
)
from lyra_petsc.experiments.verification.flat_plates import LENGTH, WIDTH, G, hung
from lyra_petsc.experiments.verification.verification_case import grid, isotropic, scene
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.load import default_scene, load_scene
from lyra_petsc.scene.text import parse_yaml

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
            f"chain-{stiffness}", f"C {stiffness} N/m, swinging", partial(_strip, stiffness=float(stiffness)),
            steps=STEPS, step=STEP, level=level, own=True, observe=_edge,
            judge=partial(_tends, stiffness=float(stiffness)),
        )
        for stiffness, level in (("1e4", USUAL), ("1e6", QUICK), ("1e8", USUAL), ("1e10", USUAL))
    ),
)  # fmt: skip


SIDE, GRAVITY, AREAL, CELLS = 1.0, 9.8, 0.15, 16
"""m, m/s², kg/m², cells along a side"""

QUARTER = 1.8540746773013719 * math.sqrt(2.0 * SIDE / (3.0 * GRAVITY))
"""s"""

LATE, EARLY = 0.005, 0.25
"""Relative, and the part of Δt by which backward Euler may be early."""


def _plate(setting: Setting, bench: Bench, stiffness: float, bending: float) -> Content:
    mesh = grid(SIDE, SIDE, CELLS, CELLS, "alternating")
    material = {"density": AREAL, "membrane": isotropic(stiffness, 0.3), "bending": bending}
    time, about = {"end": 0.5, "step": setting.step}, "A plate hinged at one edge"
    return scene(mesh, material, time, title=about, gravity=[0.0, 0.0, -GRAVITY], handles=[{"group": "left"}])


def _centre(trial: Trial) -> tuple[float, float]:
    """Of mass, x and z [m]."""
    x = trial.mass @ trial.x / trial.mass.sum()
    return float(x[0]), float(x[2])


def first_vertical(times: list[float], places: list[tuple[float, float]]) -> float:
    """When the centre of mass first passes below the hinge [s], between two steps; NaN if never."""
    angles = np.arctan2([-z for _, z in places], [x for x, _ in places])
    passed = np.flatnonzero(angles >= 0.5 * np.pi)
    if not len(passed):
        return math.nan
    k = int(passed[0])
    part = (0.5 * np.pi - angles[k - 1]) / (angles[k] - angles[k - 1])
    return float(times[k - 1] + part * (times[k] - times[k - 1]))


def _falls(setting: Setting, bench: Bench, record: Record) -> Mapping[str, Verdict]:
    places = cast("list[tuple[float, float]]", record.observed)
    found = first_vertical([0.0, *record.times], places)
    least, most = QUARTER * (1.0 - LATE) - EARLY * record.nominal, QUARTER * (1.0 + LATE)
    words = f"first vertical at {found:.4f} s, from {least:.4f} to {most:.4f} s allowed"
    return {"rigid plate": Verdict(least <= found <= most, words)}


def _plate_case(stiffness: str, bending: str, step: float, level: Scope) -> StressCase:
    ms = f"{step * 1e3:g}"
    return StressCase(
        f"plate-{stiffness}-{bending}-{ms}ms", f"C {stiffness} N/m, B {bending} N·m, Δt {ms} ms",
        partial(_plate, stiffness=float(stiffness), bending=float(bending)),
        steps=round(0.5 / step), step=step, level=level, own=True, observe=_centre, judge=_falls,
    )  # fmt: skip


rigid_plate = family(
    "rigid-plate",
    "stiff in membrane and bending, hinged at one edge: first vertical as a rigid plate",
    _plate_case("1e4", "1e2", 0.005, USUAL),
    _plate_case("1e6", "1e2", 0.005, QUICK),
    _plate_case("1e6", "1e4", 0.005, USUAL),
    _plate_case("1e8", "1e4", 0.005, USUAL),
    _plate_case("1e9", "1e6", 0.005, FULL),
    _plate_case("1e6", "1e3", 0.0025, USUAL),
    _plate_case("1e8", "1e3", 0.001, FULL),
)


KINETIC, SPREAD = 0.4646114, 0.0030549
"""Mean and standard deviation of the ensemble at the end, J."""

PAPER_END = 0.48
"""s"""

SOFTER, FINER, SHARPER = 1e-3, 4, "bdf2"


def _paper(bench: Bench, integrator: str) -> Content:
    def read() -> Content:
        scene = load_scene(default_scene().with_name("paper.yaml"), (f"time.integrator={integrator}",))
        return parse_yaml(dump_scene(scene), file=None)

    content = on_root(bench.comm, read)
    content.pop("output")
    return content


def _kinetic(trial: Trial) -> float:
    return trial.simulation.budget.kinetic


def _soft(bench: Bench, integrator: str, step: float) -> float:
    """Kinetic energy [J] of the soft sheet at the end."""
    content = scale(_paper(bench, integrator), stretching=SOFTER)
    content["time"] |= {"step": step, "end": PAPER_END}
    with bench.simulation(content) as trial:
        return _kinetic(trial.run())


def _paper_case(step: float, level: Scope) -> StressCase:
    def judge(setting: Setting, bench: Bench, record: Record) -> Mapping[str, Verdict]:
        error = abs(record.observed[-1] / KINETIC - 1.0)
        converged = _soft(bench, SHARPER, step / FINER)
        soft = abs(_soft(bench, "beuler", step) / converged - 1.0)
        allowed = soft + 2.0 * SPREAD / KINETIC
        words = (
            f"kinetic energy off by {100 * error:.2g} %, that of soft cloth by {100 * soft:.2g} %, two "
            f"standard deviations of correct calculations are {200 * SPREAD / KINETIC:.2g} %"
        )
        return {"kinetic energy": Verdict(error <= allowed, words)}

    ms = f"{step * 1e3:g}"
    return StressCase(
        f"paper-{ms}ms", f"the paper scene, Δt {ms} ms", lambda setting, bench: _paper(bench, "beuler"),
        steps=round(PAPER_END / step), step=step, level=level, own=True, observe=_kinetic, judge=judge,
    )  # fmt: skip


paper = family(
    "paper",
    "the paper scene against its converged kinetic energy, as soft cloth against its own",
    _paper_case(0.01, FULL),
    _paper_case(0.005, USUAL),
    _paper_case(0.0025, FULL),
)
