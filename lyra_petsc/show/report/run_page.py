"""The report page on one run, from the files of its folder.

It shows pictures, energies, steps, wall time, settings and notes, and advises how to make the run faster or
more accurate.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError, LyraError
from lyra_petsc.extras import missing_packages
from lyra_petsc.output.file_operations import replace_text
from lyra_petsc.output.layout import FAILURE_TEXT, SCENE_FILE
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.parallel import ALONE
from lyra_petsc.show.render.render_plan import PACKAGES, RenderOptions, make_plan
from lyra_petsc.show.report.document import Drawing, Report, percent, seconds, short
from lyra_petsc.show.report.plots import HEIGHT, colour, empty_figure, make_drawing, surface
from lyra_petsc.show.report.run_facts import ENERGIES, Facts, advice


def energies(facts: Facts) -> Drawing:
    """Energies over time; the potential energy is relative to its start."""
    figure, (axes,) = _axes(facts, ["energy [J]"], 0.75 * HEIGHT)
    for number, (column, name) in enumerate(ENERGIES.items()):
        values = facts.columns[column]
        if column == "potential_energy":
            values, name = values - values[0], "potential, change"
        if values.any():
            _line(axes, facts.columns["time"], values, number, name)
    if axes.lines:
        axes.legend(fontsize=8)
    return make_drawing(figure, "energies", f"Energies over {'load factor' if facts.static else 'time'}")


def balance(facts: Facts) -> Drawing:
    """Energy balance over time: change of energy, work, damping and numerical dissipation."""
    figure, (axes,) = _axes(facts, ["energy [J]"], 0.75 * HEIGHT)
    time = facts.columns["time"]
    _line(axes, time, facts.total_energy - facts.total_energy[0], 0, "change of the total energy")
    _line(axes, time, facts.columns["external_work"], 3, "work of loads and handles")
    _line(axes, time, -facts.columns["dissipation"], 1, "taken by damping")
    _line(axes, time, -facts.scheme_loss, 4, "taken by the time scheme")
    axes.legend(fontsize=8)
    caption = "Energy balance: the first line is the sum of the other three"
    return make_drawing(figure, "balance", caption)


def effort(facts: Facts) -> Drawing:
    """Δt, iterations and wall time of each step."""
    time, newton = facts.steps("time"), facts.steps("newton_iterations")
    panels = {
        "increment" if facts.static else "Δt [s]": facts.steps("dt"),
        "Newton its": newton,
        "linear its": facts.steps("linear_iterations") / np.maximum(newton, 1.0),
        "wall [s]": facts.steps("wall_seconds"),
    }
    figure, axes = _axes(facts, list(panels), 1.5 * HEIGHT)
    for panel, values in zip(axes, panels.values(), strict=True):
        _line(panel, time, values, 0, "")
        panel.set_ylim(bottom=0)
    rejected = facts.steps("rejected") > 0
    if rejected.any():
        at, dt = time[rejected], facts.steps("dt")[rejected]
        axes[0].plot(at, dt, "x", color=colour(1), ms=5, label="after rejected attempts")
        axes[0].legend(fontsize=8)
    caption = "Each step: its length, Newton iterations, linear iterations of a Newton iteration, wall time"
    return make_drawing(figure, "steps", caption)


def phases(wall: Mapping[str, float]) -> Drawing:
    """Wall time by phase as one stacked bar."""
    figure = empty_figure(1.4)
    axes = figure.add_subplot()
    left = 0.0
    for number, (name, value) in enumerate(wall.items()):
        axes.barh(0, value, left=left, color=colour(number), label=name)
        left += value
    axes.set_yticks([])
    axes.set_xlabel("wall time [s]")
    axes.legend(fontsize=8, ncols=len(wall), loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    return make_drawing(figure, "phases", "Wall time by phase")


def _axes(facts: Facts, labels: Sequence[str], height: float) -> tuple[Any, Any]:
    """A figure of stacked panels with a common time axis."""
    figure = empty_figure(height)
    axes = figure.subplots(len(labels), 1, sharex=True, squeeze=False)[:, 0]
    for panel, label in zip(axes, labels, strict=True):
        panel.set_ylabel(label)
        panel.grid(True, color="#dfe3e8", lw=0.8)
        panel.spines[["top", "right"]].set_visible(False)
    axes[-1].set_xlabel("load factor" if facts.static else "time [s]")
    return figure, axes


def _line(axes: Any, x: Array, y: Array, number: int, name: str) -> None:
    axes.plot(x, y, color=colour(number), label=name or None, lw=1.4)


SLOWEST = 5
"""Number of the slowest steps that are listed."""


def run_page(run: StoredRun, pictures: Sequence[Drawing]) -> Report:
    """The page of a run that is running, has ended, failed, or was killed.

    Parameters
    ----------
    run : StoredRun
    pictures : sequence of Drawing
        Pictures of the sheet.
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
    _notes(page, facts)
    _settings(page, facts)
    return page


def chosen_states(run: StoredRun) -> list[int]:
    """Numbers of the states shown on the page: the first, the last, and one half-way in time."""
    half = run.at(0.5 * float(run.times[0] + run.times[-1]))
    return sorted({0, half, len(run) - 1})


