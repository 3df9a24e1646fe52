"""Stiff sheets compared with their limits: an inextensible chain, a rigid plate, the converged paper scene.

In the stiff limit of its membrane a strip between two supports becomes an inextensible chain. Both are
stepped by backward Euler: in the limit each step minimises ½ ‖x − x_n − Δt v_n − Δt² g‖²_M over all chains
whose links keep their lengths. A strip of stiffness C deviates by its stretch, by at most a few times
weight/C.

A sheet that is stiff in membrane and bending falls like a rigid plate: a uniform plate of length L, hinged at
one edge and released horizontally, passes the vertical after √(2 L/3 g) K(1/√2), K(1/√2) = 1.8541: 0.4836 s
for 1 m and 9.8 m/s².

The paper scene is chaotic. Its converged kinetic energy and the scatter of single correct calculations are
those of an ensemble of 18 explicit fourth-order calculations (scripts/references/paper.py). At the same Δt
its error must not exceed that of soft cloth, the same sheet with a thousandth of the stiffness, whose
converged value is computed by a second-order integrator with a quarter of the Δt. Both are stepped by
backward Euler, whose error is well above the scatter of single calculations.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import cast

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.case import Verdict
from lyra_petsc.experiments.stress.stress_scenes import (
    Content,
    Setting,
    scale,
)
from lyra_petsc.experiments.stress.verdicts import RunRecord
from lyra_petsc.experiments.verification.flat_plates import LENGTH, WIDTH, hung
from lyra_petsc.experiments.verification.verification_case import G, grid, isotropic, scene
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.load import default_scene, load_scene
from lyra_petsc.scene.text import parse_yaml

LINKS, SPAN, RISE, DENSITY = 10, 0.7, 0.25, 0.15
"""Number of links, horizontal and vertical distance of the supports [m], density [kg/m²]"""

JOINT_MASS = 0.5 * DENSITY * WIDTH * LENGTH / LINKS
"""Mass of a vertex [kg]."""


def strip(setting: Setting, bench: Bench, stiffness: float) -> Content:
    return hung(bench, LINKS, 1.0, SPAN, RISE) | {
        "title": "A strip between two supports",
        "material": {"density": DENSITY, "membrane": isotropic(stiffness)},
        "time": {"end": 1.0, "step": setting.step},
    }


def edge_positions(trial: Trial) -> Array:
    """x and z of the vertices of one edge of the strip, (LINKS + 1, 2) [m]."""
    return trial.x[: LINKS + 1, [0, 2]]


def step_inextensible_chain(x: Array, v: Array, dt: float, length: float) -> tuple[Array, Array]:
    """One backward Euler step of an inextensible chain with equal joint masses and fixed ends.

    Solves the equations with Lagrange multipliers, starting from the present shape.

    Parameters
    ----------
    x, v : (n + 1, 2)
        Positions [m] and velocities [m/s] of the joints.
    dt : float [s]
    length : float
        Length of a link [m].
    """
    from scipy.optimize import root

    free_x, pull = x + dt * v + dt**2 * np.array([0.0, -G]), np.diff(np.eye(len(x)), axis=0).T

    def residual(unknowns: Array) -> Array:
        """Of the equations of motion of the inner joints, and of the lengths of the links."""
        inner, force = unknowns[: x[1:-1].size].reshape(-1, 2), unknowns[x[1:-1].size :]
        links = np.diff(np.vstack([x[0], inner, x[-1]]), axis=0)
        moved = (inner - free_x[1:-1]) + (pull @ (force[:, None] * links))[1:-1]
        return np.append(moved.ravel(), 0.5 * (np.sum(links**2, axis=1) - length**2))

    unknowns = root(residual, np.append(x[1:-1].ravel(), np.zeros(len(x) - 1)), tol=1e-15).x
    x_new = np.vstack([x[0], unknowns[: x[1:-1].size].reshape(-1, 2), x[-1]])
    return x_new, (x_new - x) / dt


def as_inextensible_chain(
    setting: Setting, bench: Bench, record: RunRecord, stiffness: float
) -> Mapping[str, Verdict]:
    x, v = np.asarray(record.observed[0]), np.zeros((LINKS + 1, 2))
    off = 0.0
    for observed_x in record.observed[1:]:
        x, v = step_inextensible_chain(x, v, record.nominal, LENGTH / LINKS)
        off = max(off, float(np.linalg.norm(observed_x - x, axis=1).max()))
    # allowed deviation over weight/C times the length
    allowed = 2.0 * DENSITY * G * LENGTH / stiffness * LENGTH
    # the residual of a step acts as an impulse, which moves the joints in all following steps
    displacements = [b.residual * (record.planned - k) for k, b in enumerate(record.balances)]
    unsolved = sum(displacements) * record.nominal**2 / JOINT_MASS
    message = (
        f"{off:.2e} m from the inextensible chain, {allowed:.2e} m allowed for its stretch "
        f"and {unsolved:.2e} m for what was left unsolved"
    )
    return {"stiff limit": Verdict(off <= allowed + unsolved, message)}


def plate(setting: Setting, bench: Bench, stiffness: float, bending: float) -> Content:
    mesh = grid(1.0, 1.0, 16, 16, "alternating")
    material = {"density": DENSITY, "membrane": isotropic(stiffness, 0.3), "bending": bending}
    time, about = {"end": 0.5, "step": setting.step}, "A plate hinged at one edge"
    return scene(mesh, material, time, title=about, gravity=[0.0, 0.0, -9.8], handles=[{"group": "left"}])


def centre(trial: Trial) -> tuple[float, float]:
    """x and z of the centre of mass [m]."""
    x = trial.mass @ trial.x / trial.mass.sum()
    return float(x[0]), float(x[2])


def first_vertical(times: list[float], centres: list[tuple[float, float]]) -> float:
    """Time [s] when the centre of mass first passes below the hinge, interpolated; NaN if never."""
    angles = np.arctan2([-z for _, z in centres], [x for x, _ in centres])
    passed = np.flatnonzero(angles >= 0.5 * np.pi)
    if not len(passed):
        return math.nan
    k = int(passed[0])
    part = (0.5 * np.pi - angles[k - 1]) / (angles[k] - angles[k - 1])
    return float(times[k - 1] + part * (times[k] - times[k - 1]))


def as_rigid_plate(setting: Setting, bench: Bench, record: RunRecord) -> Mapping[str, Verdict]:
    # time [s] at which the rigid plate of 1 m passes the vertical
    exact = 1.8540746773013719 * math.sqrt(2.0 / (3.0 * 9.8))
    # allowed relative error, and part of Δt by which backward Euler may be early in addition
    late, early = 0.005, 0.25
    centres = cast("list[tuple[float, float]]", record.observed)
    passed = first_vertical([0.0, *record.times], centres)
    earliest, latest = exact * (1.0 - late) - early * record.nominal, exact * (1.0 + late)
    message = f"first vertical at {passed:.4f} s, from {earliest:.4f} to {latest:.4f} s allowed"
    return {"rigid plate": Verdict(earliest <= passed <= latest, message)}


SOFTER, FINER, SECOND_ORDER = 1e-3, 4, "bdf2"
"""Factor on the stiffness of the soft sheet; refinement of Δt and integrator of its converged value."""


def paper(setting: Setting, bench: Bench, integrator: str = "beuler") -> Content:
    def read() -> Content:
        scene = load_scene(default_scene().with_name("paper.yaml"), (f"time.integrator={integrator}",))
        return parse_yaml(dump_scene(scene), file=None)

    content = on_root(bench.comm, read)
    content.pop("output")
    return content


def kinetic(trial: Trial) -> float:
    return trial.simulation.budget.kinetic


def _soft_kinetic(setting: Setting, bench: Bench, integrator: str, step: float) -> float:
    """Kinetic energy [J] of the soft sheet at the end."""
    content = scale(paper(setting, bench, integrator), stretching=SOFTER)
    content["time"] |= {"step": step, "end": 0.48}
    with bench.simulation(content) as trial:
        return kinetic(trial.run())


def as_soft_cloth(setting: Setting, bench: Bench, record: RunRecord) -> Mapping[str, Verdict]:
    # mean and standard deviation [J] of the kinetic energy of the ensemble at the end
    kinetic, spread = 0.4646114, 0.0030549
    error = abs(record.observed[-1] / kinetic - 1.0)
    converged = _soft_kinetic(setting, bench, SECOND_ORDER, record.nominal / FINER)
    soft = abs(_soft_kinetic(setting, bench, "beuler", record.nominal) / converged - 1.0)
    allowed = soft + 2.0 * spread / kinetic
    message = (
        f"kinetic energy off by {100 * error:.2g} %, that of soft cloth by {100 * soft:.2g} %, two "
        f"standard deviations of correct calculations are {200 * spread / kinetic:.2g} %"
    )
    return {"kinetic energy": Verdict(error <= allowed, message)}
