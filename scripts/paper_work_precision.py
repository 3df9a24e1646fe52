"""Error against CPU time on the paper scene: the paper's semi-implicit steps and the other integrators.

    OMP_NUM_THREADS=1 python scripts/paper_work_precision.py [--setting bdf2:0.01 …] [--repeats 3] [--json]
        [--plot FILE.png] [-petsc options]

Runs configs/paper.yaml to t = 0.48 s with each setting and compares with the ensemble of
tests/reference/paper.json: kinetic energy at the end and over the fall (root mean square over the twelve
reference times, relative to its largest mean), and the centre of mass, at the end and at its worst of these
times [m]. Below the table it says which setting of the paper's method and which of ours is the fastest
within 10, 5, 2 and 1 % of the kinetic energy over the fall; --plot draws it.

The scene is chaotic; the last row says how far single correct calculations are apart, and errors below that
are not resolved. CPU time is user + system of the steps alone, the median of the repeats. Try ``-mat_type
sbaij -pc_type cholesky`` beside the default: at 256 vertices factors win while Δt is large.
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
from lyra_petsc.stepping.simulation import SteppedScene  # noqa: E402

ROOT = Path(__file__).resolve().parent.parent
REFERENCE = json.loads((ROOT / "tests" / "reference" / "paper.json").read_text(encoding="utf-8"))
SETTINGS = (
    *(f"semi-implicit:{0.005 / 2**i}" for i in range(9)),
    *(f"beuler:{0.005 / 2**i}" for i in range(3)),
    *(f"bdf2:{0.02 / 2**i}" for i in range(4)),
    *(f"alpha2:{0.01 / 2**i}" for i in range(2)),
)
HEADINGS = (
    "integrator",
    "Δt [ms]",
    "CPU [s]",
    "kinetic energy",
    "over the fall",
    "centre of mass [mm]",
    "its worst [mm]",
    "steps (rejected)",
    "Newton",
    "CG",
)


def rms(differences: list[float]) -> float:
    """Root mean square of differences of the kinetic energy over its largest mean."""
    largest = max(REFERENCE["mean"]["kinetic_energy"])
    return float(np.sqrt(np.mean(np.square(differences)))) / largest


def run(setting: str) -> dict[str, Any]:
    """One calculation; errors against the ensemble's mean."""
    integrator, _, step = setting.partition(":")
    scene = load_scene(
        ROOT / "configs" / "paper.yaml", (f"time.integrator={integrator}", f"time.step={float(step):.12f}")
    )
    simulation = SteppedScene(MPI.COMM_WORLD, scene)
    times, mean = np.array(REFERENCE["times"]), REFERENCE["mean"]
    system = simulation.problem.system
    mass = system.mass[:, None]
    kinetic, fall, apart, reports, failure = np.inf, [], [], [], ""
    seconds = -time.process_time()
    try:
        while not simulation.finished:
            reports.append(simulation.step())
            [hit] = np.nonzero(np.abs(times - simulation.time) < 1e-9)
            if len(hit):
                centre = (mass * system.x).sum(axis=0) / mass.sum()
                expected = mean["mean_y"][hit[0]], mean["mean_z"][hit[0]]
                apart.append(float(np.linalg.norm(centre[1:] - expected)))
                kinetic = simulation.budget.kinetic / mean["kinetic_energy"][hit[0]] - 1.0
                fall.append(simulation.budget.kinetic - mean["kinetic_energy"][hit[0]])
    except SolverError as error:
        failure = str(error)
    seconds += time.process_time()
    simulation.destroy()
    return {
        "integrator": integrator,
        "step": float(step),
        "seconds": seconds,
        "kinetic_energy": kinetic,
        "fall": rms(fall) if len(fall) == len(times) else np.inf,
        "centre": apart[-1] if apart else None,
        "worst_centre": max(apart, default=None),
        "steps": len(reports),
        "rejected": sum(report.rejected for report in reports),
        "newton_iterations": sum(report.newton_iterations for report in reports),
        "linear_iterations": sum(report.linear_iterations for report in reports),
        "failure": failure,
    }