def plain_pictures(run: StoredRun) -> list[Drawing]:
    """Pictures of the sheet at a few times, drawn by matplotlib."""
    return [
        surface(run.positions[i], run.triangles, name=f"state-{i}", caption=state_caption(run, i))
        for i in chosen_states(run)
    ]


def state_caption(run: StoredRun, i: int) -> str:
    """Caption of a picture of state ``i``."""
    return f"Load factor {run.times[i]:g}" if run.scene.time.static else f"t = {run.times[i]:g} s"


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
    part = percent(done)
    texts = {
        "done": f"The run came to its end, {now}.",
        "running": f"The run goes on: {now}, {part}. Made again, this page shows more.",
        "killed": f"The run was killed, or its machine went down, after {now}, {part}.",
        "unknown": f"How the run ended is not known (no summary.json); its last step is at {now}.",
        "stopped": f"The run was to stop at {now}, {part}, by -ts_max_steps.",
    }
    return texts.get(facts.run.outcome, f"The run stopped at {now}, {part}: {facts.run.outcome}")


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
    verb = "taken away" if lost >= 0 else "added"
    page.paragraph(
        f"Work of loads and handles {short(work)} J, taken by damping {short(heat)} J, "
        f"{verb} by the time scheme {short(abs(lost))} J{part}."
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
        minimum, median, maximum = (float(f(values)) for f in (np.min, np.median, np.max))
        rows.append([name, minimum, median, maximum, None if column == "residual" else float(values.sum())])
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
    total = max(sum(wall.values()), 1e-12)
    page.table(
        ["phase", "wall time [s]", "share"], [[n, float(v), percent(v / total)] for n, v in wall.items()]
    )
    if facts.summary.get("resumed"):
        page.paragraph("Since the last resumption; the steps before are in the tables above.")


def _notes(page: Report, facts: Facts) -> None:
    page.heading("Warnings and notes")
    notes = list(facts.summary.get("notes", []))
    unused = facts.summary.get("unused_petsc_options", [])
    if unused:
        notes.append("PETSc options that nothing used: " + ", ".join(f"-{name}" for name in unused))
    for resumed in facts.summary.get("resumed", []):
        listed = resumed.get("changes", [])
        changes = "; ".join(f"{c.get('key')}: {c.get('old')} → {c.get('new')}" for c in listed)
        note = f"resumed after step {resumed.get('step')} on {resumed.get('ranks')} ranks"
        notes.append(f"{note}, with {changes}" if changes else note)
    page.bullets(notes)
    if not notes:
        page.paragraph(
            "None."
            if facts.run.outcome not in ("running", "killed")
            else "Written when a run ends by itself."
        )
    text = facts.run.folder / FAILURE_TEXT
    if facts.failed and text.is_file():
        page.paragraph("Why the solver stopped (failure.txt; failure.xdmf shows where):")
        page.code(text.read_text(encoding="utf-8", errors="replace"))


def _settings(page: Report, facts: Facts) -> None:
    page.heading("Settings")
    page.paragraph("The scene as understood, all defaults filled in:")
    page.code((facts.run.folder / SCENE_FILE).read_text(encoding="utf-8", errors="replace"))
    options = facts.summary.get("petsc_options")
    if options:
        page.paragraph("PETSc options in force, ours included:")
        page.code("\n".join(f"-{name} {value or ''}".rstrip() for name, value in sorted(options.items())))
    page.heading("Versions")
    page.table(["package", "version"], [list(pair) for pair in facts.summary.get("versions", {}).items()])


PAGE = "report.html"
PICTURE_SIZE = "960x540"


def write_page(folder: Path, out: Path | None) -> Path:
    """Write the page of a run; returns the file's path. Call on one rank.

    Raises
    ------
    InputError
        If the folder is not one of a run.
    OutputError
        If the page cannot be written.
    """
    run = StoredRun(folder)
    path = folder / PAGE if out is None else out
    if path.is_dir() or not path.absolute().parent.is_dir():
        error = "is a folder; name a file" if path.is_dir() else "cannot be written: there is no such folder"
        raise InputError(error, file=path, key="--out")
    pictures = _rendered(run) or plain_pictures(run)
    replace_text(path, run_page(run, pictures).html())
    return path


def _rendered(run: StoredRun) -> list[Drawing]:
    """Pictures of a few states as ``render`` draws them; empty without its packages or OpenGL."""
    if missing_packages(PACKAGES):
        return []
    from lyra_petsc.show.render.draw import draw

    states = chosen_states(run)
    with tempfile.TemporaryDirectory() as folder:
        times = ",".join(repr(float(run.times[i])) for i in states)
        options = RenderOptions(run.folder, at=times, out=Path(folder), size=PICTURE_SIZE, label=False)
        try:
            plan = make_plan(options)
            draw(ALONE, plan, lambda done, count: None)
            drawn = {state: path.read_bytes() for path, state in plan.pictures}
        except LyraError:  # no OpenGL: the page has plain pictures
            return []
    return [Drawing(f"state-{i}", state_caption(run, i), partial(drawn.__getitem__, i), b"") for i in states]
