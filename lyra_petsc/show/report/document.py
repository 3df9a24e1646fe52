"""A report as a list of blocks, written as self-contained HTML and as Markdown; numbers in few digits.

::

    report = Report("Error against run time")
    report.heading("What ran")
    report.paragraph("Twelve combinations, three repeats each.")
    report.table(["integrator", "error"], [["beuler", 0.01]], caption="Errors")
    report.figure(drawing)              # from report.plots
    report.write(Path("studies/flag"))  # report.html, report.md, the figures' PNG and SVG
"""

from __future__ import annotations

import base64
import math
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any

from lyra_petsc.extras import install_hint, missing_packages
from lyra_petsc.output.file_operations import make_folder, replace_bytes, replace_text, writing


def short(value: float, digits: int = 3) -> str:
    """A number with ``digits`` significant digits and no trailing zeros; ``–`` if it is not finite."""
    if not math.isfinite(value):
        return "–"
    if value == 0.0:
        return "0"
    size = abs(value)
    if 1e-3 <= size < 1e5:
        text = f"{value:.{max(0, digits - 1 - math.floor(math.log10(size)))}f}"
        return text.rstrip("0").rstrip(".") if "." in text else text
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa.rstrip('0').rstrip('.')}e{int(exponent)}"


def seconds(value: float, digits: int = 3) -> str:
    """A time with its unit: ``3.1 s``, ``4 ms``, ``25 µs``."""
    if not math.isfinite(value):
        return "–"
    for limit, factor, unit in ((1.0, 1.0, "s"), (1e-3, 1e3, "ms"), (0.0, 1e6, "µs")):
        if abs(value) >= limit * (1.0 - 1e-12) and (value != 0.0 or unit == "µs"):
            return f"{short(value * factor, digits)} {unit}"
    return f"{value:g} s"


def percent(fraction: float) -> str:
    """A fraction in per cent with two significant digits."""
    if not math.isfinite(fraction):
        return "–"
    return f"{float(f'{100.0 * fraction:.2g}'):g} %"


def cell(value: Any) -> str:
    """The text of a table's cell."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return short(value) if isinstance(value, float) else str(value)


_NUMBER = r"-?\d[\d.]*(e[+-]?\d+)?( ?(s|ms|µs|%))?"
NUMBER = re.compile(rf"(|–|[<≤] {_NUMBER}|{_NUMBER}( – {_NUMBER})?)")
"""Right-aligned cells: empty ones, numbers, times and their ranges."""


@dataclass(frozen=True)
class Drawing:
    """A finished figure.

    Attributes
    ----------
    name : str
        File name without ending.
    caption : str
    as_png : callable
        Returns the PNG; not called for a page that contains the SVG.
    svg : bytes
        Empty for a picture that is not a line drawing.
    """

    name: str
    caption: str
    as_png: Callable[[], bytes]
    svg: bytes

    @cached_property
    def png(self) -> bytes:
        return self.as_png()


@dataclass
class ReportBlock:
    """One block of a report; ``kind`` determines the fields that it uses."""

    kind: str
    text: str = ""
    items: list[str] = field(default_factory=list)
    columns: list[str] = field(default_factory=list)
    rows: list[list[str]] = field(default_factory=list)
    numeric: list[bool] = field(default_factory=list)
    marked: list[bool] = field(default_factory=list)
    drawing: Drawing | None = None


class Report:
    """A report: a title and a sequence of blocks.

    Parameters
    ----------
    title : str
    """

    def __init__(self, title: str) -> None:
        self.title = title
        self.blocks: list[ReportBlock] = []

    def heading(self, text: str) -> None:
        """Add the title of a section."""
        self.blocks.append(ReportBlock("heading", text))

    def paragraph(self, text: str) -> None:
        """Add plain text."""
        self.blocks.append(ReportBlock("paragraph", text))

    def bullets(self, items: Sequence[str]) -> None:
        """Add a list of plain sentences, unless it is empty."""
        if items:
            self.blocks.append(ReportBlock("bullets", items=list(items)))

    def code(self, text: str) -> None:
        """Add code, such as a command."""
        self.blocks.append(ReportBlock("code", text))

    def table(
        self,
        columns: Sequence[str],
        rows: Sequence[Sequence[Any]],
        *,
        caption: str = "",
        marked: Sequence[bool] | None = None,
    ) -> None:
        """Add a table; numbers are written with few digits and right-aligned.

        Parameters
        ----------
        columns : sequence of str
        rows : sequence of rows
            Text, numbers, or None for an empty cell.
        caption : str
        marked : sequence of bool, optional
            Rows to be printed in bold.
        """
        texts = [[cell(value) for value in row] for row in rows]
        numeric = [
            any(row[i] for row in texts) and all(NUMBER.fullmatch(row[i]) for row in texts)
            for i in range(len(columns))
        ]
        bold = list(marked) if marked is not None else [False] * len(rows)
        block = ReportBlock("table", caption, columns=list(columns), rows=texts, numeric=numeric, marked=bold)
        self.blocks.append(block)

    def figure(self, drawing: Drawing) -> None:
        """Add a figure with its caption."""
        self.blocks.append(ReportBlock("figure", drawing.caption, drawing=drawing))

    @property
    def drawings(self) -> list[Drawing]:
        """The figures in order."""
        return [block.drawing for block in self.blocks if block.drawing is not None]

    # -- writing ---------------------------------------------------------------------------------------

    def html(self) -> str:
        """The report as one HTML page, which contains its figures and needs no other file."""
        from jinja2 import Environment

        source = files("lyra_petsc.show.report").joinpath("page.html.j2").read_text(encoding="utf-8")
        page = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(source)
        return str(page.render(title=self.title, blocks=self.blocks, inline=_inline))

    def markdown(self) -> str:
        """The report in Markdown, which refers to the figures' PNG files in the same folder."""
        parts = [f"# {self.title}"]
        for block in self.blocks:
            parts.append(_MARKDOWN[block.kind](block))
        return "\n\n".join(parts) + "\n"

    def write(self, folder: Path) -> list[Path]:
        """Write ``report.html``, ``report.md`` and the figures into ``folder``. Call on one rank.

        Returns
        -------
        list of Path
            The files written.

        Raises
        ------
        OutputError
        """
        written = []
        for drawing in self.drawings:
            for ending, content in (("png", drawing.png), ("svg", drawing.svg)):
                path = folder / f"{drawing.name}.{ending}"
                replace_bytes(path, content)
                written.append(path)
        for name, text in (("report.md", self.markdown()), ("report.html", self.html())):
            replace_text(folder / name, text)
            written.append(folder / name)
        return written


