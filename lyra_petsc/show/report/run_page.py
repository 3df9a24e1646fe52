"""The page about one run: pictures, energy, steps, time, settings, notes, what to change."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lyra_petsc.output.read_run import Run
from lyra_petsc.show.report.document import Drawing, Report
from lyra_petsc.show.report.numbers import percent, seconds, short
from lyra_petsc.show.report.run_advice import advice
from lyra_petsc.show.report.run_facts import ENERGIES, Facts
from lyra_petsc.show.report.run_figures import balance, effort, energies, phases
from lyra_petsc.show.report.shapes import surface

SLOWEST = 5
"""Steps that are listed."""

PICTURES = 3


def run_page(run: Run, pictures: Sequence[Drawing]) -> Report:
    """The page of a run that goes on, has ended, failed, or was killed.

    Parameters
    ----------
    run : Run
    pictures : sequence of Drawing
        Of the sheet.
    """
    facts = Facts.of(run)
    page = Report(run.scene.title or run.name)
    _overview(page, facts)
    hints = advice(facts)
    page.heading("What to change")
    page.bullets(hints)
    if not hints:
        page.paragraph("Nothing stands out: few iterations, no needless steps, little time in output.")
    page.heading("Pictures")
    for drawing in pictures:
        page.figure(drawing)
    _energy(page, facts)
    _steps(page, facts)
    _wall_time(page, facts)
    _words(page, facts)
    _settings(page, facts)
    return page


def chosen_states(run: Run) -> list[int]:
    """Numbers of the states that are shown: the first, the last, and one half-way in time."""
    half = run.at(0.5 * float(run.times[0] + run.times[-1]))
    return sorted({0, half, len(run) - 1})


def plain_pictures(run: Run) -> list[Drawing]:
    """The sheet at a few times, drawn by matplotlib."""
    return [
        surface(run.positions[i], run.triangles, name=f"state-{i}", caption=state_caption(run, i))
        for i in chosen_states(run)
    ]


def state_caption(run: Run, i: int) -> str:
    """What a picture of state ``i`` shows."""
    static = run.scene.time.analysis == "static"
    return f"Load factor {run.times[i]:g}" if static else f"t = {run.times[i]:g} s"


def _overview(page: Report, facts: Facts) -> None:
    run, summary = facts.run, facts.summary
    scene = run.scene
    done = float(facts.columns["time"][-1]) / scene.time.end
    page.paragraph(_outcome(facts, done))
    rows: list[list[Any]] = [
        ["folder", str(run.folder.absolute())],
        ["mesh", f"{len(run.rest)} vertices, {len(run.triangles)} triangles"],
        ["terms", ", ".join(summary.get("terms", []))],
        ["integrator", scene.time.scheme],
        ["linear solver", summary.get("linear_solver", "")],
        ["ranks", str(summary.get("ranks", ""))],
        ["steps", f"{facts.n_steps} accepted, {facts.rejected} attempts rejected; {len(run)} states written"],
        ["wall time of the steps", seconds(facts.step_seconds)],
    ]
    if facts.n_steps:
        rows.append(["a step", f"{seconds(facts.step_seconds / facts.n_steps)} on average"])
    page.table(["", ""], rows)


def _outcome(facts: Facts, done: float) -> str:
    now = f"t = {facts.columns['time'][-1]:g} of {facts.run.scene.time.end:g} s"
    if facts.static:
        now = f"load factor {facts.columns['time'][-1]:g}"
    if facts.outcome == "done":
        return f"The run came to its end, {now}."
    if facts.outcome == "running":
        return f"The run goes on: {now}, {percent(done)}. Made again, this page shows more."
    if facts.outcome == "killed":
        return f"The run was killed, or its machine went down, after {now}, {percent(done)}."
    if facts.outcome == "unknown":
        return f"How the run ended is not known (no summary.json); its last step is at {now}."
    if facts.outcome == "stopped":
        return f"The run was to stop at {now}, {percent(done)}, by -ts_max_steps."
    return f"The run stopped at {now}, {percent(done)}: {facts.outcome}"


def _energy(page: Report, facts: Facts) -> None:
    page.heading("Energy")
    if facts.n_steps == 0:
        page.paragraph("No step was accepted.")
        return
    page.figure(energies(facts))
    page.figure(balance(facts))
    rows = [
        [name, float(facts.columns[column][0]), float(facts.columns[column][-1])]
        for column, name in ENERGIES.items()
    ]
    rows.append(["total", float(facts.total_energy[0]), float(facts.total_energy[-1])])
    page.table(["energy [J]", "at the start", "at the end"], rows)
    work, heat = (float(facts.columns[name][-1]) for name in ("external_work", "dissipation"))
    lost = float(facts.scheme_loss[-1])
    part = f", {percent(lost / facts.turnover)} of the largest change of an energy" if facts.turnover else ""
    words = "taken away" if lost >= 0 else "added"
    page.paragraph(
        f"Work of loads and handles {short(work)} J, taken by damping {short(heat)} J, "
        f"{words} by the time scheme {short(abs(lost))} J{part}."
    )


def _steps(page: Report, facts: Facts) -> None:
    if facts.n_steps == 0:
        return
    page.heading("Steps and iterations")
    page.figure(effort(facts))
    rows: list[list[Any]] = []
    names = {
        "dt": "increment of the load factor" if facts.static else "Δt [s]",
        "newton_iterations": "Newton iterations",
        "linear_iterations": "linear iterations",
        "rejected": "rejected attempts",
        "residual": "residual [N]",
        "wall_seconds": "wall time [s]",
    }
    for column, name in names.items():
        values = facts.steps(column)
        least, usual, most = (float(f(values)) for f in (np.min, np.median, np.max))
        rows.append([name, least, usual, most, None if column == "residual" else float(values.sum())])
    page.table(["of a step", "least", "median", "most", "in all"], rows)
    slow = np.argsort(-facts.steps("wall_seconds"), kind="stable")[:SLOWEST]
    listed: dict[str, tuple[str, type]] = {
        "step": ("step", int), "time": ("load factor" if facts.static else "time [s]", float),
        "dt": ("Δt", float), "newton_iterations": ("Newton", int), "linear_iterations": ("linear", int),
        "rejected": ("rejected", int), "wall_seconds": ("wall [s]", float),
    }  # fmt: skip
    rows = [[kind(facts.steps(column)[i]) for column, (_, kind) in listed.items()] for i in slow]
    page.table([title for title, _ in listed.values()], rows, caption="The slowest steps")


def _wall_time(page: Report, facts: Facts) -> None:
    page.heading("Wall time")
    wall = facts.phases
    if not wall:
        page.paragraph(
            f"The steps took {seconds(facts.step_seconds)}. The time by phase is written when a run ends."
        )
        return
    page.figure(phases(wall))
    page.table(
        ["phase", "wall time [s]", "share"], [[n, float(v), percent(facts.share(n))] for n, v in wall.items()]
    )
    if facts.summary.get("resumed"):
        page.paragraph("Since the last resumption; the steps before are in the tables above.")


def _words(page: Report, facts: Facts) -> None:
    page.heading("Warnings and notes")
    notes = list(facts.summary.get("notes", []))
    unused = facts.summary.get("unused_petsc_options", [])
    if unused:
        notes.append("PETSc options that nothing used: " + ", ".join(f"-{name}" for name in unused))
    for resumed in facts.summary.get("resumed", []):
        listed = resumed.get("changes", [])
        changes = "; ".join(f"{c.get('key')}: {c.get('old')} → {c.get('new')}" for c in listed)
        words = f"resumed after step {resumed.get('step')} on {resumed.get('ranks')} ranks"
        notes.append(f"{words}, with {changes}" if changes else words)
    page.bullets(notes)
    if not notes:
        page.paragraph(
            "None." if facts.outcome not in ("running", "killed") else "Written when a run ends by itself."
        )
    text = facts.run.folder / "failure.txt"
    if facts.failed and text.is_file():
        page.paragraph("Why the solver stopped (failure.txt; failure.xdmf shows where):")
        page.code(text.read_text(encoding="utf-8", errors="replace"))


def _settings(page: Report, facts: Facts) -> None:
    page.heading("Settings")
    page.paragraph("The scene as understood, all defaults filled in:")
    page.code((facts.run.folder / "scene.yaml").read_text(encoding="utf-8", errors="replace"))
    options = facts.summary.get("petsc_options")
    if options:
        page.paragraph("PETSc options in force, ours included:")
        page.code("\n".join(f"-{name} {value or ''}".rstrip() for name, value in sorted(options.items())))
    page.heading("Versions")
    page.table(["package", "version"], [list(pair) for pair in facts.summary.get("versions", {}).items()])
