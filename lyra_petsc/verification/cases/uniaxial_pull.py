"""A sheet pulled along one direction, free to contract along the other."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from lyra_petsc.verification.bench import Bench, data
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Exact
from lyra_petsc.verification.meshes import irregular_rectangle

DATA = data("patch_states")
WIDTH, HEIGHT = 1.0, 0.7
"""m"""

NEAR = 1e-6
"""m"""


def _scene(mesh: dict[str, Any], material: str, stretch: float) -> dict[str, Any]:
    pulled = {"box": [[WIDTH - NEAR, -1, -1], [WIDTH + NEAR, 1, 1]], "axes": ["x"], "motion": "pull"}
    return {
        "mesh": mesh,
        "material": {"density": 0.2, "membrane": DATA["materials"][material]},
        "handles": [
            {"box": [[-NEAR, -1, -1], [NEAR, 1, 1]], "axes": ["x"]},
            pulled | {"interpolation": "linear"},
            {"nodes": [0], "axes": ["y"]},
            {"box": [[-1, -1, -1], [2, 2, 1]], "axes": ["z"]},
        ],
        "motions": {"pull": [{"time": 0}, {"time": 1, "translate": [(stretch - 1.0) * WIDTH, 0, 0]}]},
        "time": {"analysis": "static"},
    }


def _measure(bench: Bench, n: float) -> Iterator[Measured]:
    vertices, triangles = irregular_rectangle(int(n), WIDTH, HEIGHT)
    mesh = bench.mesh(vertices, triangles)
    for material, along, across, pull in DATA["uniaxial"]["rows"]:
        with bench.simulation(_scene(mesh, material, along)) as trial:
            trial.run()
            model = trial.simulation.model
            exact = vertices * [along, across, 0.0]
            off = float(np.abs(trial.x - exact).max())
            force = np.zeros((model.points.n_local, 3))
            model.membrane.add_gradient(model.system.x, force)
            end = vertices[:, 0] > WIDTH - NEAR
            pulled = float(trial.gather(force)[end, 0].sum()) / HEIGHT
        name = f"{material}, stretched by {along:g}"
        yield Measured(f"largest displacement off, {name}", off, 0.0, "m", WIDTH)
        yield Measured(f"force per width, {name}", pulled, pull, "N/m")


CASE = Case(
    name="uniaxial-pull",
    title="An irregular sheet pulled along one direction, static: its contraction and the force",
    source="closed form E22 = −(c12/c22) E11, P11 = λ (c11 − c12²/c22)(λ² − 1)/2",
    resolutions=(3, 6, 12),
    measure=_measure,
    claim=Exact(1e-10),
)
