"""Error against CPU time on the swing: position of the free edge at t = 0.4 s.

    OMP_NUM_THREADS=1 python scripts/swing_benchmark.py [--setting alpha2:0.01 …] [--c11 1e3 …]
        [--cells 70] [--set KEY=VALUE …] [--json] [-petsc options]

Runs configs/swing.yaml (71 × 71 vertices, 9800 triangles) once for each setting and stiffness and prints a
Markdown table: distance of the free edge's mean from the converged answer (tests/reference/swing.json), and
user + system seconds of one core for each simulated second, of the steps alone and with the set-up of the
scene. The time to load Python and compiled kernels is in the last line. States are not written.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import petsc4py

from lyra_petsc.cli.arguments import split

ours, petsc = split(sys.argv[1:])
petsc4py.init([sys.argv[0], *petsc])

import click  # noqa: E402
import numpy as np  # noqa: E402
from mpi4py import MPI  # noqa: E402

from lyra_petsc.errors import SolverError  # noqa: E402
from lyra_petsc.scene.load import load_scene  # noqa: E402
from lyra_petsc.stepping.simulation import SteppedScene  # noqa: E402

ROOT = Path(__file__).resolve().parent.parent
END = 0.4  # s
SETTINGS = (f"beuler:{1 / 60}", f"bdf2:{1 / 120}", f"alpha2:{1 / 120}", "alpha2:0.01")
HEADINGS = (
    "c11 [N/m]",
    "integrator",
    "Δt [ms]",
    "error [mm]",
    "steps (rejected)",
    "Newton",
    "CG",
    "CPU s/s, steps",
    "CPU s/s, with set-up",
    "linear solver",
)


def measure(c11: float, setting: str, cells: int, more: tuple[str, ...]) -> dict[str, Any]:
    """One run; times in seconds, lengths in metres."""
    integrator, _, step = setting.partition(":")
    values = {
        "mesh.grid.nx": cells,
        "mesh.grid.ny": cells,
        "material.membrane.c11": c11,
        "material.membrane.c22": c11,
        "material.membrane.c33": c11 / 2,
        "time.end": END,
        "time.step": step,
        "time.integrator": integrator,
        "output.every": END,  # no step is shortened for a state
    }
    scene = load_scene(
        ROOT / "configs" / "swing.yaml", (*(f"{key}={value}" for key, value in values.items()), *more)
    )
    begun = time.process_time()
    simulation = SteppedScene(MPI.COMM_WORLD, scene)
    stepping = time.process_time()
    reports, failure = [], ""
    try:
        while not simulation.finished:
            reports.append(simulation.step())
    except SolverError as error:
        failure = str(error)
    ended = time.process_time()
    edge = simulation.problem.system.x[simulation.problem.probes["edge"]].mean(axis=0)[[0, 2]]
    answers = json.loads((ROOT / "tests" / "reference" / "swing.json").read_text(encoding="utf-8"))
    exact = np.array(answers["stiffness"][f"{c11:g}"]["continuum"][-1][1:])
    row = {
        "c11": c11,
        "integrator": integrator,
        "step": scene.time.step,
        "error": None if failure else float(np.linalg.norm(edge - exact)),
        "steps": len(reports),
        "rejected": sum(report.rejected for report in reports),
        "newton_iterations": sum(report.newton_iterations for report in reports),
        "linear_iterations": sum(report.linear_iterations for report in reports),
        "cpu_steps": (ended - stepping) / simulation.time if simulation.time else None,
        "cpu_with_setup": (ended - begun) / simulation.time if simulation.time else None,
        "linear_solver": simulation.stepper.preset if not petsc else " ".join(petsc),
        "failure": failure,
    }
    simulation.destroy()
    return row


def line(row: dict[str, Any]) -> str:
    """A row of the Markdown table."""
    step = row["step"] if isinstance(row["step"], str) else f"{1e3 * row['step']:.3g}"
    cells = (
        f"{row['c11']:g}",
        row["integrator"],
        step,
        "failed" if row["failure"] else f"{1e3 * row['error']:.2f}",
        f"{row['steps']} ({row['rejected']})",
        row["newton_iterations"],
        row["linear_iterations"],
        f"{row['cpu_steps']:.1f}" if row["cpu_steps"] else "",
        f"{row['cpu_with_setup']:.1f}" if row["cpu_with_setup"] else "",
        row["linear_solver"],
    )
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


@click.command()
@click.option("--setting", "settings", multiple=True, default=SETTINGS, help="INTEGRATOR:Δt in seconds")
@click.option("--c11", "stiffnesses", multiple=True, type=float, default=(1e3,), help="1e3, 1e5 or 1e7 N/m")
@click.option("--cells", type=int, default=70, help="along each side")
@click.option("--set", "more", multiple=True, help="KEY=VALUE of the scene")
@click.option("--json", "as_json", is_flag=True, help="JSON instead of a table")
def benchmark(
    settings: tuple[str, ...],
    stiffnesses: tuple[float, ...],
    cells: int,
    more: tuple[str, ...],
    as_json: bool,
) -> None:
    started = time.process_time()  # Python is up
    measure(1e3, "alpha2:0.2", 2, ())  # compiles or loads the kernels
    loaded = time.process_time() - started
    if not as_json:
        print("| " + " | ".join(HEADINGS) + " |\n" + "| --- " * len(HEADINGS) + "|", flush=True)
    rows = []
    for c11 in stiffnesses:
        for setting in settings:
            rows.append(measure(c11, setting, cells, more))
            if not as_json:
                print(line(rows[-1]), flush=True)
    if as_json:
        print(json.dumps({"python": started, "kernels": loaded, "rows": rows}, indent=1))
    else:
        print(
            f"\nOnce a process: {started:.1f} s for Python and its modules, {loaded:.1f} s for the kernels."
        )


if __name__ == "__main__":
    benchmark(args=ours)
