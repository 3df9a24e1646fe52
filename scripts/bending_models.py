"""Error against run time of both bending models: a square plate under a small uniform load.

    OMP_NUM_THREADS=1 python scripts/bending_models.py [--case "CFFF 0"] [--runs 3] [--out FILE.svg]

Prints a Markdown table of the relative error of the deflection against Kirchhoff's plate theory, and of the
wall time of the static analysis with set-up (median of the runs). With --out it also draws them as an SVG.
Kernels are compiled before the measurement; the linear solver is direct, as in ``verify plate``.
"""

from __future__ import annotations

import statistics
from pathlib import Path

import click
import numpy as np
from mpi4py import MPI

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.verification.flat_plates import flat_mesh, held
from lyra_petsc.experiments.verification.verification_case import load_data
from lyra_petsc.show.report.plots import Series, work_precision

PLATES = load_data("linear_plate")["deflection"]
"""Reference deflections by edge conditions (C clamped, S supported, F free) and Poisson's ratio."""

KINDS = ("alternating", "gmsh")
SIZES = (8, 16, 32, 64, 128)
THICKNESS = 0.01  # m, of a plate of 1 m
STIFFNESS = 1.0  # bending stiffness [N m]
DEFLECTION = 1e-6
"""Scale of the deflection [m], small enough for linear behaviour."""


def measure(bench: Bench, name: str, model: str, kind: str, n: int) -> tuple[float, float]:
    """Relative error of the deflection, and wall seconds."""
    exact = PLATES[name]
    edges, ratio = name.split()
    poisson = float(ratio)
    scene = {
        "mesh": flat_mesh(bench, kind, n, n),
        "material": {
            "young": 12.0 * (1.0 - poisson**2) * STIFFNESS / THICKNESS**3,
            "poisson": poisson,
            "thickness": THICKNESS,
            "density": 1.0,
            "bending_model": model,
        },
        "gravity": [0.0, 0.0, DEFLECTION / exact["at"]],
        "handles": held(edges),
        "time": {"analysis": "static", "step": 1.0},
    }
    with bench.simulation(scene) as trial:
        height, start = trial.run().x[:, 2], trial.start[:, :2]
    at = int(np.argmin(np.linalg.norm(start - exact["place"], axis=1)))
    return abs(float(height[at]) / DEFLECTION - 1.0), bench.latest[1]


@click.command(help=__doc__)
@click.option("--case", "name", type=click.Choice(list(PLATES)), default="CFFF 0", show_default=True)
@click.option("--runs", default=3, show_default=True)
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path))
def main(name: str, runs: int, out: Path | None) -> None:
    """Measure, print, draw."""
    lines = []
    click.echo("| model | mesh | n | error [%] | run time [s] |\n| --- | --- | --- | --- | --- |")
    with Bench(MPI.COMM_SELF) as bench:
        for model in ("hinge", "midedge"):
            for kind in KINDS:
                measure(bench, name, model, kind, SIZES[0])
                errors, seconds = [], []
                for n in SIZES:
                    results = [measure(bench, name, model, kind, n) for _ in range(runs)]
                    errors.append(100.0 * results[0][0])
                    seconds.append(statistics.median(wall for _, wall in results))
                    click.echo(f"| {model} | {kind} | {n} | {errors[-1]:.3g} | {seconds[-1]:.2f} |")
                lines.append(Series(f"{model}, {kind}", seconds, errors, labels=[f"{n}" for n in SIZES]))
    if out is not None:
        caption = f"Deflection of a square plate ({name}); beside the points: cells a side"
        drawing = work_precision(lines, name=out.stem, caption=caption, y_label="error of the deflection [%]")
        out.write_bytes(drawing.svg)


if __name__ == "__main__":
    main()