def line(row: dict[str, Any]) -> str:
    """A row of the Markdown table."""
    errors = ("failed", "", "", "")
    if not row["failure"]:
        errors = (
            f"{100 * row['kinetic_energy']:+.1f} %",
            f"{100 * row['fall']:.2f} %",
            f"{1e3 * row['centre']:.1f}",
            f"{1e3 * row['worst_centre']:.1f}",
        )
    cells = (
        row["integrator"],
        f"{1e3 * row['step']:.4g}",
        f"{row['seconds']:.2f}",
        *errors,
        f"{row['steps']} ({row['rejected']})",
        row["newton_iterations"],
        row["linear_iterations"],
    )
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def scatter() -> str:
    """The row with the deviation of a single correct calculation."""
    spread, mean = REFERENCE["spread"], REFERENCE["mean"]
    kinetic = spread["kinetic_energy"][-1] / mean["kinetic_energy"][-1]
    apart = 1e3 * np.hypot(spread["mean_y"], spread["mean_z"])
    return (
        f"| *standard deviation of the ensemble* | | | {100 * kinetic:.1f} % "
        f"| {100 * rms(spread['kinetic_energy']):.2f} % | {apart[-1]:.1f} "
        f"| {apart.max():.1f} | | | |"
    )


def verdicts(rows: list[dict[str, Any]]) -> list[str]:
    """The fastest setting of the paper's method and of the others within several accuracies."""
    lines = []
    for bound in (0.1, 0.05, 0.02, 0.01):
        good = [row for row in rows if row["fall"] <= bound and not row["failure"]]
        words = []
        for theirs in (True, False):
            mine = [row for row in good if (row["integrator"] == "semi-implicit") == theirs]
            best = min(mine, key=lambda row: row["seconds"], default=None)
            who = "the paper's method" if theirs else "the others"
            words.append(
                f"none of {who}"
                if best is None
                else f"{best['integrator']} Δt {1e3 * best['step']:.4g} ms, {best['seconds']:.2f} s"
            )
        lines.append(f"within {100 * bound:g} % of the kinetic energy over the fall: {'; '.join(words)}")
    return lines


def draw(rows: list[dict[str, Any]], file: Path) -> None:
    """The work-precision diagram."""
    from lyra_petsc.show.report.plots import Series, work_precision

    names = dict.fromkeys(row["integrator"] for row in rows)
    groups = {name: [row for row in rows if row["integrator"] == name] for name in names}
    drawing = work_precision(
        [
            Series(
                name,
                [row["seconds"] for row in group],
                [row["fall"] for row in group],
                labels=[f"{1e3 * row['step']:.3g} ms" for row in group],
            )
            for name, group in groups.items()
        ],
        name=file.stem,
        caption="",
        x_label="CPU time [s]",
        y_label="error in kinetic energy over the fall",
        floor=rms(REFERENCE["spread"]["kinetic_energy"]),
        floor_label="spread of correct calculations",
    )
    file.write_bytes(drawing.png)


@click.command()
@click.option("--setting", "settings", multiple=True, default=SETTINGS, help="INTEGRATOR:Δt in seconds")
@click.option("--repeats", type=int, default=1, help="of which the median is printed")
@click.option("--plot", type=click.Path(path_type=Path), help="PNG file of the diagram")
@click.option("--json", "as_json", is_flag=True, help="JSON instead of a table")
def compare(settings: tuple[str, ...], repeats: int, plot: Path | None, as_json: bool) -> None:
    run("beuler:0.04")  # compiles or loads the kernels
    if not as_json:
        print("| " + " | ".join(HEADINGS) + " |\n" + "| --- " * len(HEADINGS) + "|", flush=True)
    rows = []
    for setting in settings:
        tries = [run(setting) for _ in range(repeats)]
        rows.append(tries[0] | {"seconds": statistics.median(each["seconds"] for each in tries)})
        if not as_json:
            print(line(rows[-1]), flush=True)
    print(json.dumps(rows, indent=1) if as_json else "\n".join([scatter(), "", *verdicts(rows)]))
    if plot is not None:
        draw(rows, plot)


if __name__ == "__main__":
    compare(args=ours)
