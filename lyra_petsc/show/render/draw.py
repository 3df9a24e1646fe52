"""Draws a plan: fits camera and colours to the whole motion, then the ranks share the states."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.output.agreement import on_each
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.show.render.camera import Fit, upwards
from lyra_petsc.show.render.colour_quantities import PERCENTILES, ColourQuantity, quantity
from lyra_petsc.show.render.image_files import contact_sheet, film_writer, half_size, write_png
from lyra_petsc.show.render.render_plan import RenderPlan, run_line_of_sight
from lyra_petsc.show.render.scene_drawing import Bounds, SceneDrawing, near_points, wind_arrows

if TYPE_CHECKING:
    from lyra_petsc.show.obstacle_surfaces import ObstacleSurface

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
    """The drawing with a camera and colours that fit most of the motion; collective."""
    shown = on_each(comm, lambda: _shown(plan))
    sight = on_each(comm, lambda: run_line_of_sight(plan.run, plan.scene))
    axes = Bounds.axes_of(upwards(plan.scene))
    fit = Fit(plan.scene, sight, axes[2], plan.size[0] / plan.size[1], bar=shown is not None)
    normals = np.concatenate([fit.normals, axes, -axes])
    mine = plan.motion[comm.rank :: comm.size]
    reaches, values = on_each(comm, lambda: extent(plan.run, mine, normals, shown))
    reaches, values = (np.concatenate(comm.allgather(part)) for part in (reaches, values))
    n, whole = len(fit.normals), reaches.max(axis=0)
    reach, bounds = fit.most(reaches[:, :n]), Bounds(axes, -whole[n + 3 :], whole[n : n + 3])
    obstacles: list[ObstacleSurface] = []
    if plan.scene.obstacles:
        obstacles = on_each(comm, lambda: _obstacles(plan, bounds))
        near = near_points(obstacles, bounds, plan.run.times[plan.motion])
        reach = np.maximum(reach, (near @ axes @ fit.normals.T).max(axis=0, initial=-np.inf))
        bounds = bounds.around(near)
    limits = (0.0, 1.0) if shown is None else shown.limits(values, plan.limits)
    wind = None
    if plan.options.wind and plan.scene.wind is not None:
        wind = np.array(plan.scene.wind.velocity)
        feet, arrow = wind_arrows(bounds, wind)
        ends = np.concatenate([feet, feet + arrow])
        reach = np.maximum(reach, (ends @ fit.normals.T).max(axis=0))
    view = fit.view(reach)
    return on_each(comm, lambda: SceneDrawing(plan, view, bounds, shown, limits, wind, obstacles))


def _obstacles(plan: RenderPlan, bounds: Bounds) -> list[ObstacleSurface]:
    from lyra_petsc.show.obstacle_surfaces import obstacle_surfaces  # of use for nothing else

    return obstacle_surfaces(plan.run, bounds.middle, bounds.size)


def _shown(plan: RenderPlan) -> ColourQuantity | None:
    if plan.options.field is None:
        return None
    found = quantity(plan.run, plan.options.field)
    return found if plan.options.cells else found.on_vertices(plan.run)


def extent(
    run: StoredRun, states: list[int], normals: Array, shown: ColourQuantity | None
) -> tuple[Array, Array]:
    """How far states reach and which values they have.

    Parameters
    ----------
    run : StoredRun
    states : list of int
    normals : (n, 3) float64
    shown : ColourQuantity or None

    Returns
    -------
    reaches : (len(states), n) float64
        Largest product of a vertex with each normal [m].
    values : (len(states), 401) float64
        Percentiles of the quantity; NaN without one.

    Raises
    ------
    InputError
        If a state is damaged.
    """
    reaches = np.empty((len(states), len(normals)))
    values = np.full((len(states), len(PERCENTILES)), np.nan)
    for row, state in enumerate(states):
        x = run.positions[state]
        reaches[row] = (x @ normals.T).max(axis=0)
        if shown is not None:
            values[row] = shown.percentiles(state)
    return reaches, values


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
