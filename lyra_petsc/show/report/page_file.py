"""report.html of a run, with pictures as ``render`` draws them where that can be."""

from __future__ import annotations

import tempfile
from pathlib import Path

from lyra_petsc.errors import InputError, LyraError
from lyra_petsc.extras import missing
from lyra_petsc.output.atomic import replace_text
from lyra_petsc.output.read_run import Run
from lyra_petsc.show.render.render_plan import PACKAGES, RenderOptions, make_plan
from lyra_petsc.show.report.document import Drawing
from lyra_petsc.show.report.run_page import chosen_states, plain_pictures, run_page, state_caption

PAGE = "report.html"
PICTURE_SIZE = "960x540"


def write_page(folder: Path, out: Path | None) -> Path:
    """Write the page of a run; the file's path. On one rank.

    Raises
    ------
    InputError
        If the folder is none of a run.
    OutputError
        If the page cannot be written.
    """
    path = folder / PAGE if out is None else out
    if path.is_dir() or not path.absolute().parent.is_dir():
        what = "is a folder; name a file" if path.is_dir() else "cannot be written: there is no such folder"
        raise InputError(what, file=path, key="--out")
    run = Run(folder)
    pictures = _rendered(run) or plain_pictures(run)
    replace_text(path, run_page(run, pictures).html())
    return path


def _rendered(run: Run) -> list[Drawing]:
    """Pictures of a few states as ``render`` draws them; none where that cannot be."""
    if missing(PACKAGES):
        return []
    from mpi4py import MPI

    from lyra_petsc.show.render.draw import draw

    states = chosen_states(run)
    with tempfile.TemporaryDirectory() as folder:
        times = ",".join(repr(float(run.times[i])) for i in states)
        options = RenderOptions(run.folder, at=times, out=Path(folder), size=PICTURE_SIZE, label=False)
        try:
            plan = make_plan(options)
            draw(MPI.COMM_SELF, plan, lambda done, count: None)
            drawn = {state: path.read_bytes() for path, state in plan.pictures}
        except LyraError:  # no OpenGL: the page has plain pictures
            return []
    return [Drawing(f"state-{i}", state_caption(run, i), drawn[i], b"") for i in states]
