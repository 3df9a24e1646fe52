"""What a fit costs beside simulations: four numbers of a hanging cloth of 2,500 vertices over 0.5 s.

    python scripts/fit_benchmark.py [INTEGRATOR]

CPU time of a simulation (median of three), of one with derivatives (6 times that), and of the whole fit (23
simulations).
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from statistics import median
from typing import Any

from fit_coverage import hanging_cloth, measured
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

HANGING: dict[str, Any] = {
    "material": {
        "density": 0.2,
        "membrane": {"c11": 200.0, "c22": 150.0, "c12": 40.0, "c33": 50.0},
        "bending": 1e-4,
        "damping": 0.02,
    },
    "wind": {"velocity": [0.5, 2.0, 0.0], "density": 1.2, "drag": 0.3},
}


def scene(integrator: str) -> dict[str, Any]:
    """The cloth, measured at two corners and in its middle at five times."""
    watched = CELLS * (CELLS + 2), CELLS * (CELLS + 1), (CELLS + 2) * (CELLS // 2)
    sought = {key: (value, start) for (key, value), start in zip(TRUE.items(), STARTS, strict=True)}
    time = {"end": 0.5, "step": 0.005, "integrator": integrator}
    return hanging_cloth(1.0, CELLS, watched, sought, (0.1, 10.0), SIGMA, **HANGING, time=time)


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
    noisy = measured(model, exact, SIGMA, 1)
    whole = seconds(lambda: fit_scene(comm, loaded, measured=noisy))
    if comm.rank == 0:
        print(
            f"one simulation {alone:.2f} s, with four derivatives {beside:.2f} s ({beside / alone:.1f} times)"
        )
        print(f"the fit {whole:.1f} s: as long as {whole / alone:.0f} simulations")


if __name__ == "__main__":
    main()
