"""The verb ``run``: simulates a scene and writes its results into a folder."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from mpi4py import MPI
from petsc4py import PETSc

from lyra_petsc.api.run_loop import ProgressCallbacks, simulate
from lyra_petsc.cli.marked_places import places_shown
from lyra_petsc.cli.progress import ProgressBar, closing_table
from lyra_petsc.cli.signals import StopRequest
from lyra_petsc.kernels.ahead import CompilationAhead
from lyra_petsc.kernels.compilation import COMPILATION, no_action
from lyra_petsc.linear.petsc_options import unused
from lyra_petsc.output.run_folder import choose_folder
from lyra_petsc.parallel import on_root
from lyra_petsc.phases import Phases
from lyra_petsc.scene.load import default_scene, load_scene
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.simulation import SteppedScene, StepReport

if TYPE_CHECKING:
    from lyra_petsc.cli.view import Served
    from lyra_petsc.show.view.live import LivePage


COMPILING_TAKES = "about 5 s, or up to half a minute with contact or midedge"
NO_CACHE = "no folder for them can be written; NUMBA_CACHE_DIR names another"


def read_scene(comm: MPI.Comm, path: Path, settings: Sequence[str], *, trust_mesh: bool = False) -> Scene:
    """The checked scene on all ranks; read on rank 0."""
    scene = on_root(comm, lambda: load_scene(path, settings))
    return scene.trusting_meshes() if trust_mesh else scene


def run(
    comm: MPI.Comm,
    scene: Path | None,
    settings: Sequence[str],
    *,
    out: Path | None,
    force: bool,
    resume: bool,
    trust_mesh: bool = False,
    served: Served | None = None,
) -> None:
    """Simulate a scene, shown on a live page if ``served`` is given; collective.

    Raises
    ------
    InputError
        For bad input; nothing is written.
    SolverError, OutputError
        If the run cannot continue; all states written before can be read.
    Interrupted
        After a signal; the last step is in the checkpoint.
    """
    if served is not None:
        on_root(comm, lambda: served.check("--live"))
    phases = Phases(report=say)
    stop = StopRequest(comm)
    if scene is None and resume and out is not None:
        scene = out / "scene.yaml"
    path = scene or default_scene()
    choice = choose_folder(comm, path.stem, out, force=force, resume=resume)
    loaded = read_scene(comm, path, settings, trust_mesh=trust_mesh)
    progress = TerminalProgress(comm, served, choice.first)
    with places_shown(comm):
        simulate(comm, loaded, choice, progress, stop.signal_number, phases)


def say(text: str) -> None:
    """Print a line for the user; a closed pipe does not end the run."""
    with suppress(OSError):
        print(text, file=sys.stderr, flush=True)


class TerminalProgress(ProgressCallbacks):
    """Shows the progress of a run, its notes, and at the end the wall time of its phases.

    Parameters
    ----------
    comm : MPI.Comm
    served : Served, optional
        Address of the live page.
    usual : Path, optional
        The default folder of the results, which is used unless it exists.
    """

    def __init__(self, comm: MPI.Comm, served: Served | None = None, usual: Path | None = None) -> None:
        self._comm, self._usual = comm, usual
        self._progress: ProgressBar | None = None
        self._noted_cache = False
        if comm.size == 1:
            COMPILATION.ahead = CompilationAhead()
        if comm.rank == 0:
            COMPILATION.first = self._announce_compilation
        self._served = served if comm.rank == 0 else None
        self._page: LivePage | None = None

    def _say(self, text: str) -> None:
        if self._progress is not None:
            self._progress.say(text)

    def _announce_compilation(self) -> None:
        """Tell the user that kernels are being compiled, above the bar once there is one."""
        text = f"compiling kernels, once: {COMPILING_TAKES}"
        if not COMPILATION.all_cached:
            self._noted_cache = True
            text = f"compiling kernels in every run: {COMPILING_TAKES}; {NO_CACHE}"
        if self._progress is not None:
            self._progress.say(text)
        else:
            say(text)

    def begin(self, simulation: SteppedScene, folder: Path) -> None:
        """Start the progress bar, and show the run on the page."""
        self._folder, self._start = folder, simulation.time
        self._progress = ProgressBar(
            self._comm,
            plain=petsc_prints(),
            clock=lambda: time.monotonic() - COMPILATION.seconds,
        )
        if self._usual is not None and folder != self._usual:
            self.note(f"{self._usual} exists: the results go to {folder} (--force would replace it)")
        if self._served is not None:
            self._page = self._served.live_page(folder, self._say)

    def note(self, text: str) -> None:
        """Print a line above the bar."""
        self._say(f"note: {text}")

    def step(self, simulation: SteppedScene, report: StepReport) -> None:
        """Move the bar."""
        if self._progress is None:
            return
        end = simulation.control.end
        at = f"load {report.time:.4g} of {end:.4g}"
        if simulation.problem.equations.integrator.dynamic:
            at = f"t {report.time:.4g} of {end:.4g} s"
        self._progress.show(
            min((report.time - self._start) / (end - self._start), 1.0),
            f"{at}  step {report.step}  Newton {report.newton_iterations}  "
            f"linear {report.linear_iterations}  energy {simulation.budget.total:.4g} J",
        )

    def close(self) -> None:
        """Leave the terminal as it was, end the page, and say how to view the run again."""
        COMPILATION.first = COMPILATION.ahead = no_action
        if self._progress is not None:
            self._progress.close()
        if self._page is not None:
            self._page.end()
            with suppress(OSError):
                print(f"look again   lyra-petsc view {self._folder}", flush=True)

    def done(self, simulation: SteppedScene, folder: Path) -> None:
        """Print the closing table, and a warning of unused PETSc options."""
        simulation.stepper.solver.ts.viewFromOptions("-ts_view")
        outcome = "done"
        if not simulation.at_end:
            now = f"step {simulation.step_number}, t = {simulation.time:g} of {simulation.control.end:g} s"
            outcome = f"stopped at {now}, by -ts_max_steps; --resume goes on"
        if not COMPILATION.all_cached and not self._noted_cache:
            self._say(f"note: the next run compiles kernels anew: {NO_CACHE}")
        if self._comm.rank == 0:
            closing_table(simulation.phases.seconds(), folder, outcome)
            warn_unused(simulation.stepper.our_options)


def petsc_prints() -> bool:
    """Whether PETSc prints during the run, which would disturb a progress bar."""
    names = PETSc.Options().getAll()
    return any(word in name for name in names for word in ("monitor", "converged_reason", "_view", "info"))


def warn_unused(defaults: list[str]) -> None:
    """Warn of PETSc options that were not used, except those in ``defaults``; to be called on one rank."""
    if names := unused(defaults):
        listed = ", ".join(f"-{name}" for name in names)
        print(f"lyra-petsc: warning: PETSc options that nothing used: {listed}", file=sys.stderr)
