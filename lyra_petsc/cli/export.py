"""``export``: states of a run in the formats of other programs."""

from __future__ import annotations

import signal
from pathlib import Path
from types import FrameType
from typing import Any

import click

from lyra_petsc.cli.options import results, verb
from lyra_petsc.cli.signals import watched


@verb("lyra-petsc export runs/flag --to gltf")
@results
@click.option("--to", required=True, metavar="FORMAT", help="obj, ply, gltf, usd, vtkhdf or npz.")
@click.option(
    "--out", type=click.Path(path_type=Path), metavar="DIR", help="Folder of the files (RUN/FORMAT)."
)
@click.option("--times", metavar="T,T,…", help="The states nearest to these times [s].")
@click.option("--every", type=int, metavar="N", help="Every Nth state.")
@click.option(
    "--displacement", is_flag=True, help="Add the displacement from the start, as for Warp By Vector."
)
@click.option("--force", is_flag=True, help="Replace a former export in DIR.")
def export(comm: Any, /, run: Path, **asked: Any) -> None:
    """Write the states of RUN for other programs."""
    from lyra_petsc.parallel import on_root
    from lyra_petsc.show.export.export_run import export_run

    for number in watched():  # rank 0 does the work and prints the message
        signal.signal(number, _give_up if comm.rank == 0 else signal.SIG_IGN)
    done = on_root(comm, lambda: export_run(run, **asked))
    if comm.rank == 0 and done is not None:
        states = f"{done.states} state{'s' if done.states > 1 else ''}"
        files = [name for name in done.files if name != "times.csv"]
        named = files[0] if len(files) == 1 else f"{files[0]} to {files[-1]}"
        click.echo(f"{states} in {done.folder}: {named}")


def _give_up(number: int, frame: FrameType | None) -> None:
    from lyra_petsc.errors import Interrupted

    raise Interrupted(f"stopped by {signal.Signals(number).name}; nothing was written", number)
