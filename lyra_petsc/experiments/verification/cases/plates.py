"""Plates and strips with directors on edges converge to Kirchhoff plates on every kind of mesh.

Deflections, curvatures and small vibrations.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.verification.flat_plates import (
    KINDS,
    flat_mesh,
    held,
    lowest_modes,
    plate_material,
)
from lyra_petsc.experiments.verification.verification_case import (
    ASSEMBLED,
    STATIC,
    Measured,
    load_data,
    scene,
    worst_value,
)
from lyra_petsc.terms.bending.midedge import MidEdge

EXACT = load_data("linear_plate")
AT_ONCE = STATIC | {"step": 1.0}


def plate(bench: Bench, n: float) -> Iterator[Measured]:
    # deflection over the side. Stretching changes the relative deflection by 220 times its square
    largest = 1e-4
    # looser than the default, which 128 × 128 cells miss by round-off; two iterations give nine digits
    loose = {"force_tolerance": 1e-6, "step_tolerance": 1e-6}
    for label, exact in EXACT["deflection"].items():
        edges, poisson = label.split()
        material, load = plate_material(1.0, poisson=float(poisson)), [0.0, 0.0, largest / exact["at"]]
        loaded = partial(scene, gravity=load, handles=held(edges), solver=loose)
        for kind in KINDS:
            mesh = flat_mesh(bench, kind, round(n), round(n))
            with bench.simulation(loaded(mesh, material, AT_ONCE)) as trial:
                height, start = trial.run().x[:, 2], trial.start[:, :2]
            at = int(np.argmin(np.linalg.norm(start - exact["place"], axis=1)))
            value = float(height[at]) / largest
            yield Measured(f"deflection, {edges}, ν = {poisson}, {kind}", value, 1.0)


# -- constant curvature ----------------------------------------------------------------------------------


CORNERS: list[tuple[float, float, list[str]]] = [
    (0.0, 0.0, ["x", "y", "z"]), (1.0, 0.0, ["y", "z"]), (0.0, 1.0, ["z"]),
]  # fmt: skip
"""Corners and axes whose supports exclude rigid motions only, so that their reactions vanish."""


def _at(x: float, y: float) -> dict[str, Any]:
    return {"box": [[x - 1e-6, y - 1e-6, -1.0], [x + 1e-6, y + 1e-6, 1.0]]}


def plate_curvature(bench: Bench, n: float) -> Iterator[Measured]:
    # curvature × side
    small = 1e-5
    for poisson in (0.0, 0.3):
        material, moment = plate_material(1.0, poisson=poisson), small * (1.0 - poisson**2)
        loads: dict[str, tuple[list[dict[str, Any]], tuple[float, float, float]]] = {
            "bent": ([{"group": s, "moment": moment} for s in ("left", "right")], (1.0, -poisson, 0.0)),
            "twisted": ([_at(1.0, 1.0) | {"force": [0, 0, 2.0 * small * (1.0 - poisson)]}], (0.0, 0.0, 1.0)),
        }
        for label, (load, exact) in loads.items():
            for kind in KINDS:
                mesh = flat_mesh(bench, kind, round(n), round(n))
                body = [_at(x, y) | {"axes": axes} for x, y, axes in CORNERS]
                with bench.simulation(scene(mesh, material, AT_ONCE, loads=load, handles=body)) as trial:
                    curvatures = _curvatures(bench, trial.run()) / small
                for k, name in enumerate(("κ11", "κ22", "κ12")):
                    value = worst_value(curvatures[:, k], exact[k])
                    yield Measured(f"{name}, {label}, ν = {poisson:g}, {kind}", value, exact[k], scale=1.0)


def _curvatures(bench: Bench, trial: Trial) -> Array:
    """κ11, κ22, κ12 [1/m] of all triangles (F, 3); collective."""
    term, x = trial.simulation.problem.terms["midedge"], trial.simulation.problem.equations.x
    assert isinstance(term, MidEdge)
    return np.concatenate(bench.comm.allgather(term.curvatures(x, term.frames)[: term.n_owned]))


VIBRATIONS = load_data("plate_vibrations")


def plate_vibration(bench: Bench, n: float) -> Iterator[Measured]:
    # height of plates of length 1 m, and number of cells along the length over n
    for shape, (height, finer) in {"square": (1.0, 1), "strip": (0.2, 2)}.items():
        for label, exact in VIBRATIONS[shape].items():
            edges, poisson = label.split()
            for kind in KINDS:
                mesh = flat_mesh(bench, kind, round(finer * n), round(finer * n * height), 1.0, height)
                across = [{"group": "sheet", "axes": ["x", "y"]}, *held(edges)]
                material = plate_material(1.0, poisson=float(poisson))
                rigid = 3 if edges == "FFFF" else 0
                with bench.simulation(scene(mesh, material, ASSEMBLED, handles=across)) as trial:
                    # shift [1/s²] of the order of the lowest square, needed for the three rigid-body modes of
                    # a free plate
                    omegas, _ = lowest_modes(trial, rigid + len(exact), shift=400.0 if rigid else 0.0)
                for number, (omega, known) in enumerate(zip(omegas[rigid:], exact, strict=True), 1):
                    name = f"λ{number}, {shape}, {edges}, ν = {poisson}, {kind}"
                    yield Measured(name, float(omega), float(known))
