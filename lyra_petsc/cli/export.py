"""``export``: states of a run in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lyra_petsc.cli.options import SETTINGS, helped, results


@click.command(context_settings=SETTINGS)
@helped
@results
@click.option("--to", required=True, metavar="FORMAT", help="obj, ply, gltf, usd, npz or vtkhdf.")
@click.option(
    "--out", type=click.Path(path_type=Path), metavar="DIR", help="Folder of the files (RUN/FORMAT)."
)
@click.option("--times", metavar="T,T,…", help="The states nearest to these times [s].")
@click.option("--every", type=int, metavar="N", help="Every Nth state.")
@click.option("--force", is_flag=True, help="Replace a former export in DIR.")
@click.pass_obj
def export(comm: Any, /, run: Path, **asked: Any) -> None:
    """Write the states of RUN for other programs."""
    from lyra_petsc.export.export import export_run
    from lyra_petsc.parallel import on_root

    done = on_root(comm, lambda: export_run(run, **asked))
    if comm.rank == 0 and done is not None:
        states = f"{done.states} state{'s' if done.states > 1 else ''}"
        files = [name for name in done.files if name != "times.csv"]
        named = files[0] if len(files) == 1 else f"{files[0]} to {files[-1]}"
        click.echo(f"{states} in {done.folder}: {named}")
