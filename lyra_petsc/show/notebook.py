"""Runs as notebooks and scripts use them: progress while they go on, pictures, films and the page inline."""

from __future__ import annotations

import base64
import html
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lyra_petsc.errors import python_argument_names
from lyra_petsc.extras import require_packages
from lyra_petsc.output.read_run import StoredRun

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
        Of the file.
    kind : str
        Its MIME type.
    """

    def __init__(self, data: bytes, kind: str) -> None:
        self.data, self.kind = data, kind

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write it to a file."""
        Path(path).write_bytes(self.data)
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


class Run(StoredRun):
    """The results of a run; reads files only when asked for their content, and keeps none open.

    Parameters
    ----------
    folder : path

    Raises
    ------
    InputError
        If there is no run, or nothing of it can be read yet.
    """

    def __init__(self, folder: str | Path) -> None:
        with python_argument_names():
            super().__init__(folder)

    def render(self, at: float | None = None, *, film: bool | str = False, **options: Any) -> Media:
        """A picture or a film, as of the command ``render``; not collective.

        Parameters
        ----------
        at : float, optional
            Time of the picture [s]; the last state without it.
        film : bool or str
            A film of the whole run instead: True for mp4, or ``"gif"``, ``"webm"``.
        **options
            ``field``, ``range``, ``size``, ``fps``, ``speed``, ``texture``, ``colors``, ``handles``,
            ``wind``, ``cells``, ``ground``, ``label``, ``settings``: as of the command.

        Returns
        -------
        Media
            Shown inline by notebooks; ``save(path)`` writes it.

        Raises
        ------
        InputError
            For what cannot be drawn, or packages that are missing.
        TypeError
            For an option that there is none of.
        """
        with python_argument_names():
            from lyra_petsc.show.render.render_plan import PACKAGES, RenderOptions, make_plan

            require_packages("render", PACKAGES, "view")
            from mpi4py import MPI

            from lyra_petsc.show.render.draw import draw

            with tempfile.TemporaryDirectory() as folder:
                ending = film if isinstance(film, str) else "mp4"
                asked: dict[str, Any] = {"out": Path(folder), "size": SIZE, **options}
                if film:
                    asked["film"] = Path(folder) / f"film.{ending.lstrip('.')}"
                else:
                    asked["at"] = repr(float(self.times[-1] if at is None else at))
                if isinstance(asked.get("range"), tuple | list):
                    asked["range"] = ",".join(map(str, asked["range"]))
                (path,) = draw(
                    MPI.COMM_SELF, make_plan(RenderOptions(self.folder, **asked)), lambda done, count: None
                )
                return Media(path.read_bytes(), TYPES[path.suffix.lower()])

    def report(self, out: str | os.PathLike[str] | None = None) -> Media:
        """The page about the run, as of the command ``report``; written to ``out`` or the run's folder.

        Raises
        ------
        InputError, OutputError
            If it cannot be made or written.
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

    An interrupt (the stop button of a notebook, Ctrl-C) lets the step end, writes a checkpoint and raises
    KeyboardInterrupt; ``resume=True`` goes on from there.

    Parameters
    ----------
    scene : Scene, path or mapping
    out : path, optional
        Folder of the results; else ``runs/<scene file stem>``, or ``…-2``, ``…-3`` when that exists.
    force : bool
        Replace the results in ``out``.
    resume : bool
        Go on from the newest checkpoint.
    trust_mesh : bool
        Give gmsh this scene's scripts (.geo) whatever they say.
    on_step : callable, optional
        Called after each step with its report (``step``, ``time``, ``dt``, ``newton_iterations``, …).
    comm : MPI.Comm, optional
        COMM_WORLD unless given.
    progress : bool, optional
        Show how far it is in the notebook; without it where there is one.

    Returns
    -------
    Run

    Raises
    ------
    InputError
        Bad input; nothing is written.
    SolverError, OutputError
        The run could not go on; what was written stands.
    """
    from lyra_petsc.api.runs import run as simulate

    with python_argument_names():
        how: dict[str, Any] = {"force": force, "resume": resume, "trust_mesh": trust_mesh}
        return Run(simulate(scene, out, **how, on_step=on_step, comm=comm, progress=progress))
