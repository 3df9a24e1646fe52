"""Markdown tables of the measurements, and derived numbers."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from cases import BENDING_MODELS, METHODS

from lyra_petsc.show.report.plots import fitted_slope

Result = dict[str, Any]

GROWTH_FROM = 4500
"""Number of vertices from which sizes are used for the exponent of growth."""

PARTS = ("residual", "jacobian", "frozen", "energy", "preconditioner", "solve", "rest")

Row = dict[str, str]
"""Cells of a table row by column."""


def number(value: float, digits: int = 3) -> str:
    """A number with significant digits, without an exponent if it is readable."""
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


def table(rows: Sequence[Row]) -> list[str]:
    """Lines of a Markdown table with the columns of the first row; missing cells are dashes."""
    names = list(rows[0])
    lines = [names, ["---"] * len(names), *([row.get(name, "–") for name in names] for row in rows)]
    return ["| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines]


def median_of(row: Result, name: str) -> float:
    """Median over the steps of a row."""
    return float(statistics.median(step[name] for step in row["steps"]))


def step_seconds(row: Result) -> list[float]:
    """Seconds of each measured step, of this program or a peer."""
    return row["step_seconds"] if "step_seconds" in row else [step["seconds"] for step in row["steps"]]


def main_table(rows: Sequence[Result]) -> list[str]:
    """Table of this program and peers, by size, with ratios to the first method on one rank of that size."""
    first = {}
    for row in rows:
        if row["who"] == METHODS[0]:
            first.setdefault(row["vertices"], row)
    ordered = sorted(rows, key=lambda row: row["vertices"])
    cells = [_main_row(row, first.get(row["vertices"])) for row in ordered]
    # the first row may be a peer's, which has fewer columns
    columns: Row = dict.fromkeys(max(cells, key=len), "–")
    return table([columns | row for row in cells])


def _main_row(row: Result, first: Result | None) -> Row:
    times = step_seconds(row)
    ratio = math.nan
    if first is not None and median_of(first, "seconds") > 0.0:
        ratio = statistics.median(times) / median_of(first, "seconds")
    cpu = statistics.median(row["cpu_seconds"]) if "cpu_seconds" in row else median_of(row, "cpu")
    cells = {
        "vertices": str(row["vertices"]),
        "who": row["who"],
        "ranks": str(row["ranks"]),
        "ms a step": spread(times, 1e3),
        "CPU ms": number(1e3 * cpu),
        "times the first": number(ratio),
    }
    if "step_seconds" in row:
        return cells
    for part in PARTS:
        cells[f"{part.replace('jacobian', 'Jacobian')} ms"] = number(1e3 * median_of(row, part))
    assembly = [step["assembly"] for step in row["steps"]]
    for whose, times in (("", row["matmult_seconds"]), ("PETSc's ", row["petsc_matmult_seconds"])):
        cells[f"{whose}MatMult ms"] = spread(times, 1e3)
        cells[f"assembly, {whose}MatMults"] = spread(
            [seconds / statistics.median(times) for seconds in assembly]
        )
    return cells | {
        "CG iterations": number(median_of(row, "cg")),
        "Newton iterations": number(median_of(row, "newton")),
        "preset": row["preset"],
        "KB a vertex": number(sum(row["peak_bytes"]) / row["vertices"] / 1000),
        "set-up s": number(row["set_up_seconds"]),
    }


def cpu_per_vertex(row: Result) -> float:
    """CPU seconds of a step over the number of vertices."""
    return median_of(row, "cpu") / row["vertices"]


def contact_table(results: Sequence[Result]) -> list[str]:
    """Table of steps in contact, relative to those of swinging sheets listed before; growth and speed-up."""
    rows = []
    for result in results:
        base: Result = {}
        for name, steps in result["meshes"].items():
            base = steps if "swing" in name and "near" not in name else base
            row = {
                "vertices": str(steps["vertices"]),
                "ranks": str(result["ranks"]),
                "sheets": name,
                "CPU ms a step": spread([step["cpu"] for step in steps["steps"]], 1e3),
                "wall ms a step": spread([step["seconds"] for step in steps["steps"]], 1e3),
                "CPU, times those that swing": "",
                "the whole run": "",
                "Newton iterations": number(median_of(steps, "newton")),
                "CG iterations": number(median_of(steps, "cg")),
                "times those that swing": "",
                "preset": steps["preset"],
            }
            if base and base["all_cpu"] > 0.0:
                ratios = [a["cpu"] / b["cpu"] for a, b in zip(steps["steps"], base["steps"], strict=False)]
                row["CPU, times those that swing"] = spread(ratios)
                row["the whole run"] = number(steps["all_cpu"] / base["all_cpu"])
                cg = median_of(steps, "cg") / max(1.0, median_of(base, "cg"))
                row["times those that swing"] = number(cg)
            rows.append(row)
    return [*table(rows), *_growth_of_contact(results)]


def _growth_of_contact(results: Sequence[Result]) -> list[str]:
    """Exponents of the CPU time of a step on one rank, and speed-ups on several ranks."""
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
    """Table of time per vertex on kinds of meshes, relative to the first, and the slowest one."""
    rows, slowest, first = [], (0.0, ""), next(iter(results[0]["meshes"]))
    for result in results:
        base = cpu_per_vertex(result["meshes"][first])
        for kind, steps in result["meshes"].items():
            ratio = cpu_per_vertex(steps) / base
            slowest = max(slowest, (ratio, f"{kind}, {steps['vertices']} vertices"))
            rows.append(
                {
                    "vertices": str(steps["vertices"]),
                    "mesh": kind,
                    "CPU ms a step": spread([step["cpu"] for step in steps["steps"]], 1e3),
                    "µs a vertex": number(1e6 * cpu_per_vertex(steps)),
                    f"times {first}": number(ratio),
                    "CG iterations": number(median_of(steps, "cg")),
                    "preset": steps["preset"],
                    "set-up CPU s": number(steps["set_up_cpu"]),
                }
            )
    ratio, where = slowest
    return [*table(rows), "", f"Worst: {where}, {number(ratio)} times the time a vertex of {first}."]


def bending_table(results: Sequence[Result]) -> list[str]:
    """Table of the midedge model relative to hinges, in time and memory; CG iterations and their growth."""
    rows: list[Row] = []
    least: dict[tuple[str, str, int], float] = {}
    for result in results:
        hinge, midedge = (result["meshes"][model] for model in BENDING_MODELS)
        pairs = list(zip(hinge["steps"], midedge["steps"], strict=True))
        cpu, wall = (
            statistics.median(two[key] / one[key] for one, two in pairs) for key in ("cpu", "seconds")
        )
        cg = [statistics.mean(step["cg"] for step in model["steps"]) for model in (hinge, midedge)]
        first = least.setdefault((result["mesh"], result["who"], result["ranks"]), cg[1])
        newton = [median_of(model, "newton") for model in (hinge, midedge)]
        rows.append(
            {
                "vertices": str(midedge["vertices"]),
                "mesh": result["mesh"],
                "who": result["who"],
                "ranks": str(result["ranks"]),
                "CPU ms a step, midedge": spread([1e3 * step["cpu"] for step in midedge["steps"]]),
                "CPU, times hinge": number(cpu),
                "wall, times hinge": number(wall),
                "CG iterations of both": ", ".join(map(number, cg)),
                "growth": number(cg[1] / first),
                "Newton iterations of both": ", ".join(map(number, newton)),
                "memory, times hinge": number(midedge["peak_bytes"] / hinge["peak_bytes"]),
                "presets": f"{hinge['preset']}, {midedge['preset']}",
            }
        )
    return table(rows)


def against_table(results: Sequence[Result]) -> list[str]:
    """Table of this program relative to another checkout, pair by pair; median of all rows and largest."""
    rows, medians = [], []
    for result in results:
        pairs = list(zip(result["here"], result["other"], strict=True))
        cpu = [median_of(here, "cpu") / median_of(other, "cpu") for here, other in pairs]
        medians.append(statistics.median(cpu))
        memory, set_up = (
            statistics.median(here[key] / other[key] for here, other in pairs)
            for key in ("peak_bytes", "set_up_seconds")
        )
        cg = [
            statistics.mean(s["cg"] for run in result[who] for s in run["steps"]) for who in ("here", "other")
        ]
        rows.append(
            {
                "vertices": str(result["here"][0]["vertices"]),
                "mesh": result["mesh"],
                "who": result["who"],
                "ranks": str(result["ranks"]),
                "CPU of a step, times the other's": spread(cpu),
                "CG iterations of both": ", ".join(map(number, cg)),
                "memory": number(memory),
                "set-up": number(set_up),
            }
        )
    most = f"Median of the rows {number(statistics.median(medians))}, largest {number(max(medians))}."
    return [*table(rows), "", most]


def exponent(rows: Sequence[Result], cost: Callable[[Result], float]) -> float:
    """Slope of log cost over log vertices by least squares; NaN with fewer than two sizes."""
    return fitted_slope([row["vertices"] for row in rows], [cost(row) for row in rows])


def growth(rows: Sequence[Result]) -> Result:
    """Exponents of growth of rows that only differ in size, from `GROWTH_FROM` vertices on."""
    counted = sorted((r for r in rows if r["vertices"] >= GROWTH_FROM), key=lambda r: r["vertices"])
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


def growth_lines(exponents: Result) -> list[str]:
    if not math.isfinite(exponents["step"]):
        return [f"Growth needs two sizes of {GROWTH_FROM} vertices or more: --vertices or --growth."]
    sizes = ", ".join(map(str, exponents["vertices"]))
    return [
        f"Exponent of growth over {sizes} vertices, first method, one rank: time per step "
        f"{number(exponents['step'])}, assembly {number(exponents['assembly'])}, CG iterations "
        f"{number(exponents['cg_iterations'])}, memory {number(exponents['memory'])}."
    ]


def weak_table(rows: Sequence[Result]) -> list[str]:
    """Table of weak scaling, with a constant number of vertices per rank."""
    base = median_of(rows[0], "seconds")
    return table(
        [
            {
                "ranks": str(row["ranks"]),
                "vertices": str(row["vertices"]),
                "ms a step": spread(step_seconds(row), 1e3),
                "efficiency": number(base / median_of(row, "seconds")),
                "CG iterations": number(median_of(row, "cg")),
                "MiB on the fullest rank": number(max(row["peak_bytes"]) / 2**20),
                "set-up s": number(row["set_up_seconds"]),
            }
            for row in rows
        ]
    )


def apart_table(rows: Sequence[Result], apart: Sequence[Result]) -> list[str]:
    """Table of the speed-up on several ranks, and of that of independent sheets, its bound."""

    def cells(sheets: Result) -> Row:
        same = [
            row for row in rows if row["who"] == METHODS[0] and row["vertices"] == sheets["whole_vertices"]
        ]
        alone, together = (
            next((median_of(row, "seconds") for row in same if row["ranks"] == ranks), math.nan)
            for ranks in (1, sheets["ranks"])
        )
        best = statistics.median(sheets["step_seconds"])
        return {
            "vertices": str(sheets["whole_vertices"]),
            "ranks": str(sheets["ranks"]),
            "ms a step, one rank": number(1e3 * alone),
            "all ranks": number(1e3 * together),
            "times as fast": number(alone / together),
            "sheets apart": f"{sheets['ranks']} × {sheets['vertices']}",
            "ms a step": spread(sheets["step_seconds"], 1e3),
            "times as fast, at best": number(alone / best),
        }

    return table([cells(sheets) for sheets in apart])


def presets_table(rows: Sequence[Result]) -> list[str]:
    """Table of CG iterations of one solve, and time, of each preset, cloth and Δt by size."""
    sizes = sorted({row["vertices"] for row in rows})
    lines: dict[tuple[str, str], Row] = {}
    for row in rows:
        if "problem" in row:
            shown = row["problem"]
        else:
            solves = [step["cg"] / max(1, step["solves"]) for step in row["steps"]]
            shown = f"{number(statistics.median(solves))}, {number(1e3 * median_of(row, 'seconds'))} ms"
        key = row["preset"], row["problem_class"]
        empty = dict.fromkeys((f"{size} vertices" for size in sizes), "–")
        line = lines.setdefault(key, {"preset": key[0], "cloth and Δt": key[1], **empty})
        line[f"{row['vertices']} vertices"] = shown
    return table(list(lines.values()))


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
    sections: tuple[tuple[str, str, Callable[[Any], list[str]]], ...] = (
        ("meshes", "## Other meshes, and directors on edges", meshes_table),
        ("bending", "## Directors on edges beside hinges", bending_table),
        ("against", "## Beside another checkout", against_table),
        ("contact", "## Contact", contact_table),
        ("growth", "", growth_lines),
        ("weak", "## Weak scaling", weak_table),
        ("apart", "## What ranks bring", lambda apart: apart_table(results["rows"], apart)),
        ("presets", "## CG iterations a solve, and time per step", presets_table),
    )
    for name, title, words in sections:
        if results.get(name):
            lines += [*([title, ""] if title else []), *words(results[name]), ""]
    single = [{"what": what, "measured": measured} for what, measured in _single_numbers(results)]
    if single:
        lines += ["## Single numbers", "", *table(single), ""]
    if results["failures"]:
        lines += ["## What failed", "", *(f"- {line}" for line in results["failures"]), ""]
    return "\n".join(lines)


def _single_numbers(results: Result) -> Iterable[tuple[str, str]]:
    if "output" in results:
        result = results["output"]
        ours, plain = result["states_bytes_a_second"], result["plain_bytes_a_second"]
        size = f"{number(result['bytes'] / 1e6)} MB each, {result['ranks']} rank(s)"
        yield f"states, MB/s ({size})", spread(ours, 1e-6)
        yield "plain files of that size, MB/s", spread(plain, 1e-6)
        ratios = [mine / theirs for mine, theirs in zip(ours, plain, strict=True)]
        yield "states over plain files", spread(ratios)
    if "default_scene" in results:
        result = results["default_scene"]
        yield f"{result['what']}, {result['ranks']} rank(s), s", number(result["seconds"])
        yield "share of its output", f"{100 * result['output_share']:.2g} %"
    if "start_up" in results:
        result = results["start_up"]
        yield f"{result['what']}, start to end of the process, s", spread(result["seconds"])
