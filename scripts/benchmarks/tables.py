"""What was measured as Markdown, and the numbers derived from it."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from cases import BENDING_MODELS, METHODS

Result = dict[str, Any]

COUNTS_FROM = 4500
"""Vertices from which a size counts for the exponent of growth."""

PARTS = ("residual", "jacobian", "frozen", "energy", "preconditioner", "solve", "rest")
COLUMNS = (
    "vertices",
    "who",
    "ranks",
    "ms a step",
    "CPU ms",
    "times the first",
    "residual ms",
    "Jacobian ms",
    "frozen ms",
    "energy ms",
    "preconditioner ms",
    "solve ms",
    "rest ms",
    "MatMult ms",
    "assembly, MatMults",
    "PETSc's MatMult ms",
    "assembly, PETSc's MatMults",
    "CG iterations",
    "Newton iterations",
    "preset",
    "KB a vertex",
    "set-up s",
)


def number(value: float, digits: int = 3) -> str:
    """To so many significant digits, without an exponent where one can read it."""
    if not math.isfinite(value):
        return "–"
    if value == 0.0 or 1e-4 <= abs(value) < 1e7:
        places = digits - 1 - (math.floor(math.log10(abs(value))) if value else 0)
        return f"{value:.{max(0, places)}f}"
    return f"{value:.{digits - 1}e}"


def spread(values: Sequence[float], factor: float = 1.0) -> str:
    """Median (fastest-slowest)."""
    low, middle, high = (factor * f(values) for f in (min, statistics.median, max))
    return f"{number(middle)} ({number(low)}-{number(high)})"


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """Lines of a Markdown table."""
    names = list(head)
    lines = [names, ["---"] * len(names), *(list(row) for row in rows)]
    return ["| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines]


def median_of(row: Result, name: str) -> float:
    """Median over the steps of a row."""
    return float(statistics.median(step[name] for step in row["steps"]))


def step_seconds(row: Result) -> list[float]:
    """Seconds of each measured step, ours or a peer's."""
    return row["step_seconds"] if "step_seconds" in row else [step["seconds"] for step in row["steps"]]


def main_table(rows: Sequence[Result]) -> list[str]:
    """Rows of ours and of peers, by size; ratios to the first method on one rank at that size."""
    first = {}
    for row in rows:
        if row["who"] == METHODS[0]:
            first.setdefault(row["vertices"], row)
    ordered = sorted(rows, key=lambda row: row["vertices"])
    return table(COLUMNS, (_cells(row, first.get(row["vertices"])) for row in ordered))


def _cells(row: Result, first: Result | None) -> list[str]:
    times = step_seconds(row)
    ratio = math.nan
    if first is not None and median_of(first, "seconds") > 0.0:
        ratio = statistics.median(times) / median_of(first, "seconds")
    cpu = statistics.median(row["cpu_seconds"]) if "cpu_seconds" in row else median_of(row, "cpu")
    cells = [str(row["vertices"]), row["who"], str(row["ranks"])]
    cells += [spread(times, 1e3), number(1e3 * cpu), number(ratio)]
    if "step_seconds" in row:
        return cells + ["–"] * (len(COLUMNS) - len(cells))
    products = [row["matmult_seconds"], row["petsc_matmult_seconds"]]
    assembly = [step["assembly"] for step in row["steps"]]
    compared = [
        cell
        for times in products
        for cell in (spread(times, 1e3), spread([each / statistics.median(times) for each in assembly]))
    ]
    return [
        *cells,
        *(number(1e3 * median_of(row, part)) for part in PARTS),
        *compared,
        number(median_of(row, "cg")),
        number(median_of(row, "newton")),
        row["preset"],
        number(sum(row["peak_bytes"]) / row["vertices"] / 1000),
        number(row["set_up_seconds"]),
    ]


def of_vertex(found: Result) -> float:
    """CPU seconds of a step over vertices."""
    return median_of(found, "cpu") / found["vertices"]


