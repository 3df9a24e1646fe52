"""Runs for notebooks and scripts: simulating with progress, and pictures, films and reports shown inline."""

from __future__ import annotations

import base64
import html
import os
import queue
import tempfile
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from lyra_petsc.errors import InputError, python_argument_names
from lyra_petsc.extras import require_packages
from lyra_petsc.output.file_operations import open_output
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.parallel import ALONE
from lyra_petsc.startup import start_petsc

if TYPE_CHECKING:
    from mpi4py import MPI

    from lyra_petsc.api.runs import OnStep
    from lyra_petsc.api.scenes import SceneLike

SIZE = "640x360"
"""Pixels of pictures and films."""
TYPES = {".png": "image/png", ".gif": "image/gif", ".mp4": "video/mp4", ".webm": "video/webm"}


class Media:
    """A picture, a film or a page, which notebooks show inline.

    Attributes
    ----------
    data : bytes
        Content of the file.
    kind : str
        MIME type.
    """

    def __init__(self, data: bytes, kind: str) -> None:
        self.data, self.kind = data, kind

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write ``data`` to a file."""
        with open_output(path) as file:
            file.write(self.data)
        return Path(path)

    def _repr_png_(self) -> bytes | None:
        return self.data if self.kind == "image/png" else None

    def _repr_html_(self) -> str | None:
        if self.kind == "image/png":
            return None
        if self.kind == "text/html":
            page = html.escape(self.data.decode())
            return f'<iframe srcdoc="{page}" width="100%" height="640" style="border: 0"></iframe>'
        source = f"data:{self.kind};base64,{base64.b64encode(self.data).decode()}"
        if self.kind == "image/gif":
            return f'<img src="{source}">'
        return f'<video controls loop autoplay muted src="{source}"></video>'

    def __repr__(self) -> str:
        return f"<{self.kind}, {len(self.data)} bytes>"


REDIRECTION = """<script>
location.replace(`http://${parent.location.hostname === "localhost" ? "localhost" : "127.0.0.1"}%s`)
</script>"""
"""Opens the page under the notebook's own name of this machine: frames of other names get no cookies."""


class ViewedPage(Media):
    """The live page of a run, served on this machine until this object is gone and nobody has the page open.

    Attributes
    ----------
    url : str
        The page's address, to open it elsewhere than in the notebook.

    Raises
    ------
    InputError
        If the page cannot be served.
    """

    def __init__(self, folder: Path) -> None:
        from lyra_petsc.show.view.live import LivePage

        answers: queue.SimpleQueue[tuple[str, str]] = queue.SimpleQueue()
        self._process = LivePage(
            folder, "127.0.0.1", 0, lambda url: answers.put((url, "")), lambda why: answers.put(("", why))
        )
        self.url, problem = answers.get()
        if problem:
            raise InputError(problem)
        parts = urlsplit(self.url)
        redirection = REDIRECTION % f":{parts.port}{parts.path}?{parts.query}"
        super().__init__(redirection.encode(), "text/html")

    def __repr__(self) -> str:
        return f"<page {self.url}>"


