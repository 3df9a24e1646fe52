"""Writes docs/reference/fabrics.md: the library's cloths in the tests of ``fabric``.

``python scripts/docs/fabrics.py FOLDER [TEST…]`` (all tests: an hour of one core). FOLDER keeps the outcomes;
tests with an outcome there are not repeated, and the page shows all outcomes.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

from mpi4py import MPI

from lyra_petsc.experiments.case import OUTCOME_FILE, read_record, save_record
from lyra_petsc.experiments.fabric.fabric_report import FabricCase, Record
from lyra_petsc.experiments.fabric.specimens import fabric_of
from lyra_petsc.experiments.fabric.textile_tests import cases_of, run_case
from lyra_petsc.scene.materials.library import measured_names

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "reference" / "fabrics.md"
SHEETS = PAGE.with_suffix("")
MADE = "<!-- made by scripts/docs/fabrics.py; change the program, not this page -->"
CLOTHS = [*measured_names(), "aluminium", "paper"]

SHAPES = ("cantilever", "loop")
CURVES = ("tensile", "shear", "bending", *SHAPES)
"""Tests whose curves are shapes, and all tests with curves."""

COLUMNS = {
    "EMT [%]": ("tensile", "EMT"),
    "LT": ("tensile", "LT"),
    "G [gf/(cm·°)]": ("shear", "G"),
    "c [cm]": ("cantilever", "bending length c"),
    "B [µN·m]": ("cantilever", "B"),
    "B of KES [gf·cm²/cm]": ("bending", "B"),
    "c of a loop [cm]": ("loop", "bending length c, by Peirce's formula"),
    "drape [%]": ("cusick", "drape coefficient"),
    "folds": ("cusick", "folds"),
}
"""Test and quantity of each column."""


def records(folder: Path, cloth: str, test: str) -> list[Record]:
    """Records of a test of a cloth; two if warp and weft are tested separately."""
    found = [read_record(folder / cloth / case.name / OUTCOME_FILE, Record) for case in cases_of(test)]
    return [record for record in found if record is not None]


def measure(folder: Path, cloth: str, case: FabricCase) -> None:
    """Run a test unless it has an outcome."""
    file = folder / cloth / case.name / OUTCOME_FILE
    if read_record(file, Record) is None:
        file.parent.mkdir(parents=True, exist_ok=True)
        save_record(file, run_case(MPI.COMM_SELF, case, fabric_of(cloth), lambda: None).record)
        print(cloth, case.name, flush=True)


def cell(found: list[Record], quantity: str) -> str:
    """Text of a quantity, or of those of warp and weft; – for a missing one."""
    words = []
    for record in found:
        number = next((n for n in record.numbers if n.quantity == quantity), None)
        if number is None:
            words.append("–")
            continue
        scatter = "" if math.isnan(number.scatter) else f" ± {number.scatter:.2g}"
        verdict = record.verdicts.get(quantity)
        off = "" if verdict is None or verdict.passed else " \\*"
        words.append(f"{number.value:.3g}{scatter}{off}")
    return " / ".join(words)


def sheet(folder: Path, cloth: str) -> bool:
    """Draw curves and shadow of a cloth side by side; returns whether there are any."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    found = {test: records(folder, cloth, test) for test in (*CURVES, "cusick")}
    if not any(found.values()):
        return False
    figure = Figure(figsize=(10.0, 2.0), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(found))
    for axes, (test, of_test) in zip(panels, found.items(), strict=True):
        axes.set_title(test, fontsize=8)
        axes.tick_params(labelsize=6)
        for record, style in zip(of_test, ("-", "--"), strict=False):
            if record.shadow:
                axes.axis("off")
                axes.imshow(record.shadow, cmap="Greys", origin="lower", vmin=0, vmax=1.4)
            for curve in record.curves:
                axes.plot(curve.x, curve.y, "k" + style, linewidth=1.0)
                axes.set_xlabel(curve.x_label, fontsize=7)
                axes.set_ylabel(curve.y_label, fontsize=7)
        if test in SHAPES:
            axes.set_aspect("equal", "datalim")
    SHEETS.mkdir(exist_ok=True)
    figure.savefig(SHEETS / f"{cloth}.png", dpi=80, metadata={"Software": None})
    return True


def page(folder: Path) -> None:
    """Write the page."""
    columns = {head: of for head, of in COLUMNS.items() if any(records(folder, c, of[0]) for c in CLOTHS)}
    drape = "drape with the standard deviation of five starts, " if "drape [%]" in columns else ""
    lines = [
        "# Fabrics",
        "",
        MADE,
        "",
        f"The library's cloths in the tests of [`fabric`](../howto/kes.md): warp / weft, {drape}–",
        "where 500 gf/cm are not reached. The law of those that were measured is `measured`; aluminium",
        "and paper were not. On the cells of the drape test, membranes as stiff as these two hinder folds:",
        "aluminium with `stretching_scale: 0.01` gives 88.2 ± 0.95 % and 4 folds.",
        "Numbers that are known and did not come back would have a \\*.",
        "",
        "| cloth | " + " | ".join(columns) + " |",
        "| --- " * (len(columns) + 1) + "|",
    ]
    for cloth in CLOTHS:
        cells = [cell(records(folder, cloth, test), quantity) for test, quantity in columns.values()]
        lines.append(f"| {cloth} | " + " | ".join(cells) + " |")
    lines += ["", "## Sheets", "", "Warp solid, weft dashed; the shadow is that of the last start."]
    for cloth in CLOTHS:
        if sheet(folder, cloth):
            lines += ["", f"### {cloth}", "", f"![Tests of {cloth}]({SHEETS.name}/{cloth}.png)"]
    PAGE.write_text("\n".join([*lines, ""]), encoding="utf-8")


def main() -> None:
    """Run the missing tests, and write the page after each kind of test."""
    folder = Path(sys.argv[1])
    for test in sys.argv[2:] or dict.fromkeys(test for test, _ in COLUMNS.values()):
        for cloth in CLOTHS:
            for case in cases_of(test):
                measure(folder, cloth, case)
        page(folder)


if __name__ == "__main__":
    main()