def contact_table(results: Sequence[Result]) -> list[str]:
    """Steps in contact beside those of the sheets that swing, named before them; how both grow with the
    vertices, and what further ranks bring.
    """
    rows = []
    for result in results:
        base: Result = {}
        for name, found in result["meshes"].items():
            base = found if "swing" in name and "near" not in name else base
            cells = ["", "", ""]
            if base and base["all_cpu"] > 0.0:
                ratios = [a["cpu"] / b["cpu"] for a, b in zip(found["steps"], base["steps"], strict=False)]
                cells = [spread(ratios), number(found["all_cpu"] / base["all_cpu"])]
                cells.append(number(median_of(found, "cg") / max(1.0, median_of(base, "cg"))))
            rows.append(
                [
                    str(found["vertices"]),
                    str(result["ranks"]),
                    name,
                    spread([step["cpu"] for step in found["steps"]], 1e3),
                    spread([step["seconds"] for step in found["steps"]], 1e3),
                    cells[0],
                    cells[1],
                    number(median_of(found, "newton")),
                    number(median_of(found, "cg")),
                    cells[2],
                    found["preset"],
                ]
            )
    head = (
        "vertices",
        "ranks",
        "sheets",
        "CPU ms a step",
        "wall ms a step",
        "CPU, times those that swing",
        "the whole run",
        "Newton iterations",
        "CG iterations",
        "times those that swing",
        "preset",
    )
    return [*table(head, rows), *_growth_of_contact(results)]


def _growth_of_contact(results: Sequence[Result]) -> list[str]:
    """Exponents of the cost of a step on one rank, and the wall time of one rank over that of several."""
    lines: list[str] = []
    for name in dict.fromkeys(name for result in results for name in result["meshes"]):
        of = {
            (result["ranks"], result["meshes"][name]["vertices"]): result["meshes"][name]
            for result in results
            if name in result["meshes"]
        }
        alone = sorted(vertices for ranks, vertices in of if ranks == 1)
        if len(alone) > 1:
            low, high = alone[0], alone[-1]
            cost = median_of(of[1, high], "cpu") / median_of(of[1, low], "cpu")
            exponent = math.log(cost) / math.log(high / low)
            lines += ["", f"{name}: cost grows as vertices^{exponent:.2f} from {low} to {high} vertices."]
        for ranks, vertices in sorted(of):
            if ranks > 1 and (1, vertices) in of:
                gain = median_of(of[1, vertices], "seconds") / median_of(of[ranks, vertices], "seconds")
                lines += ["", f"{name}: {ranks} ranks are {gain:.2f} times as fast at {vertices} vertices."]
    return lines


def meshes_table(results: Sequence[Result]) -> list[str]:
    """Kinds of meshes beside the first, by time a vertex, and the slowest of all."""
    rows, slowest, first = [], (0.0, ""), next(iter(results[0]["meshes"]))
    for result in results:
        base = of_vertex(result["meshes"][first])
        for kind, found in result["meshes"].items():
            ratio = of_vertex(found) / base
            slowest = max(slowest, (ratio, f"{kind}, {found['vertices']} vertices"))
            cpu = [step["cpu"] for step in found["steps"]]
            rows.append(
                [
                    str(found["vertices"]),
                    kind,
                    spread(cpu, 1e3),
                    number(1e6 * of_vertex(found)),
                    number(ratio),
                    number(median_of(found, "cg")),
                    found["preset"],
                    number(found["set_up_cpu"]),
                ]
            )
    head = (
        "vertices",
        "mesh",
        "CPU ms a step",
        "µs a vertex",
        f"times {first}",
        "CG iterations",
        "preset",
        "set-up CPU s",
    )
    ratio, where = slowest
    return [*table(head, rows), "", f"Worst: {where}, {number(ratio)} times the time a vertex of {first}."]


def bending_table(results: Sequence[Result]) -> list[str]:
    """Directors on edges over hinges, in time and memory; CG iterations of a step, and their growth."""
    rows: list[list[str]] = []
    least: dict[tuple[str, str, int], float] = {}
    for result in results:
        hinge, midedge = (result["meshes"][model] for model in BENDING_MODELS)
        pairs = list(zip(hinge["steps"], midedge["steps"], strict=True))
        cg = [statistics.mean(step["cg"] for step in found["steps"]) for found in (hinge, midedge)]
        first = least.setdefault((result["mesh"], result["who"], result["ranks"]), cg[1])
        rows.append(
            [
                str(midedge["vertices"]),
                result["mesh"],
                result["who"],
                str(result["ranks"]),
                spread([1e3 * step["cpu"] for step in midedge["steps"]]),
                *(
                    number(statistics.median(two[key] / one[key] for one, two in pairs))
                    for key in ("cpu", "seconds")
                ),
                ", ".join(number(each) for each in cg),
                number(cg[1] / first),
                ", ".join(number(median_of(found, "newton")) for found in (hinge, midedge)),
                number(midedge["peak_bytes"] / hinge["peak_bytes"]),
                f"{hinge['preset']}, {midedge['preset']}",
            ]
        )
    head = (
        "vertices",
        "mesh",
        "who",
        "ranks",
        "CPU ms a step, midedge",
        "CPU, times hinge",
        "wall, times hinge",
        "CG iterations of both",
        "growth",
        "Newton iterations of both",
        "memory, times hinge",
        "presets",
    )
    return table(head, rows)


