"""Error against CPU time on the paper scene: the paper's semi-implicit steps and the other integrators.

    OMP_NUM_THREADS=1 python scripts/paper_work_precision.py [--setting bdf2:0.01 …] [--repeats 3]
        [--plot FILE.png] [-petsc options]

Runs configs/paper.yaml to t = 0.48 s with each setting and compares its kinetic energy with the ensemble of
tests/reference/paper.json: root mean square over the twelve reference times, relative to its largest mean.

The scene is chaotic; the last row is the standard deviation between correct calculations, and errors below it
are not resolved. CPU time is user + system of the steps alone, the median of the repeats. Compare the default
with ``-mat_type sbaij -pc_type cholesky``: at 256 vertices factorisation is faster for large Δt.
"""

from __future__ import annotations

import json
import statistics
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
from lyra_petsc.show.report.plots import Series, work_precision  # noqa: E402
from lyra_petsc.stepping.simulation import SteppedScene  # noqa: E402

ROOT = Path(__file__).resolve().parent.parent
REFERENCE = json.loads((ROOT / "tests" / "reference" / "paper.json").read_text(encoding="utf-8"))
TIMES, MEAN = np.array(REFERENCE["times"]), np.array(REFERENCE["mean"]["kinetic_energy"])
SETTINGS = (
    *(f"semi-implicit:{0.005 / 2**i}" for i in range(9)),
    *(f"beuler:{0.005 / 2**i}" for i in range(3)),
    *(f"bdf2:{0.02 / 2**i}" for i in range(4)),
    *(f"alpha2:{0.01 / 2**i}" for i in range(2)),
)


def rms(differences: Any) -> float:
    """Root mean square of differences of the kinetic energy over its largest mean."""
    return float(np.sqrt(np.mean(np.square(differences)))) / float(MEAN.max())


def run(setting: str) -> dict[str, Any]:
    """Run one calculation; its error is NaN if it ended early."""
    integrator, _, step = setting.partition(":")
    scene = load_scene(
        ROOT / "configs" / "paper.yaml", (f"time.integrator={integrator}", f"time.step={float(step):.12f}")
    )
    simulation = SteppedScene(MPI.COMM_WORLD, scene)
    kinetic, reports = np.full(len(TIMES), np.nan), []
    began = time.process_time()
    try:
        while not simulation.finished:
            reports.append(simulation.step())
            kinetic[np.abs(TIMES - simulation.time) < 1e-9] = simulation.budget.kinetic
    except SolverError as error:
        print(f"{setting}: {error}", file=sys.stderr)
    seconds = time.process_time() - began
    simulation.destroy()
    return {
        "integrator": integrator,
        "Δt [ms]": f"{1e3 * float(step):.4g}",
        "seconds": seconds,
        "error": rms(kinetic - MEAN),
        "steps": len(reports),
        "Newton": sum(report.newton_iterations for report in reports),
        "CG": sum(report.linear_iterations for report in reports),
    }


@click.command()
@click.option("--setting", "settings", multiple=True, default=SETTINGS, help="INTEGRATOR:Δt in seconds")
@click.option("--repeats", type=int, default=1, help="of which the median is printed")
@click.option("--plot", type=click.Path(path_type=Path), help="PNG file of the diagram")
def compare(settings: tuple[str, ...], repeats: int, plot: Path | None) -> None:
    """Measure, print, draw."""
    run("beuler:0.04")  # compiles or loads the kernels
    click.echo("| integrator | Δt [ms] | CPU [s] | error [%] | steps | Newton | CG |\n" + "| --- " * 7 + "|")
    rows: dict[str, list[dict[str, Any]]] = {}
    for setting in settings:
        tries = [run(setting) for _ in range(repeats)]
        row = tries[0] | {"seconds": statistics.median(attempt["seconds"] for attempt in tries)}
        rows.setdefault(row["integrator"], []).append(row)
        shown = row | {"seconds": f"{row['seconds']:.2f}", "error": f"{100 * row['error']:.2f}"}
        click.echo("| " + " | ".join(map(str, shown.values())) + " |")
    floor = rms(REFERENCE["spread"]["kinetic_energy"])
    click.echo(f"| *standard deviation of the ensemble* | | | {100 * floor:.2f} | | | |")
    if plot is not None:
        lines = []
        for name, of_one in rows.items():
            seconds, errors, steps = ([row[key] for row in of_one] for key in ("seconds", "error", "Δt [ms]"))
            lines.append(Series(name, seconds, errors, labels=[f"{step} ms" for step in steps]))
        drawing = work_precision(
            lines,
            name=plot.stem,
            caption="",
            x_label="CPU time [s]",
            y_label="error in kinetic energy over the fall",
            floor=floor,
            floor_label="spread of correct calculations",
        )
        plot.write_bytes(drawing.png)


if __name__ == "__main__":
    compare(args=ours)
