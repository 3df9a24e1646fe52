"""``render``: pictures and films of a run."""

from __future__ import annotations

import math
import signal
import sys
import time as wall
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TextIO

import click

from lyra_petsc.cli.options import SETTINGS, helped, results

if TYPE_CHECKING:
    from mpi4py import MPI
    from rich.progress import Progress as Bar

    from lyra_petsc.render.plan import Asked

PACKAGES = ("pyvista", "vtkmodules", "PIL", "imageio_ffmpeg")
"""What pictures need of the extra ``view``."""


@click.command(context_settings=SETTINGS)
@helped
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
@click.option("--range", metavar="LOW,HIGH", help="Of the colours.")
@click.option("--texture", type=click.Path(path_type=Path), metavar="IMAGE", help="A picture on the sheet.")
@click.option("--colors", metavar="FRONT,BACK", help="Of the sheet, as firebrick,ivory or #c8402f,#f0e2c8.")
@click.option("--handles", is_flag=True, help="Show the vertices that are held.")
@click.option("--wind", is_flag=True, help="Show the wind as arrows.")
@click.option("--no-ground", is_flag=True, help="No floor and no shadow on it.")
@click.option("--no-label", is_flag=True, help="No time in the corner.")
@click.option(
    "--set", "settings", multiple=True, metavar="render.KEY=VALUE", help="Change the camera; may be repeated."
)
@click.pass_obj
def render(comm: Any, /, run: Path, no_ground: bool, no_label: bool, **options: Any) -> None:
    """Draw pictures and films of RUN; without options a film and a contact sheet."""
    from lyra_petsc.render.plan import Asked

    said = {name: value for name, value in options.items() if value is not None}
    render_run(comm, Asked(run, ground=not no_ground, label=not no_label, **said))


def render_run(comm: MPI.Comm, asked: Asked) -> None:
    """Draw what was asked for; collective.

    Raises
    ------
    InputError
        Bad input, a package or a library that is missing; no picture is written.
    OutputError
        If a picture cannot be written.
    Interrupted
        A signal; a film is not there.
    """
    from lyra_petsc.cli.signals import StopRequest
    from lyra_petsc.errors import Interrupted
    from lyra_petsc.parallel import on_root
    from lyra_petsc.render.opengl import share_cores
    from lyra_petsc.render.paraview import write_script

    if asked.paraview:
        path = on_root(comm, lambda: write_script(asked.run))
        if comm.rank == 0:
            print(f"script   {path}\nopen     paraview --script={path}", flush=True)
        if not (asked.at or asked.film or asked.sheet):
            return
    share_cores(comm)
    plan = on_root(comm, lambda: _plan(asked))
    assert plan is not None
    stop = StopRequest(comm)
    with FrameProgress(comm) as progress:

        def tell(done: int, count: int) -> None:
            progress.update(done, count)
            number = stop.signal_number()
            if number:
                raise Interrupted(
                    f"stopped by {signal.Signals(number).name} after {done} of {count} states; a film is not "
                    "kept in part",
                    number,
                )

        from lyra_petsc.render.draw import draw

        written = draw(comm, asked, plan, tell)
    if comm.rank == 0:
        for path in written:
            print(_told(path, plan.film), flush=True)


def _plan(asked: Asked) -> Any:
    from lyra_petsc.extras import require

    require("render", PACKAGES, "view")
    from lyra_petsc.render.plan import make_plan

    return make_plan(asked)


def _told(path: Path, film: Any) -> str:
    if film is None or path != film[0]:
        return f"{'sheet' if path.stem == 'sheet' else 'picture':<8} {path}"
    timing = film[1]
    count = len(timing.states)
    return f"{'film':<8} {path}  ({count / timing.fps:.3g} s, {count} frames, {timing.fps:g} a second)"


class FrameProgress:
    """A progress bar where stderr is a terminal, a line now and then where not. Shown by rank 0 only."""

    LINE_SECONDS = 10.0

    def __init__(self, comm: MPI.Comm, *, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stderr
        self._shown = comm.rank == 0
        self._began = self._last = wall.monotonic()
        self._bar: Bar | None = None
        if self._shown and self._stream.isatty():
            from lyra_petsc.cli.progress import _bar

            self._bar = _bar(self._stream)
            self._task = self._bar.add_task("", total=1.0, state="")
            self._bar.start()

    def update(self, done: int, count: int) -> None:
        """Tell how many of the states are drawn."""
        from lyra_petsc.cli.progress import duration

        if not self._shown:
            return
        now = wall.monotonic()
        left = (now - self._began) * (count - done) / done if done else math.nan
        text = f"{done} of {count} states drawn  {duration(left)} left"
        with suppress(OSError):
            if self._bar is not None:
                self._bar.update(self._task, completed=done / count, state=text)
                self._bar.refresh()
            elif now - self._last >= self.LINE_SECONDS:
                self._last = now
                print(f"{done / count:4.0%}  {text}", file=self._stream, flush=True)

    def __enter__(self) -> FrameProgress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            with suppress(OSError):
                self._bar.refresh()
                self._bar.stop()
            self._bar = None
