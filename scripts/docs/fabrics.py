"""Writes docs/reference/fabrics.md: the library's cloths in the tests of ``fabric``.

``python scripts/docs/fabrics.py FOLDER [TEST…]`` (all tests: an hour of one core). FOLDER keeps what came
of each test, which is not run again; the page has what is there.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

from mpi4py import MPI

from lyra_petsc.experiments.fabric.records import FabricCase, Record, restore, save
from lyra_petsc.experiments.fabric.specimens import fabric_of
from lyra_petsc.experiments.fabric.textile_tests import cases_of, run_case
from lyra_petsc.scene.materials.library import measured

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "reference" / "fabrics.md"
PICTURE = "fabrics.png"
MADE = "<!-- made by scripts/docs/fabrics.py; change the program, not this page -->"
CLOTHS = [*measured(), "aluminium", "paper"]

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
"""Heads, and which test and quantity each is of."""


def records(folder: Path, cloth: str, test: str) -> list[Record]:
    """What came of a test of a cloth, of warp and weft where they have one each."""
    found = [restore(folder / cloth / case.name, case) for case in cases_of(test)]
    return [outcome.record for outcome in found if outcome is not None]


def measure(folder: Path, cloth: str, case: FabricCase) -> None:
    """Run a test that has not been run."""
    out = folder / cloth / case.name
    if restore(out, case) is None:
        out.mkdir(parents=True, exist_ok=True)
        save(run_case(MPI.COMM_SELF, case, fabric_of(cloth), lambda: None), out)
        print(cloth, case.name, flush=True)


def cell(found: list[Record], quantity: str) -> str:
    """A number, or those of warp and weft; – without."""
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


def picture(folder: Path) -> bool:
    """All shadows beside each other; whether there are any."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shadows = {cloth: r.shadow for cloth in CLOTHS for r in records(folder, cloth, "cusick") if r.shadow}
    if not shadows:
        return False
    figure = Figure(figsize=(7.2, 1.9 * math.ceil(len(shadows) / 4)), layout="constrained")
    FigureCanvasAgg(figure)
    for number, (cloth, shadow) in enumerate(shadows.items(), 1):
        axes = figure.add_subplot(math.ceil(len(shadows) / 4), 4, number)
        axes.set_title(cloth, fontsize=7)
        axes.axis("off")
        axes.imshow(shadow, cmap="Greys", origin="lower", vmin=0, vmax=1.4)
    figure.savefig(PAGE.with_name(PICTURE), dpi=80, metadata={"Software": None})
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
        "and paper were not. On the drape test's twelve cells along the diameter, membranes as stiff as",
        "these two hinder folds: aluminium with `stretching_scale: 0.01` gives 88.2 ± 0.95 % and 4 folds.",
        "Numbers that are known and did not come back would have a \\*.",
        "",
        "| cloth | " + " | ".join(columns) + " |",
        "| --- " * (len(columns) + 1) + "|",
    ]
    for cloth in CLOTHS:
        cells = [cell(records(folder, cloth, test), quantity) for test, quantity in columns.values()]
        lines.append(f"| {cloth} | " + " | ".join(cells) + " |")
    if picture(folder):
        lines += ["", f"![Shadows of the drape test]({PICTURE})"]
    PAGE.write_text("\n".join([*lines, ""]), encoding="utf-8")


def main() -> None:
    """Run what is missing of the tests, and write the page after each of them."""
    folder = Path(sys.argv[1])
    for test in sys.argv[2:] or dict.fromkeys(test for test, _ in COLUMNS.values()):
        for cloth in CLOTHS:
            for case in cases_of(test):
                measure(folder, cloth, case)
        page(folder)


if __name__ == "__main__":
    main()
