"""Counts Newton iterations of sheets that fall onto round or edged obstacles with small gaps.

    python scripts/small_gaps.py [NAME] …

NAME is one of the scenes (default all): 24 × 24 cells of gray interlock, 1 m wide. The table has steps,
repeated steps, Newton iterations of accepted steps (median, maximum) and of all attempts, linear iterations,
and CPU time [s], each with and without the contact model of the line search
(`stepping/newton/contact_model.py`).
"""

from __future__ import annotations

import statistics
import sys
import time
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.newton.contact_model import ContactModel
from lyra_petsc.stepping.simulation import SteppedScene

BALL = {"sphere": {"center": [0.0, 0.0, -0.35], "radius": 0.3}}
ROD = {"capsule": {"from": [-0.2, 0.0, -0.2], "to": [0.3, 0.05, -0.22], "radius": 0.15}}
BOX = {"box": {"min": [-0.3, -0.2, -0.4], "max": [0.21, 0.25, -0.05]}}

# obstacle, gap [m], Δt [s], end [s], friction, integrator
SCENES: dict[str, tuple[dict[str, Any], float, float, float, float, str]] = {
    "ball": (BALL, 1e-5, 0.01, 0.2, 0.0, "beuler"),
    "ball-midpoint": (BALL, 1e-5, 0.01, 0.24, 0.0, "midpoint"),
    "ball-alpha2": (BALL, 1e-5, 0.01, 0.24, 0.0, "alpha2"),
    "ball-bdf2": (BALL, 1e-5, 0.01, 0.24, 0.0, "bdf2"),
    "ball-drapes": (BALL, 1e-5, 0.01, 0.4, 0.0, "beuler"),
    "ball-rubs": (BALL, 1e-5, 0.01, 0.3, 0.4, "beuler"),
    "ball-short-steps": (BALL, 1e-5, 0.005, 0.3, 0.0, "beuler"),
    "ball-long-steps": (BALL, 1e-5, 0.04, 0.4, 0.0, "beuler"),
    "ball-larger-gap": (BALL, 1e-4, 0.01, 0.4, 0.0, "beuler"),
    "rod": (ROD, 1e-5, 0.01, 0.3, 0.0, "beuler"),
    "box": (BOX, 1e-5, 0.01, 0.25, 0.0, "beuler"),
}


def scene(name: str) -> Scene:
    obstacle, gap, step, end, friction, integrator = SCENES[name]
    grid = {"width": 1.0, "height": 1.0, "nx": 24, "ny": 24, "pattern": "alternating"}
    return Scene.model_validate(
        {
            "mesh": {"grid": grid, "transform": {"translate": [-0.5, -0.48, 0.0]}},
            "material": {"cloth": "gray-interlock", "damping": 0.0},
            "gravity": [0.0, 0.0, -9.81],
            "contact": {"gap": gap, "friction": friction},
            "obstacles": {"it": obstacle},
            "time": {"end": end, "step": step, "integrator": integrator},
        }
    )


def count(name: str) -> list[Any]:
    """Run a scene; returns the numbers of its row."""
    simulation = SteppedScene(MPI.COMM_WORLD, scene(name))
    begin, newton, linear, repeated, attempts = time.process_time(), [], 0, 0, 0
    attempt = simulation.stepper.attempt

    def counted(t0: float, t1: float) -> Any:
        nonlocal attempts
        result = attempt(t0, t1)
        attempts += result.newton_iterations
        newton[-1:] = [result.newton_iterations]
        return result

    simulation.stepper.attempt = counted  # type: ignore[method-assign]
    while not simulation.finished:
        newton.append(0)
        report = simulation.step()
        linear += report.linear_iterations
        repeated += report.rejected
    seconds = time.process_time() - begin
    for option in simulation.stepper.our_options:
        PETSc.Options().delValue(option)
    return [len(newton), repeated, statistics.median(newton), max(newton), attempts, linear, f"{seconds:.1f}"]


def main(names: list[str]) -> None:
    improve = ContactModel.improve
    print("| scene | model | steps | repeated | median | most | Newton | linear | CPU [s] |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for name in names or SCENES:
        if name not in SCENES:
            sys.exit(f"no such scene '{name}'; there are {', '.join(SCENES)}")
        for model in ("yes", "no"):
            chosen = improve if model == "yes" else lambda *_: False
            ContactModel.improve = chosen  # type: ignore[method-assign,assignment]
            print("|", " | ".join(map(str, [name, model, *count(name)])), "|", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