class Run(StoredRun):
    """The results of a run; reads files only when asked for their content, and keeps none open.

    Parameters
    ----------
    folder : path

    Raises
    ------
    InputError
        If the folder is not one of a run, or no state is written yet.
    """

    def __init__(self, folder: str | Path) -> None:
        with python_argument_names():
            super().__init__(folder)

    def _repr_html_(self) -> str:
        title = html.escape(self.scene.title or self.name)
        return f"<b>{title}</b>, {html.escape(self.outcome)}: <code>{html.escape(repr(self))}</code>"

    def render(self, at: float | None = None, *, film: bool | str = False, **options: Any) -> Media:
        """A picture or a film, as drawn by the command ``render``; not collective.

        Parameters
        ----------
        at : float, optional
            Time of the picture [s]; by default that of the last state.
        film : bool or str
            A film of the whole run instead: True for mp4, or ``"gif"``, ``"webm"``.
        **options
            The command's options ``field``, ``range``, ``size``, ``fps``, ``speed``, ``texture``, ``colors``,
            ``handles``, ``wind``, ``cells``, ``ground``, ``label``, ``settings``.

        Returns
        -------
        Media
            Shown inline by notebooks; ``save(path)`` writes it.

        Raises
        ------
        InputError
            For options or data that cannot be drawn, or missing packages.
        TypeError
            For an unknown option.
        """
        with python_argument_names():
            from lyra_petsc.show.render.render_plan import PACKAGES, RenderOptions, make_plan

            require_packages("render", PACKAGES, "view")
            from lyra_petsc.show.render.draw import draw

            with tempfile.TemporaryDirectory() as folder:
                ending = film if isinstance(film, str) else "mp4"
                chosen: dict[str, Any] = {"out": Path(folder), "size": SIZE, **options}
                if film:
                    chosen["film"] = Path(folder) / f"film.{ending.lstrip('.')}"
                else:
                    chosen["at"] = repr(float(self.times[-1] if at is None else at))
                if isinstance(chosen.get("range"), tuple | list):
                    chosen["range"] = ",".join(map(str, chosen["range"]))
                plan = make_plan(RenderOptions(self.folder, **chosen))
                (path,) = draw(ALONE, plan, lambda done, count: None)
                return Media(path.read_bytes(), TYPES[path.suffix.lower()])

    def view(self) -> ViewedPage:
        """The live page of the run, inside the notebook, as served by the command ``view``.

        Raises
        ------
        InputError
            If packages are missing or the page cannot be served.
        """
        return self._page

    @cached_property
    def _page(self) -> ViewedPage:
        with python_argument_names():
            from lyra_petsc.show.view.live import PACKAGES

            require_packages("view", PACKAGES, "view")
            return ViewedPage(self.folder)

    def report(self, out: str | os.PathLike[str] | None = None) -> Media:
        """The report page of the run, as written by the command ``report`` to ``out`` or the run's folder.

        Raises
        ------
        InputError, OutputError
            If the page cannot be created or written.
        """
        with python_argument_names():
            require_packages("report", ("matplotlib", "jinja2"))
            from lyra_petsc.show.report.run_page import write_page

            path = write_page(self.folder, None if out is None else Path(out))
            return Media(path.read_bytes(), "text/html")


def run(
    scene: SceneLike,
    out: str | os.PathLike[str] | None = None,
    *,
    force: bool = False,
    resume: bool = False,
    trust_mesh: bool = False,
    on_step: OnStep | None = None,
    comm: MPI.Comm | None = None,
    progress: bool | None = None,
) -> Run:
    """Simulate a scene and write its results, as the command ``run`` does; collective.

    After an interrupt (the stop button of a notebook, Ctrl-C) the run finishes its step, writes a checkpoint
    and raises KeyboardInterrupt; ``resume=True`` continues from the checkpoint.

    Parameters
    ----------
    scene : Scene, path or mapping
    out : path, optional
        Folder of the results; by default ``runs/<scene file stem>``, or ``…-2``, ``…-3`` if it exists.
    force : bool
        Replace the results in ``out``.
    resume : bool
        Continue from the newest checkpoint.
    trust_mesh : bool
        Let this scene's scripts (.geo) read any file, and run where there is no seccomp.
    on_step : callable, optional
        Called after each step with its report (``step``, ``time``, ``dt``, ``newton_iterations``, …).
    comm : MPI.Comm, optional
        By default COMM_WORLD.
    progress : bool, optional
        Show the progress in the notebook; by default in notebooks only.

    Returns
    -------
    Run

    Raises
    ------
    InputError
        Bad input; nothing is written.
    SolverError, OutputError
        The run failed; the states written before are kept.
    """
    with python_argument_names():
        start_petsc()
        from lyra_petsc.api.runs import run as simulate

        options: dict[str, Any] = {"force": force, "resume": resume, "trust_mesh": trust_mesh}
        return Run(simulate(scene, out, **options, on_step=on_step, comm=comm, progress=progress))
