"""Homogeneous deformations of an irregular membrane."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.verification.bench import Bench, Trial, data, farthest
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Exact
from lyra_petsc.verification.meshes import irregular_rectangle

Array = NDArray[np.float64]

DATA = data("patch_states")
WIDTH, HEIGHT = 1.0, 0.7
"""m"""

NEAR = 1e-6
"""m from the edge"""

TILT = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]
"""Rotation in which the deformed sheet lies in space: no answer may depend on it."""


def _scene(mesh: dict[str, Any], material: str) -> dict[str, Any]:
    return {
        "mesh": mesh,
        "material": {"density": 0.2, "membrane": DATA["materials"][material]},
        "time": {"end": 1.0, "step": 1.0},
    }


def _measure(bench: Bench, n: float) -> Sequence[Measured]:
    vertices, triangles = irregular_rectangle(int(n), WIDTH, HEIGHT)
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
    model = trial.simulation.model
    membrane, points = model.membrane, model.points
    c = DATA["materials"][state["material"]]
    stiffness, area = max(c["c11"], c["c22"]), WIDTH * HEIGHT
    energy = trial.total(membrane.energies(model.system.x)) / area
    force = np.zeros((points.n_local, 3))
    membrane.add_gradient(model.system.x, force)
    x, y = trial.start.T[:2]
    inner = (x > NEAR) & (x < WIDTH - NEAR) & (y > NEAR) & (y < HEIGHT - NEAR)
    residual = np.abs(trial.gather(force)[inner]).max(initial=0.0)
    # [N] that one triangle of the mean size puts on a vertex
    nodal = max(stiffness, *np.abs(state["S"])) * np.sqrt(area / model.outline.n_triangles)
    mine = membrane.strain_and_stress(model.system.x)[1][: membrane.n_owned]
    stress = np.concatenate(points.comm.allgather(mine))
    scale = max(stiffness, *np.abs(state["S"]))
    measured = [
        Measured("energy per area", energy, state["energy"], "J/m²", max(stiffness, state["energy"])),
        Measured("largest force on an inner vertex", float(residual), 0.0, "N", float(nodal)),
    ]
    for k, name in enumerate(("S11", "S22", "S12")):
        exact = state["S"][k]
        value = farthest(stress[:, k], exact)
        measured.append(Measured(f"{name} of the triangle farthest off", value, exact, "N/m", float(scale)))
    return measured


CASE = Case(
    name="patch-states",
    title="30 homogeneous deformations of an irregular membrane: energy, stress, and no force inside",
    source=DATA["source"],
    resolutions=(3, 6, 12),
    measure=_measure,
    claim=Exact(1e-10),
)
