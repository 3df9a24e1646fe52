"""``report``: one page about a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lyra_petsc.cli.options import results, verb


@verb("lyra-petsc report runs/flag")
@results
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE", help="The page (RUN/report.html).")
def report(comm: Any, run: Path, out: Path | None) -> None:
    """One HTML page about RUN: pictures, energy, steps, time, settings, notes, what to change."""
    from lyra_petsc.extras import require
    from lyra_petsc.parallel import on_root
    from lyra_petsc.show.report.run_page import write_page

    require("report", ("matplotlib", "jinja2"))
    path = on_root(comm, lambda: write_page(run, out))
    if comm.rank == 0:
        click.echo(f"report       {path}")