def against_table(results: Sequence[Result]) -> list[str]:
    """This program over that of another checkout, pair by pair; the median of all rows and the largest."""
    rows, medians = [], []
    for result in results:
        pairs = list(zip(result["here"], result["other"], strict=True))
        cpu = [median_of(here, "cpu") / median_of(other, "cpu") for here, other in pairs]
        medians.append(statistics.median(cpu))
        ratios = [
            [here[key] / other[key] for here, other in pairs] for key in ("peak_bytes", "set_up_seconds")
        ]
        cg = [
            statistics.mean(s["cg"] for run in result[who] for s in run["steps"]) for who in ("here", "other")
        ]
        rows.append(
            [
                str(result["here"][0]["vertices"]),
                result["mesh"],
                result["who"],
                str(result["ranks"]),
                spread(cpu),
                ", ".join(number(each) for each in cg),
                *(number(statistics.median(each)) for each in ratios),
            ]
        )
    head = (
        "vertices",
        "mesh",
        "who",
        "ranks",
        "CPU of a step, times the other's",
        "CG iterations of both",
        "memory",
        "set-up",
    )
    most = f"Median of the rows {number(statistics.median(medians))}, largest {number(max(medians))}."
    return [*table(head, rows), "", most]


def exponent(rows: Sequence[Result], cost: Callable[[Result], float]) -> float:
    """Slope of log cost over log vertices by least squares; NaN with fewer than two sizes."""
    x = np.log([row["vertices"] for row in rows])
    y = np.log([cost(row) for row in rows])
    if len(np.unique(x)) < 2 or not np.isfinite(y).all():
        return math.nan
    return float(np.polyfit(x, y, 1)[0])


def growth(rows: Sequence[Result]) -> Result:
    """Exponents of growth of rows that differ in size alone, from `COUNTS_FROM` vertices on."""
    counted = sorted((r for r in rows if r["vertices"] >= COUNTS_FROM), key=lambda r: r["vertices"])
    costs: dict[str, Callable[[Result], float]] = {
        "step": lambda row: median_of(row, "seconds"),
        "assembly": lambda row: median_of(row, "assembly"),
        "cg_iterations": lambda row: max(median_of(row, "cg"), 1.0),
        "memory": lambda row: max(1.0, sum(row["peak_bytes"])),
    }
    return {
        "vertices": [row["vertices"] for row in counted],
        **{name: exponent(counted, cost) for name, cost in costs.items()},
    }


def growth_words(found: Result) -> list[str]:
    if not math.isfinite(found["step"]):
        return [f"Growth needs two sizes of {COUNTS_FROM} vertices or more: --vertices or --growth."]
    sizes = ", ".join(map(str, found["vertices"]))
    return [
        f"Exponent of growth over {sizes} vertices, first method, one rank: time per step "
        f"{number(found['step'])}, assembly {number(found['assembly'])}, CG iterations "
        f"{number(found['cg_iterations'])}, memory {number(found['memory'])}."
    ]


def weak_table(rows: Sequence[Result]) -> list[str]:
    """Weak scaling: vertices per rank stay the same."""
    base = median_of(rows[0], "seconds")

    def cells(row: Result) -> list[str]:
        return [
            str(row["ranks"]),
            str(row["vertices"]),
            spread(step_seconds(row), 1e3),
            number(base / median_of(row, "seconds")),
            number(median_of(row, "cg")),
            number(max(row["peak_bytes"]) / 2**20),
            number(row["set_up_seconds"]),
        ]

    head = (
        "ranks",
        "vertices",
        "ms a step",
        "efficiency",
        "CG iterations",
        "MiB on the fullest rank",
        "set-up s",
    )
    return table(head, map(cells, rows))


