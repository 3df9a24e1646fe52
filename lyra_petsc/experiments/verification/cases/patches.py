"""Homogeneous deformations of an irregular membrane."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.meshes import irregular_rectangle
from lyra_petsc.experiments.verification.answers import (
    ASSEMBLED,
    STATIC,
    Exact,
    Measured,
    case,
    data,
    farthest,
    scene,
)

DATA = data("patch_states")
WIDTH, HEIGHT = 1.0, 0.7
"""m"""

NEAR = 1e-6
"""m from the edge"""

TILT = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]
"""Rotation in which the deformed sheet lies in space: no answer may depend on it."""


def _scene(mesh: dict[str, Any], material: str, **more: Any) -> dict[str, Any]:
    shell = {"density": 0.2, "membrane": DATA["materials"][material]}
    return scene(mesh, shell, **{"time": ASSEMBLED} | more)


@case(
    "30 homogeneous deformations of an irregular membrane: energy, stress, and no force inside",
    source=DATA["source"],
    resolutions=(3, 6, 12),
    claim=Exact(1e-10),
)
def patch_states(bench: Bench, n: float) -> Sequence[Measured]:
    vertices, triangles = irregular_rectangle(int(n), int(n), WIDTH, HEIGHT)
    mesh = bench.mesh(vertices, triangles)
    found: list[list[Measured]] = []
    for material in DATA["materials"]:
        with bench.simulation(_scene(mesh, material)) as trial:
            for state in DATA["states"]:
                if state["material"] == material:
                    trial.set_state(x=vertices[:, :2] @ np.array(state["F"]).T @ TILT[:2])
                    found.append(_of_state(trial, state))
    # of each quantity the state that is farthest off
    return [max(quantity, key=lambda one: one.error) for quantity in zip(*found, strict=True)]


def _of_state(trial: Trial, state: dict[str, Any]) -> list[Measured]:
    problem = trial.simulation.problem
    membrane, points = problem.membrane, problem.points
    c = DATA["materials"][state["material"]]
    stiffness, area = max(c["c11"], c["c22"]), WIDTH * HEIGHT
    energy = trial.total(membrane.energies(problem.system.x)) / area
    force = np.zeros((points.n_local, 3))
    membrane.add_gradient(problem.system.x, None, force)
    x, y = trial.start.T[:2]
    inner = (x > NEAR) & (x < WIDTH - NEAR) & (y > NEAR) & (y < HEIGHT - NEAR)
    residual = np.abs(trial.gather(force)[inner]).max(initial=0.0)
    scale = float(max(stiffness, *np.abs(state["S"])))
    # [N] that one triangle of the mean size puts on a vertex
    nodal = scale * float(np.sqrt(area / problem.outline.n_triangles))
    mine = membrane.strain_and_stress(problem.system.x)[1][: membrane.n_owned]
    stress = np.concatenate(points.comm.allgather(mine))
    measured = [
        Measured("energy per area", energy, state["energy"], "J/m²", max(stiffness, state["energy"])),
        Measured("largest force on an inner vertex", float(residual), 0.0, "N", nodal),
    ]
    for k, name in enumerate(("S11", "S22", "S12")):
        exact = state["S"][k]
        value = farthest(stress[:, k], exact)
        measured.append(Measured(f"{name} of the triangle farthest off", value, exact, "N/m", scale))
    return measured


@case(
    "An irregular sheet pulled along one direction, static: its contraction and the force",
    source="closed form E22 = −(c12/c22) E11, P11 = λ (c11 − c12²/c22)(λ² − 1)/2",
    resolutions=(3, 6, 12),
    claim=Exact(1e-10),
)
def uniaxial_pull(bench: Bench, n: float) -> Iterator[Measured]:
    vertices, triangles = irregular_rectangle(int(n), int(n), WIDTH, HEIGHT)
    mesh = bench.mesh(vertices, triangles)
    handles = [
        {"box": [[-NEAR, -1, -1], [NEAR, 1, 1]], "axes": ["x"]},
        {"box": [[WIDTH - NEAR, -1, -1], [WIDTH + NEAR, 1, 1]], "axes": ["x"], "motion": "pull",
         "interpolation": "linear"},
        {"nodes": [0], "axes": ["y"]},
        {"box": [[-1, -1, -1], [2, 2, 1]], "axes": ["z"]},
    ]  # fmt: skip
    for material, along, across, pull in DATA["uniaxial"]["rows"]:
        pulled = [{"time": 0}, {"time": 1, "translate": [(along - 1.0) * WIDTH, 0, 0]}]
        static = {"handles": handles, "motions": {"pull": pulled}, "time": STATIC}
        with bench.simulation(_scene(mesh, material, **static)) as trial:
            trial.run()
            problem = trial.simulation.problem
            exact = vertices * [along, across, 0.0]
            off = float(np.abs(trial.x - exact).max())
            force = np.zeros((problem.points.n_local, 3))
            problem.membrane.add_gradient(problem.system.x, None, force)
            end = vertices[:, 0] > WIDTH - NEAR
            found = float(trial.gather(force)[end, 0].sum()) / HEIGHT
        name = f"{material}, stretched by {along:g}"
        yield Measured(f"largest displacement off, {name}", off, 0.0, "m", WIDTH)
        yield Measured(f"force per width, {name}", found, pull, "N/m")