def _inline(drawing: Drawing) -> str:
    # as an image, not as SVG elements: the ids of several SVGs in one page would clash
    kind, content = ("svg+xml", drawing.svg) if drawing.svg else ("png", drawing.png)
    return f"data:image/{kind};base64," + base64.b64encode(content).decode("ascii")


def _plain(text: str) -> str:
    """``text`` with the characters escaped that Markdown would interpret as markup."""
    for sign in ("\\", "`", "*", "_", "<", "|"):
        text = text.replace(sign, "\\" + sign)
    return text


def _table_markdown(block: ReportBlock) -> str:
    lines = [f"{_plain(block.text)}\n"] if block.text else []
    lines.append("| " + " | ".join(_plain(name) for name in block.columns) + " |")
    lines.append("|" + "|".join(" ---: " if right else " --- " for right in block.numeric) + "|")
    for row, bold in zip(block.rows, block.marked, strict=True):
        cells = [f"**{_plain(text)}**" if bold and text else _plain(text) for text in row]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _figure_markdown(block: ReportBlock) -> str:
    assert block.drawing is not None
    return f"![{_plain(block.text)}]({block.drawing.name}.png)\n\n{_plain(block.text)}"


_MARKDOWN = {
    "heading": lambda block: f"## {_plain(block.text)}",
    "paragraph": lambda block: _plain(block.text),
    "bullets": lambda block: "\n".join(f"- {_plain(item)}" for item in block.items),
    "code": lambda block: f"```sh\n{block.text}\n```",
    "table": _table_markdown,
    "figure": _figure_markdown,
}


PLOTS = "plots"
"""Folder of the figures."""

PACKAGES = ("matplotlib", "jinja2")


def missing_report_packages() -> list[str]:
    """The packages for pictures and ``report.html`` that are not installed."""
    return missing_packages(PACKAGES)


def write_report(
    report: Report, folder: Path, versions: Mapping[str, str], command: Sequence[str], *, pictures: str
) -> str:
    """Add versions and command, and write ``report.md``; if no package is missing, also HTML and figures.

    Call on one rank.

    Returns
    -------
    str
        A note on ``pictures`` that were not drawn and the missing packages; empty if none is missing.
    """
    report.heading("Versions")
    report.table(["package", "version"], [list(pair) for pair in versions.items()])
    report.paragraph("To repeat it:")
    report.code(shlex.join(command))
    packages = missing_report_packages()
    if packages:
        replace_text(folder / "report.md", report.markdown())
        return f"no {pictures} and no report.html: {install_hint(packages)}"
    with writing(folder / PLOTS):
        make_folder(folder / PLOTS)
    report.write(folder)
    return ""
