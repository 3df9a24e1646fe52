"""Results of textile tests: numbers in the units of the tests, curves, a shadow; and their report."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lyra_petsc.experiments.case import Case, Outcome, StoredArray, Verdict
from lyra_petsc.experiments.results import Line, View, verdict_line, write_csv
from lyra_petsc.show.report.document import PLOTS, Drawing, Report, seconds, short
from lyra_petsc.show.report.plots import HEIGHT, colour, empty_figure, make_drawing, surface


@dataclass(frozen=True)
class FabricNumber:
    """A result; ``scatter`` is the standard deviation over several starts, NaN for a single one."""

    quantity: str
    value: float
    unit: str
    scatter: float = math.nan


@dataclass(frozen=True)
class Curve:
    """A measured curve."""

    name: str
    x_label: str
    y_label: str
    x: list[float]
    y: list[float]


@dataclass
class Record:
    """The results of a test.

    Attributes
    ----------
    numbers : list of FabricNumber
    curves : list of Curve
    shadow : list of list of int
        Pixels of the shadow of a drape, 1 for dark, bottom row first; empty for other tests.
    extent : float
        Half the side of the shadow [cm].
    drape, triangles : (V, 3), (F, 3) or None
        Positions [m] of a draped cloth, and its triangles.
    stopped : str
        Why the test was not completed; empty if it was.
    verdicts : dict of name → Verdict
        Comparison of numbers with constants of the material.
    seconds : float
        Wall time [s].
    """

    numbers: list[FabricNumber] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)
    shadow: list[list[int]] = field(default_factory=list)
    extent: float = 0.0
    drape: StoredArray | None = None
    triangles: StoredArray | None = None
    stopped: str = ""
    verdicts: dict[str, Verdict] = field(default_factory=dict)
    seconds: float = 0.0

    def claim(self, name: str, value: float, exact: float, bound: float) -> None:
        """Add the verdict on a number whose exact value is known, by its relative error."""
        error = abs(value - exact) / abs(exact)
        message = f"{short(value, 4)}, material {short(exact, 4)}: {100.0 * error:.2g} % off"
        self.verdicts[name] = Verdict(error <= bound, f"{message}, {100.0 * bound:g} % allowed")


@dataclass(frozen=True)
class FabricCase(Case):
    """A test of a material along one direction.

    Attributes
    ----------
    test : str
    degrees : float
        Angle of the length of the specimen to the warp.
    """

    test: str
    degrees: float


@dataclass
class FabricOutcome(Outcome[FabricCase]):
    """The result of a case."""

    record: Record = field(default_factory=Record)

    @property
    def status(self) -> str:
        """``measured`` if nothing was compared, else ``passed`` or ``FAILED``."""
        return super().status if self.verdicts else "measured"


def outcome_of(case: FabricCase, record: Record) -> FabricOutcome:
    """The outcome of a case with this record."""
    stopped = {"measured to its end": Verdict(False, record.stopped)} if record.stopped else {}
    verdicts = stopped | record.verdicts
    return FabricOutcome(case, verdicts, record.seconds, record=record)


def _value(number: FabricNumber) -> str:
    spread = "" if math.isnan(number.scatter) else f" ± {short(number.scatter, 2)}"
    return f"{short(number.value, 4)}{spread}"


class FabricView(View[FabricOutcome]):
    """Numbers by test and direction.

    Parameters
    ----------
    material : str
        Name for the title.
    """

    verb = "fabric"
    entry = "test"
    columns = ("test", "quantity", "value", "scatter", "unit", "status", "problem")

    def __init__(self, material: str) -> None:
        self.title = f"Textile tests: {material}"
        self._outcomes: Sequence[FabricOutcome] = ()

    def terminal_lines(self, outcome: FabricOutcome) -> Iterable[Line]:
        yield f"{outcome.case.name}: {outcome.case.title}", "bold"
        if outcome.left_out:
            yield f"  left out: {outcome.left_out}", "dim"
        for number in outcome.record.numbers:
            yield f"  {number.quantity} = {_value(number)} {number.unit}", ""
        for name, verdict in outcome.verdicts.items():
            yield verdict_line(verdict, f"{name}: ")

    def csv_rows(self, outcome: FabricOutcome) -> Iterable[Mapping[str, Any]]:
        common = {"test": outcome.case.name, "status": outcome.status, "problem": outcome.record.stopped}
        for number in outcome.record.numbers:
            yield common | vars(number)
        if not outcome.record.numbers:
            yield common

    def case_content(self, outcome: FabricOutcome) -> dict[str, Any]:
        return {
            "numbers": [vars(number) for number in outcome.record.numbers],
            "status": outcome.status,
            "wall_seconds": outcome.seconds,
        }

    def fill(self, report: Report, outcomes: Sequence[FabricOutcome], summary: str, *, plots: bool) -> None:
        self._outcomes = outcomes
        report.paragraph(
            f"{summary} Specimens bend by directors on edges (bending_model: midedge) whatever the scene "
            "says, since hinges bend as their mesh is."
        )
        rows = [
            [outcome.case.name, number.quantity, _value(number), number.unit]
            for outcome in outcomes
            for number in outcome.record.numbers
        ]
        report.table(["test", "quantity", "value", "unit"], rows)
        for outcome in outcomes:
            report.heading(outcome.case.name)
            ended = f"Left out: {outcome.left_out}." if outcome.left_out else ""
            ended = ended or f"{outcome.status.capitalize()}. Run time {seconds(outcome.seconds)}."
            report.paragraph(f"{outcome.case.title}. {ended}")
            for name, verdict in outcome.verdicts.items():
                report.paragraph(f"{name}: {verdict.line}.")
            if plots:
                for drawing in pictures(outcome):
                    report.figure(drawing)

    def close_page(self, report: Report, folder: Path, command: Sequence[str]) -> str:
        for outcome in self._outcomes:
            curves = outcome.record.curves
            for number, curve in enumerate(curves, 1):
                name = outcome.case.name + (f"-{number}" if len(curves) > 1 else "")
                lines = [(curve.x_label, curve.y_label), *zip(curve.x, curve.y, strict=True)]
                write_csv(folder / f"{name}.csv", lines)
        return super().close_page(report, folder, command)


def pictures(outcome: FabricOutcome) -> list[Drawing]:
    """Figures of the curves, the drape and the shadow of a test."""
    record, name, drawings = outcome.record, outcome.case.name, []
    if record.curves:
        figure = empty_figure(0.8 * HEIGHT)
        axes = figure.add_subplot(xlabel=record.curves[0].x_label, ylabel=record.curves[0].y_label)
        for number, curve in enumerate(record.curves):
            axes.plot(curve.x, curve.y, color=colour(number), label=curve.name, lw=1.4, marker=".", ms=3)
        axes.grid(True, color="#dfe3e8", lw=0.8)
        if all(label.endswith("[cm]") for label in (record.curves[0].x_label, record.curves[0].y_label)):
            axes.set_aspect("equal", adjustable="datalim")  # a shape, not a diagram
        if len(record.curves) > 1:
            axes.legend(fontsize=8)
        drawings.append(make_drawing(figure, f"{PLOTS}/{name}", outcome.case.title))
    if record.drape is not None and record.triangles is not None:
        caption = "The first start"
        drawings.append(
            surface(record.drape, record.triangles, name=f"{PLOTS}/{name}-drape", caption=caption)
        )
    if record.shadow:
        figure = empty_figure(HEIGHT)
        axes = figure.add_subplot(xlabel="x [cm]", ylabel="y [cm]")
        half = record.extent
        axes.imshow(
            record.shadow, cmap="Greys", origin="lower", extent=(-half, half, -half, half),
            interpolation="nearest", vmin=0, vmax=1.4,
        )  # fmt: skip
        drawings.append(
            make_drawing(figure, f"{PLOTS}/{name}-shadow", f"{name}: the shadow of the last start")
        )
    return drawings
