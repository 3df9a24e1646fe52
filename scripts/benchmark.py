"""Time per step of a square of gray interlock hung by two corners, next to the original Lyra's.

    mpirun -n 1 python scripts/benchmark.py [--vertices 1024 --vertices 10201] [--steps 10] [-petsc options]

One linear solve a step (semi-implicit), Δt 5 ms, γ 0.03 s, relative residual 1e-6; the median of the
steps after the first three, with the fastest and slowest. Prints a Markdown table. The original's
figures (CPU, one thread, its own scene of the same size) were measured on another machine.
"""

from __future__ import annotations

import math
import statistics
import sys

import petsc4py

from lyra_petsc.cli.arguments import split

ours, petsc = split(sys.argv[1:])
petsc4py.init([sys.argv[0], *petsc])

import click  # noqa: E402
from mpi4py import MPI  # noqa: E402

from lyra_petsc.scene.schema import Scene  # noqa: E402
from lyra_petsc.simulation import Simulation  # noqa: E402

ORIGINAL_MS = {1024: "30-44", 10201: "1434", 50176: "27300"}
WARM_UP = 3


def scene(vertices: int, steps: int) -> Scene:
    """The hanging square with that many vertices (a square number)."""
    cells = math.isqrt(vertices) - 1
    step = 0.005
    return Scene.model_validate(
        {
            "mesh": {"grid": {"width": 1.0, "height": 1.0, "nx": cells, "ny": cells}},
            "material": {"cloth": "gray-interlock", "damping": 0.03},
            "gravity": [0, 0, -9.81],
            "handles": [{"nodes": [cells * (cells + 1), (cells + 1) ** 2 - 1]}],
            "time": {"end": step * (steps + WARM_UP), "step": step, "integrator": "semi-implicit"},
        }
    )


@click.command()
@click.option("--vertices", multiple=True, type=int, default=(1024, 10201, 50176))
@click.option("--steps", type=int, default=10)
def benchmark(vertices: tuple[int, ...], steps: int) -> None:
    comm = MPI.COMM_WORLD
    if comm.rank == 0:
        print("| vertices | ranks | ms a step, median (fastest-slowest) | CG iterations | original, ms |")
        print("| --- | --- | --- | --- | --- |")
    for count in vertices:
        simulation = Simulation(comm, scene(count, steps))
        reports = [simulation.step() for _ in range(steps + WARM_UP)][WARM_UP:]
        times = [1e3 * report.wall_seconds for report in reports]
        iterations = statistics.median(report.linear_iterations for report in reports)
        if comm.rank == 0:
            print(
                f"| {count} | {comm.size}"
                f" | {statistics.median(times):.1f} ({min(times):.1f}-{max(times):.1f})"
                f" | {iterations:.0f} ({simulation.stepper.preset}) | {ORIGINAL_MS.get(count, '')} |",
                flush=True,
            )
        simulation.destroy()


if __name__ == "__main__":
    benchmark(args=ours)
