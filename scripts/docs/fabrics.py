"""Writes docs/reference/fabrics.md: data sheets of the library's cloths by ``fabric all``.

``python scripts/docs/fabrics.py [FOLDER]`` (ten minutes of one core); cloths that FOLDER has are
not run again.
"""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

from lyra_petsc.scene.materials.library import measured

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "reference" / "fabrics.md"
PICTURE = "fabrics.png"
MADE = "<!-- made by scripts/docs/fabrics.py; change the program, not this page -->"

COLUMNS = {
    "EMT [%]": ("tensile", "EMT"),
    "LT": ("tensile", "LT"),
    "G [gf/(cm·°)]": ("shear", "G"),
    "B [gf·cm²/cm]": ("bending", "B"),
    "c [cm]": ("cantilever", "bending length c"),
    "drape [%]": ("cusick", "drape coefficient"),
    "folds": ("cusick", "folds"),
}
"""Heads, and which test and quantity each is of."""


def sheet(cloth: str, folder: Path) -> list[dict[str, str]]:
    """The lines of a cloth's table, run where there is none."""
    out = folder / cloth
    if not (out / "report.md").exists():
        command = [sys.executable, "-m", "lyra_petsc", "fabric", "all", "--cloth", cloth]
        subprocess.run([*command, "--out", str(out), "--force"], check=False, cwd=ROOT)
    with open(out / "fabric.csv", encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def cell(rows: list[dict[str, str]], test: str, quantity: str) -> str:
    """A number, or those of warp and weft."""
    found = [r for r in rows if r["test"].split("-")[0] == test and r["quantity"] == quantity]
    words = []
    for row in found:
        scatter = f" ± {float(row['scatter']):.2g}" if row["scatter"] else ""
        words.append(f"{float(row['value']):.3g}{scatter}")
    return " / ".join(words) or "–"


def picture(folder: Path, cloths: list[str]) -> None:
    """All shadows beside each other."""
    from matplotlib import image
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    for number, cloth in enumerate(cloths, 1):
        axes = figure.add_subplot(3, 4, number)
        axes.set_title(cloth, fontsize=6)
        axes.axis("off")
        path = folder / cloth / "plots" / "cusick-shadow.png"
        if path.exists():
            axes.imshow(image.imread(path))
    figure.savefig(PAGE.with_name(PICTURE), dpi=70, metadata={"Software": None})


def main() -> None:
    """Run what is missing and write the page."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "runs" / "fabrics").absolute()
    cloths = [*measured(), "aluminium", "paper"]
    sheets = {cloth: sheet(cloth, folder) for cloth in cloths}
    lines = [
        "# Fabrics",
        "",
        MADE,
        "",
        "The library's cloths in standard tests (`lyra-petsc fabric all --cloth NAME`): warp / weft, drape "
        "with the standard deviation of five starts, – where 500 gf/cm are not reached. The law of those that "
        "were measured is `measured`; aluminium and paper were not. [How](../howto/kes.md).",
        "",
        "| cloth | " + " | ".join(COLUMNS) + " |",
        "| --- " * (len(COLUMNS) + 1) + "|",
    ]
    for cloth, rows in sheets.items():
        lines.append(f"| {cloth} | " + " | ".join(cell(rows, *of) for of in COLUMNS.values()) + " |")
    lines += ["", f"![Shadows of the drape test]({PICTURE})", ""]
    PAGE.write_text("\n".join(lines), encoding="utf-8")
    picture(folder, cloths)


if __name__ == "__main__":
    main()
