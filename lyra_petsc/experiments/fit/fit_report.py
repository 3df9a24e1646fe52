"""Report of a fit: fit.csv with the numbers, fit.json with all results, and a page."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, asdict, dataclass
from typing import Any

import numpy as np

from lyra_petsc.experiments.case import Case, Outcome, Verdict
from lyra_petsc.experiments.fit.estimate import Estimate
from lyra_petsc.experiments.fit.fit_runner import Fitted
from lyra_petsc.experiments.results import View, align_columns
from lyra_petsc.show.report.document import PLOTS, Drawing, Report, short
from lyra_petsc.show.report.plots import colour, empty_figure, make_drawing, surface


@dataclass
class FitOutcome(Outcome[Case]):
    """The outcome of a fit."""

    _: KW_ONLY
    fitted: Fitted


def outcome_of(fitted: Fitted) -> FitOutcome:
    """The outcome of a fit, which has a single case."""
    passed = fitted.ending.startswith("the search ended")
    case = Case("fit", "numbers from measurements")
    return FitOutcome(case, {"search": Verdict(passed, fitted.ending)}, fitted.seconds, fitted=fitted)


def _interval(estimate: Estimate) -> str:
    if estimate.at_bound:
        return "at its bound"
    low, high = estimate.interval
    return f"{low:.5g} to {high:.5g}"


class FitView(View[FitOutcome]):
    """Report of one fit."""

    verb = "fit"
    columns = ("parameter", "start", "lowest", "highest", "value", "deviation", "from", "to", "at_bound")

    def __init__(self, title: str) -> None:
        self.title, self.ready = title, False  # an interrupted fit is not reported

    def case_ended(self, outcomes: Sequence[FitOutcome]) -> None:
        self.ready = True

    def csv_rows(self, outcome: FitOutcome) -> Iterable[Mapping[str, Any]]:
        for e in outcome.fitted.conclusion.estimates:
            numbers = e.key, e.start, e.low, e.high, e.value, e.deviation, *e.interval, int(e.at_bound)
            yield dict(zip(self.columns, numbers, strict=True))

    def summary_table(self, outcomes: Sequence[FitOutcome]) -> list[Sequence[str]]:
        fitted = outcomes[0].fitted
        rows: list[Sequence[str]] = [("parameter", "start", "found", "95 % interval")]
        for estimate in fitted.conclusion.estimates:
            rows.append((estimate.key, f"{estimate.start:.5g}", f"{estimate.value:.5g}", _interval(estimate)))
        return rows

    def case_content(self, outcome: FitOutcome) -> dict[str, Any]:
        fitted = outcome.fitted
        conclusion = fitted.conclusion

        times = [reading.time for reading in fitted.readings for _ in reading.parts]
        keys = [unknown.key for unknown in fitted.unknowns]
        names = ("name", "time", "measured", "uncertainty", "before", "after", "sensitivity")
        return {
            "parameters": [asdict(estimate) for estimate in conclusion.estimates],
            "misfit": conclusion.misfit,
            "correlation": conclusion.correlation,
            "singular_values": conclusion.singular_values,
            "directions": conclusion.directions,
            "words": conclusion.notes,
            "search": fitted.ending,
            "evaluations": len(fitted.evaluations),
            "simulations": fitted.runs,
            "seconds": fitted.seconds,
            "measurements": [
                dict(zip(names, [*numbers, dict(zip(keys, row, strict=True))], strict=True))
                for *numbers, row in zip(
                    fitted.labels, times, fitted.measured, fitted.uncertainty, fitted.before, fitted.after,
                    fitted.sensitivity, strict=True,
                )
            ],
        }  # fmt: skip

    def fill(self, report: Report, outcomes: Sequence[FitOutcome], summary: str, *, plots: bool) -> None:
        fitted = outcomes[0].fitted
        conclusion = fitted.conclusion
        report.heading("Numbers")
        report.table(
            ["parameter", "start", "found", "deviation", "95 % interval"],
            [
                [e.key, e.start, f"{e.value:.6g}", None if e.at_bound else e.deviation, _interval(e)]
                for e in conclusion.estimates
            ],
            caption="Intervals hold for the uncertainties given, where values depend linearly on parameters.",
        )
        report.bullets([*conclusion.notes, fitted.ending])
        if not math.isnan(conclusion.misfit):
            report.paragraph(
                f"Sum of squares over degrees of freedom: {short(conclusion.misfit)} (1 is expected)."
            )
        report.heading("Before and after")
        if plots:
            report.figure(_residuals(fitted))
            if fitted.triangles is not None:
                for shape, name in zip(fitted.shapes, ("before", "after"), strict=True):
                    if shape is not None:
                        caption = f"The sheet at the last measurement, {name} the fit."
                        report.figure(
                            surface(shape, fitted.triangles, name=f"{PLOTS}/shape-{name}", caption=caption)
                        )
        report.heading("Measurements")
        keys = [unknown.key for unknown in fitted.unknowns]
        times = [reading.time for reading in fitted.readings for _ in reading.parts]
        largest = 60  # rows of the page; fit.json has all
        shown = list(range(len(fitted.labels)))[:largest]
        report.table(
            ["measurement", "time", "measured", "uncertainty", "before", "after", *keys],
            [
                [fitted.labels[i], times[i], f"{fitted.measured[i]:.6g}", float(fitted.uncertainty[i])]
                + [f"{fitted.before[i]:.6g}", f"{fitted.after[i]:.6g}"]
                + [short(float(part)) for part in fitted.sensitivity[i]]
                for i in shown
            ],
            caption="Last columns: by how many uncertainties the value changes with the whole parameter."
            + (f" {largest} of {len(fitted.labels)}; fit.json has all." * (len(shown) < len(times))),
        )
        report.paragraph(
            f"{len(fitted.evaluations)} evaluations, {fitted.runs} simulations, {fitted.seconds:.1f} s."
        )

    def terminal(self, outcome: FitOutcome) -> list[str]:
        """Lines of the terminal at the end."""
        fitted = outcome.fitted
        table = self.summary_table([outcome])
        return [*align_columns(table, len(table[0])), *fitted.conclusion.notes, fitted.ending]


def _residuals(fitted: Fitted) -> Drawing:
    figure = empty_figure(3.2)
    axes = figure.add_subplot(xlabel="measurement", ylabel="misses by [uncertainties]")
    number = np.arange(1, len(fitted.labels) + 1)
    for i, (values, name) in enumerate([(fitted.before, "before"), (fitted.after, "after")]):
        missed = (values - fitted.measured) / fitted.uncertainty
        axes.plot(number, missed, ".", ms=5, color=colour(1 - i), label=name)
    axes.axhspan(-1.96, 1.96, color="#9aa3ad", alpha=0.25, lw=0, label="95 %")
    axes.set_yscale("symlog", linthresh=3.0)
    axes.grid(True, color="#dfe3e8", lw=0.8)
    axes.legend(fontsize=8)
    return make_drawing(
        figure, f"{PLOTS}/residuals", "How far the scene is from each measurement, before and after the fit."
    )
