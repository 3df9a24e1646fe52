"""Draws a plan: fits camera and colours to the whole motion, then the ranks share the states."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from itertools import chain
from pathlib import Path

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.output.agreement import on_each
from lyra_petsc.output.read_run import Run
from lyra_petsc.show.render.camera import Fit, upwards
from lyra_petsc.show.render.colour_quantities import ColourQuantity, quantity
from lyra_petsc.show.render.image_files import contact_sheet, film_writer, half_size, write_png
from lyra_petsc.show.render.render_plan import RenderPlan, run_line_of_sight
from lyra_petsc.show.render.scene_drawing import Bounds, SceneDrawing, wind_arrows

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


def draw(comm: MPI.Comm, plan: RenderPlan, show_progress: Callable[[int, int], None]) -> list[Path]:
    """Draw and write everything; collective.

    Parameters
    ----------
    comm : MPI.Comm
    plan : RenderPlan
        The same on all ranks.
    show_progress : callable
        Called on all ranks with the number of states drawn so far and their total; may raise to stop.

    Returns
    -------
    list of Path
        The files written; empty on all ranks but 0.

    Raises
    ------
    InputError
        If results cannot be read.
    OutputError
        If a picture cannot be written; an incomplete film is removed.
    """
    states, size = plan.states, comm.size
    with ExitStack() as opened:
        drawing = _fitted_drawing(comm, plan)
        opened.callback(drawing.close)
        files = on_each(comm, lambda: PictureFiles(plan, opened) if comm.rank == 0 else None)
        for first in range(0, len(states), size):
            show_progress(first, len(states))
            mine = states[first + comm.rank : first + comm.rank + 1]
            images = comm.gather(on_each(comm, lambda: [drawing.image(i) for i in mine]))  # noqa: B023
            on_each(comm, lambda: _write(files, states[first:], images))  # noqa: B023
        written = on_each(comm, lambda: files.finish() if files else [])
        show_progress(len(states), len(states))
        return written


def _write(files: PictureFiles | None, states: list[int], images: list[list[Image]] | None) -> None:
    """Write the images that the ranks have drawn of the first of ``states``, one a rank or none (rank 0)."""
    if files is not None and images is not None:
        for state, image in zip(states, chain.from_iterable(images), strict=False):
            files.write(state, image)


def _fitted_drawing(comm: MPI.Comm, plan: RenderPlan) -> SceneDrawing:
    """The drawing with a camera and colours that fit the whole motion; collective."""
    shown = on_each(comm, lambda: quantity(plan.run, plan.options.field) if plan.options.field else None)
    sight = on_each(comm, lambda: run_line_of_sight(plan.run, plan.scene))
    axes = Bounds.axes_of(upwards(plan.scene))
    fit = Fit(plan.scene, sight, axes[2], plan.size[0] / plan.size[1], bar=shown is not None)
    normals = np.concatenate([fit.normals, axes, -axes])
    mine = plan.motion[comm.rank :: comm.size]
    found = on_each(comm, lambda: extent(plan.run, mine, normals, None if plan.limits else shown))
    comm.Allreduce(MPI.IN_PLACE, found, MPI.MAX)
    n = len(fit.normals)
    reach, bounds = found[:n], Bounds(axes, -found[n + 3 : n + 6], found[n : n + 3])
    limits = plan.limits or colour_limits(-found[-2], found[-1])
    wind = None
    if plan.options.wind and plan.scene.wind is not None:
        wind = np.array(plan.scene.wind.velocity)
        feet, arrow = wind_arrows(bounds, wind)
        ends = np.concatenate([feet, feet + arrow])
        reach = np.maximum(reach, (ends @ fit.normals.T).max(axis=0))
    return on_each(comm, lambda: SceneDrawing(plan, fit.view(reach), bounds, shown, limits, wind))


def extent(run: Run, states: list[int], normals: Array, shown: ColourQuantity | None) -> Array:
    """How far states reach and which values they have, as numbers of which the maximum counts.

    Parameters
    ----------
    run : Run
    states : list of int
    normals : (n, 3) float64
    shown : ColourQuantity or None

    Returns
    -------
    (n + 2,) float64
        Largest product of a vertex with each normal [m], minus the lowest value of the quantity, its highest
        value; minus infinity without states or quantity.

    Raises
    ------
    InputError
        If a state is damaged.
    """
    found = np.full(len(normals) + 2, -np.inf)
    for state in states:
        x = run.positions[state]
        low, high = (np.inf, -np.inf) if shown is None else shown.span(state)
        found = np.maximum(found, [*(x @ normals.T).max(axis=0), -low, high])
    return found


def colour_limits(low: float, high: float) -> tuple[float, float]:
    """Range of the colours, which must not be empty."""
    if low < high:
        return low, high
    middle = low if np.isfinite(low) else 0.0
    return middle, middle + max(1e-12, 1e-6 * abs(middle))


class PictureFiles:
    """Writes all files of a plan from the images of its states, which come in ascending order.

    Parameters
    ----------
    plan : RenderPlan
    opened : ExitStack
        Removes an incomplete film.
    """

    def __init__(self, plan: RenderPlan, opened: ExitStack) -> None:
        self._plan = plan
        self._tiles: list[Image] = []
        self._written: list[Path] = []
        self._film = opened.enter_context(ExitStack())
        if plan.film is not None:
            path, timing = plan.film
            self._frames = Counter(timing.states)
            self._add_frame = self._film.enter_context(film_writer(path, plan.size, timing.fps))

    def write(self, state: int, image: Image) -> None:
        """Write the image (height, width, 3) of a state to all files that show it.

        Raises
        ------
        OutputError
        """
        for path, shown in self._plan.pictures:
            if shown == state:
                write_png(path, image)
                self._written.append(path)
        if self._plan.film is not None:
            for _ in range(self._frames[state]):
                self._add_frame(image)
        if self._plan.sheet is not None and state in self._plan.sheet[1]:
            self._tiles.append(half_size(image))

    def finish(self) -> list[Path]:
        """Write the contact sheet and end the film; all files written.

        Raises
        ------
        OutputError
        """
        if self._plan.sheet is not None:
            write_png(self._plan.sheet[0], contact_sheet(self._tiles))
            self._written.append(self._plan.sheet[0])
        if self._plan.film is not None:
            self._film.close()
            self._written.append(self._plan.film[0])
        return self._written
