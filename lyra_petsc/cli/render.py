"""The verbs ``render``, ``export`` and ``report``: pictures, films, files for other programs, a run's
page."""

from __future__ import annotations

import signal
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import click

from lyra_petsc.cli.options import Session, results, verb
from lyra_petsc.cli.signals import stop_signals

if TYPE_CHECKING:
    from lyra_petsc.show.render.render_plan import FilmTiming


@verb(
    "lyra-petsc render runs/flag --film flag.mp4 --field speed",
    "lyra-petsc render runs/flag --at 0.5,1 --handles --wind",
    start=Session.without_petsc,
)
@results
@click.option("--at", metavar="T,T,…", help="Pictures of the states nearest to these times [s].")
@click.option("--film", type=click.Path(path_type=Path), metavar="FILE", help="A film: .mp4, .webm or .gif.")
@click.option("--sheet", is_flag=True, help="A contact sheet: six states in one picture.")
@click.option("--paraview", is_flag=True, help="A script that opens the run in ParaView; draws nothing.")
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Folder of the pictures (RUN).")
@click.option("--size", metavar="WxH", help="Pixels (1280x720).")
@click.option("--fps", type=float, metavar="N", help="Frames a second (one for each state, 10 to 60).")
@click.option("--speed", type=float, metavar="X", help="Simulated seconds in a second of the film (1).")
@click.option("--field", metavar="NAME", help="Colour by speed, strain, displacement or a written field.")
@click.option("--range", metavar="LOW,HIGH", help="Range of the colours: values, or percentiles as 2%,98%.")
@click.option("--cells", is_flag=True, help="Colour each triangle by its own value, not by means.")
@click.option("--texture", type=click.Path(path_type=Path), metavar="IMAGE", help="A picture on the sheet.")
@click.option("--colors", metavar="FRONT,BACK", help="Of the sheets, as firebrick,ivory or #c8402f,#f0e2c8.")
@click.option("--handles", is_flag=True, help="Show the vertices that are held.")
@click.option("--wind", is_flag=True, help="Show the wind as arrows.")
@click.option("--no-ground", is_flag=True, help="No floor and no shadow on it.")
@click.option("--no-label", is_flag=True, help="No time in the corner.")
@click.option(
    "--set", "settings", multiple=True, metavar="render.KEY=VALUE", help="Change the camera; may be repeated."
)
def render(comm: Any, /, run: Path, no_ground: bool, no_label: bool, **chosen: Any) -> None:
    """Draw pictures and films of RUN; without options a film and a contact sheet."""
    from lyra_petsc.cli.progress import ProgressBar
    from lyra_petsc.cli.signals import StopRequest
    from lyra_petsc.errors import Interrupted
    from lyra_petsc.extras import require_packages
    from lyra_petsc.parallel import on_root
    from lyra_petsc.show.render.opengl import share_cores
    from lyra_petsc.show.render.paraview_script import write_script
    from lyra_petsc.show.render.render_plan import PACKAGES, RenderOptions, make_plan

    asked = {name: value for name, value in chosen.items() if value is not None}
    options = RenderOptions(run, ground=not no_ground, label=not no_label, **asked)
    if options.paraview:
        path = on_root(comm, lambda: write_script(options.run))
        if comm.rank == 0:
            print(f"script   {path}\nopen     paraview --script={path}", flush=True)
        if not (options.at or options.film or options.sheet):
            return
    share_cores(comm)
    on_root(comm, lambda: require_packages("render", PACKAGES, "view"))
    from lyra_petsc.show.render.draw import draw

    plan = on_root(comm, lambda: make_plan(options))
    stop = StopRequest(comm)
    with ProgressBar(comm) as progress:

        def show_progress(done: int, count: int) -> None:
            progress.show(done / count, f"{done} of {count} states drawn")
            if number := stop.signal_number():
                raise Interrupted(f" after {done} of {count} states; a film is not kept in part", number)

        written = draw(comm, plan, show_progress)
    if comm.rank == 0:
        for path in written:
            print(_file_line(path, plan.film), flush=True)


def _file_line(path: Path, film: tuple[Path, FilmTiming] | None) -> str:
    if film is None or path != film[0]:
        return f"{'sheet' if path.stem == 'sheet' else 'picture':<8} {path}"
    timing = film[1]
    count = len(timing.states)
    return f"{'film':<8} {path}  ({count / timing.fps:.3g} s, {count} frames, {timing.fps:g} a second)"


@verb("lyra-petsc export runs/flag --to usd", start=Session.without_petsc)
@results
@click.option("--to", required=True, metavar="FORMAT", help="obj, ply, usd or npz.")
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
    from lyra_petsc.show.export import export_run

    for number in stop_signals():  # rank 0 does the work and prints the message
        signal.signal(number, _interrupt if comm.rank == 0 else signal.SIG_IGN)
    done = on_root(comm, lambda: export_run(run, **asked))
    if comm.rank == 0 and done is not None:
        states = f"{done.states} state{'s' if done.states > 1 else ''}"
        files = [name for name in done.files if name != "times.csv"]
        named = files[0] if len(files) == 1 else f"{files[0]} to {files[-1]}"
        click.echo(f"{states} in {done.folder}: {named}")


def _interrupt(number: int, frame: FrameType | None) -> None:
    from lyra_petsc.errors import Interrupted

    raise Interrupted("; nothing was written", number)


@verb("lyra-petsc report runs/flag", start=Session.without_petsc)
@results
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE", help="The page (RUN/report.html).")
def report(comm: Any, run: Path, out: Path | None) -> None:
    """One HTML page about RUN: pictures, energy, steps, time, settings, notes, what to change."""
    from lyra_petsc.extras import require_packages
    from lyra_petsc.parallel import on_root
    from lyra_petsc.show.report.run_page import write_page

    require_packages("report", ("matplotlib", "jinja2"))
    path = on_root(comm, lambda: write_page(run, out))
    if comm.rank == 0:
        click.echo(f"report       {path}")
