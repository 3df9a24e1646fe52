"""``report``: one page about a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lyra_petsc.cli.options import SETTINGS, helped, results

PAGE = "report.html"


@click.command(context_settings=SETTINGS)
@helped
@results
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE", help="The page (RUN/report.html).")
@click.pass_obj
def report(comm: Any, run: Path, out: Path | None) -> None:
    """One HTML page about RUN: pictures, energy, steps, time, settings, notes, what to change."""
    from lyra_petsc.parallel import on_root
    from lyra_petsc.extras import require

    require("report", ("matplotlib", "jinja2"))
    path = on_root(comm, lambda: write_page(run, out))
    if comm.rank == 0:
        click.echo(f"report       {path}")


def write_page(folder: Path, out: Path | None) -> Path:
    """Write the page of a run; the file's path. On one rank.

    Raises
    ------
    InputError
        If the folder is none of a run.
    OutputError
        If the page cannot be written.
    """
    from lyra_petsc.errors import InputError
    from lyra_petsc.output.atomic import replace_text
    from lyra_petsc.report.run_page import run_page
    from lyra_petsc.results.run import Run

    path = folder / PAGE if out is None else out
    if path.is_dir() or not path.absolute().parent.is_dir():
        what = "is a folder; name a file" if path.is_dir() else "cannot be written: there is no such folder"
        raise InputError(what, file=path, key="--out")
    replace_text(path, run_page(Run(folder)).html())
    return path