def apart_table(rows: Sequence[Result], apart: Sequence[Result]) -> list[str]:
    """What ranks bring, beside what they could bring if they had nothing to tell each other."""

    def cells(found: Result) -> list[str]:
        same = [
            row for row in rows if row["who"] == METHODS[0] and row["vertices"] == found["whole_vertices"]
        ]
        alone, together = (
            next((median_of(row, "seconds") for row in same if row["ranks"] == ranks), math.nan)
            for ranks in (1, found["ranks"])
        )
        best = statistics.median(found["step_seconds"])
        return [
            str(found["whole_vertices"]),
            str(found["ranks"]),
            *(number(1e3 * seconds) for seconds in (alone, together)),
            number(alone / together),
            f"{found['ranks']} × {found['vertices']}",
            spread(found["step_seconds"], 1e3),
            number(alone / best),
        ]

    head = (
        "vertices",
        "ranks",
        "ms a step, one rank",
        "all ranks",
        "times as fast",
        "sheets apart",
        "ms a step",
        "times as fast, at best",
    )
    return table(head, map(cells, apart))


def presets_table(rows: Sequence[Result]) -> list[str]:
    """CG iterations of one solve, and time, of each preset, cloth and Δt against size."""
    sizes = sorted({row["vertices"] for row in rows})
    cells: dict[tuple[str, str], dict[int, str]] = {}
    for row in rows:
        if "problem" in row:
            shown = row["problem"]
        else:
            solves = [step["cg"] / max(1, step["solves"]) for step in row["steps"]]
            shown = f"{number(statistics.median(solves))}, {number(1e3 * median_of(row, 'seconds'))} ms"
        cells.setdefault((row["preset"], row["problem_class"]), {})[row["vertices"]] = shown
    head = ("preset", "cloth and Δt", *(f"{size} vertices" for size in sizes))
    return table(head, ([*key, *(found.get(size, "–") for size in sizes)] for key, found in cells.items()))


def document(results: Result) -> str:
    """The whole Markdown file."""
    machine = results["machine"]
    lines = [
        f"# Bench of {results['started']}",
        "",
        f"{machine['processor']}, {machine['cores']} cores, load {number(machine['load'])} at the start; "
        + ", ".join(f"{name} {version}" for name, version in results["versions"].items()),
        "",
        "Medians (fastest-slowest). docs/performance.md says what the columns mean.",
        "",
    ]
    if results["rows"]:
        lines += [*main_table(results["rows"]), ""]
    if results.get("meshes"):
        lines += ["## Other meshes, and directors on edges", "", *meshes_table(results["meshes"]), ""]
    if results.get("bending"):
        lines += ["## Directors on edges beside hinges", "", *bending_table(results["bending"]), ""]
    if results.get("against"):
        lines += ["## Beside another checkout", "", *against_table(results["against"]), ""]
    if results.get("contact"):
        lines += ["## Contact", "", *contact_table(results["contact"]), ""]
    if "growth" in results:
        lines += [*growth_words(results["growth"]), ""]
    if results.get("weak"):
        lines += ["## Weak scaling", "", *weak_table(results["weak"]), ""]
    if results.get("apart"):
        lines += ["## What ranks bring", "", *apart_table(results["rows"], results["apart"]), ""]
    if results.get("presets"):
        lines += ["## CG iterations a solve, and time per step", "", *presets_table(results["presets"]), ""]
    single = list(_single_numbers(results))
    if single:
        lines += ["## Single numbers", "", *table(("what", "measured"), single), ""]
    if results["failures"]:
        lines += ["## What failed", "", *(f"- {line}" for line in results["failures"]), ""]
    return "\n".join(lines)


def _single_numbers(results: Result) -> Iterable[tuple[str, str]]:
    if "overhead" in results:
        found = results["overhead"]
        rates = found["steps_a_second"]
        yield f"steps a second, {found['triangles']} triangles ({found['preset']})", spread(rates)
        yield "ms a Newton iteration there", spread([1e3 / rate / found["newton"] for rate in rates])
    if "output" in results:
        found = results["output"]
        ours, plain = found["states_bytes_a_second"], found["plain_bytes_a_second"]
        size = f"{number(found['bytes'] / 1e6)} MB each, {found['ranks']} rank(s)"
        yield f"states, MB/s ({size})", spread(ours, 1e-6)
        yield "plain files of that size, MB/s", spread(plain, 1e-6)
        ratios = [mine / theirs for mine, theirs in zip(ours, plain, strict=True)]
        yield "states over plain files", spread(ratios)
    if "default_scene" in results:
        found = results["default_scene"]
        yield f"{found['what']}, {found['ranks']} rank(s), s", number(found["seconds"])
        yield "share of its output", f"{100 * found['output_share']:.2g} %"
    if "start_up" in results:
        found = results["start_up"]
        yield f"{found['what']}, start to end of the process, s", spread(found["seconds"])
