"""What a fit costs beside simulations: four numbers of a hanging cloth of 2,500 vertices over 0.5 s.

    python scripts/fit_benchmark.py [INTEGRATOR]

CPU time of a simulation (median of three), of one with derivatives, and of the whole fit over a simulation.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import numpy as np
from mpi4py import MPI

import lyra_petsc
from lyra_petsc.experiments.fit.model import Model
from lyra_petsc.experiments.fit.readings import readings_of
from lyra_petsc.experiments.fit.work import fit_scene

TRUE = {
    "material.membrane.c33": 50.0,
    "material.bending": 1e-4,
    "material.damping": 0.02,
    "material.density": 0.2,
}
STARTS = (1.6, 0.5, 1.5, 1.2)
CELLS = 49
SIGMA = 1e-3


def scene(integrator: str) -> dict[str, Any]:
    """The cloth, measured at two corners and in its middle at five times."""
    corners = {"a": CELLS * (CELLS + 2), "b": CELLS * (CELLS + 1), "m": (CELLS + 2) * (CELLS // 2)}
    parameters = {
        key: {"start": factor * value, "bounds": [0.1 * value, 10.0 * value]}
        for (key, value), factor in zip(TRUE.items(), STARTS, strict=True)
    }
    measurements = [
        {"probe": probe, "at": at, "value": [0.0, 0.0, 0.0], "uncertainty": SIGMA}
        for probe in corners
        for at in (0.1, 0.2, 0.3, 0.4, 0.5)
    ]
    return {
        "mesh": {"grid": {"width": 1.0, "height": 1.0, "nx": CELLS, "ny": CELLS, "pattern": "alternating"}},
        "material": {
            "density": 0.2,
            "membrane": {"c11": 200.0, "c22": 150.0, "c12": 40.0, "c33": 50.0},
            "bending": 1e-4,
            "damping": 0.02,
        },
        "gravity": [0.0, 0.0, -9.81],
        "wind": {"velocity": [0.5, 2.0, 0.0], "density": 1.2, "drag": 0.3},
        "handles": [{"nodes": [0, CELLS]}],
        "probes": {name: {"nodes": [vertex]} for name, vertex in corners.items()},
        "time": {"end": 0.5, "step": 0.005, "integrator": integrator},
        "fit": {"parameters": parameters, "measurements": measurements},
    }


def seconds(work: Callable[[], Any]) -> float:
    """CPU time [s] of a call."""
    began = time.process_time()
    work()
    return time.process_time() - began


def main() -> None:
    """Measure and print."""
    loaded = lyra_petsc.load(scene(sys.argv[1] if len(sys.argv) > 1 else "beuler"))
    assert loaded.fit is not None
    comm = MPI.COMM_WORLD
    model = Model(comm, loaded, TRUE, readings_of(loaded, loaded.fit.measurements))
    exact = model.evaluate(list(TRUE.values())).values  # and compiles
    alone = median(seconds(lambda: model.evaluate(list(TRUE.values()), derivatives=False)) for _ in range(3))
    beside = median(seconds(lambda: model.evaluate(list(TRUE.values()))) for _ in range(3))
    noisy = exact + SIGMA * np.random.default_rng(1).standard_normal(len(exact))
    lengths = np.cumsum([len(reading.parts) for reading in model.readings])[:-1]
    whole = seconds(lambda: fit_scene(comm, loaded, measured=np.split(noisy, lengths)))
    if comm.rank == 0:
        print(
            f"one simulation {alone:.2f} s, with four derivatives {beside:.2f} s ({beside / alone:.1f} times)"
        )
        print(f"the fit {whole:.1f} s: as long as {whole / alone:.0f} simulations")


if __name__ == "__main__":
    main()
