"""Reports: content, self-contained files, figures."""

from __future__ import annotations

import builtins
import importlib.util
import math
import re
from pathlib import Path

import pytest

from lyra_petsc import extras
from lyra_petsc.errors import InputError
from lyra_petsc.show.report.document import Report, percent, seconds, short
from lyra_petsc.show.report.plots import Series, convergence, fitted_slope, work_precision

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

STEPS = [0.02, 0.01, 0.005]


def small_report() -> Report:
    report = Report("Error <against> run time")
    report.heading("What ran")
    report.paragraph("a_1 & b < c")
    report.bullets(["one", "two"])
    report.code("mpirun -n 2 python -m lyra_petsc study 'my scene.yaml'")
    report.table(["name", "error"], [["x|y", 0.0123456], ["z", None]], caption="Errors", marked=[True, False])
    line = Series("beuler", STEPS, [0.04, 0.02, 0.01], labels=["20 ms", "10 ms", "5 ms"])
    report.figure(
        convergence([line], name="steps", caption="Error against Δt", x_label="Δt [s]", y_label="error")
    )
    report.figure(
        work_precision(
            [line],
            name="work",
            caption="Error against run time",
            y_label="error",
            front=[(0.02, 0.04)],
            recommended=(0.01, 0.02),
            recommendation="beuler, Δt 10 ms",
        )
    )
    return report


def test_the_html_is_complete_and_fetches_nothing(tmp_path: Path) -> None:
    written = small_report().write(tmp_path)
    assert {path.name for path in written} == {
        "report.html", "report.md", "steps.png", "steps.svg", "work.png", "work.svg"
    }  # fmt: skip
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert not re.search(r"https?://|//[a-z]|<script|<link|url\(", page)
    assert page.count("data:image/svg+xml;base64,") == 2
    assert "Error &lt;against&gt; run time" in page
    assert "a_1 &amp; b &lt; c" in page
    assert '<td class="right">0.0123</td>' in page
    assert "my scene.yaml" in page


def test_pages_with_line_drawings_have_no_bitmaps() -> None:
    report = small_report()
    report.html()
    assert not any("png" in vars(drawing) for drawing in report.drawings)


def test_the_markdown_has_the_same_content(tmp_path: Path) -> None:
    small_report().write(tmp_path)
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "| **x\\|y** | **0.0123** |" in text
    assert "![Error against Δt](steps.png)" in text
    assert (tmp_path / "steps.png").read_bytes().startswith(b"\x89PNG")


def test_figures_show_slope_front_and_recommendation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import matplotlib

    monkeypatch.setitem(matplotlib.rcParams, "svg.fonttype", "none")  # text stays text
    drawings = {drawing.name: drawing.svg.decode() for drawing in small_report().drawings}
    assert "beuler: slope 1.00" in drawings["steps"]
    assert "recommended: beuler, Δt 10 ms" in drawings["work"]
    assert "Pareto front" in drawings["work"]
    assert "10 ms" in drawings["work"]


def test_the_same_data_give_the_same_figures() -> None:
    one, two = small_report().drawings, small_report().drawings
    assert [drawing.svg for drawing in one] == [drawing.svg for drawing in two]


def test_a_long_legend_is_below_the_axes() -> None:
    """Within them, it would cover the lines and leave no room for them."""
    lines = [Series(f"mesh {n}", [0.1, 0.05], [1e-2 + n, 1e-3]) for n in range(60)]
    heights = []
    for shown in (lines[:3], lines):
        drawing = convergence(shown, name="h", caption="Error", x_label="h", y_label="error")
        heights.append(float(re.search(r'height="([0-9.]+)pt"', drawing.svg.decode())[1]))  # type: ignore[index]
    assert heights[1] > 1.5 * heights[0]


def test_slopes_of_fits() -> None:
    assert fitted_slope(STEPS, [3.0 * step**2 for step in STEPS]) == pytest.approx(2.0)
    assert math.isnan(fitted_slope([0.1], [1.0]))
    assert math.isnan(fitted_slope([0.1, 0.1], [1.0, 2.0]))
    assert fitted_slope([0.1, 0.2, 0.4], [0.1, math.nan, 0.4]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (3.123, "3.12 s"),
        (0.004, "4 ms"),
        (0.0125, "12.5 ms"),
        (2.5e-5, "25 µs"),
        (100.0, "100 s"),
        (1.0, "1 s"),
    ],
)
def test_times_as_text(value: float, text: str) -> None:
    assert seconds(value) == text


def test_numbers_as_text() -> None:
    assert [short(v) for v in (0.0, 100.0, 0.0123456, 1.5e-5, 2e6, math.nan)] == [
        "0", "100", "0.0123", "1.5e-5", "2e6", "–"
    ]  # fmt: skip
    assert [percent(v) for v in (0.1, 0.01234, 0.0001)] == ["10 %", "1.2 %", "0.01 %"]


def test_a_missing_package_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    real = importlib.util.find_spec
    monkeypatch.setattr(
        extras.importlib.util, "find_spec", lambda name: None if name == "jinja2" else real(name)
    )
    with pytest.raises(InputError, match=r"^study: jinja2 is not installed; .*lyra-petsc\[study\]"):
        extras.require_packages("study")


def test_numbers_and_tables_need_no_extra_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def refuse(name: str, *rest: object, **more: object) -> object:
        if name.split(".")[0] in extras.PACKAGES:
            raise ImportError(name)
        return real(name, *rest, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(builtins, "__import__", refuse)
    report = Report("t")
    report.table(["a"], [[1.0]])
    assert "| 1 |" in report.markdown()
