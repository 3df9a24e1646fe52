"""How the pages about cases end, and how they are written with or without the packages for pictures."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

from lyra_petsc.extras import missing, remedy
from lyra_petsc.output.atomic import replace_text
from lyra_petsc.show.report.document import Report

PLOTS = "plots"
"""Folder of the figures."""

PACKAGES = ("matplotlib", "jinja2")


def lacking() -> list[str]:
    """Packages that pictures and ``report.html`` need and that are not there."""
    return missing(PACKAGES)


def close(
    report: Report, folder: Path, versions: Mapping[str, str], command: Sequence[str], *, pictures: str
) -> str:
    """Add versions and command, and write ``report.md``, where nothing is lacking with all else. On one rank.

    Returns
    -------
    str
        What is missing (``pictures`` is their name) and how to get it; empty if nothing is.
    """
    report.heading("Versions")
    report.table(["package", "version"], [list(pair) for pair in versions.items()])
    report.paragraph("To repeat it:")
    report.code(shlex.join(command))
    packages = lacking()
    if packages:
        replace_text(folder / "report.md", report.markdown())
        return f"no {pictures} and no report.html: {remedy(packages)}"
    (folder / PLOTS).mkdir(exist_ok=True)
    report.write(folder)
    return ""
