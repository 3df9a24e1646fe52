"""Drawing a plan: camera and colours are fitted to the whole motion, then the ranks share the states."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.output.file_operations import on_every_rank
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.scene.time_curve import TimeCurve
from lyra_petsc.show.render.camera import CameraFit, up_direction
from lyra_petsc.show.render.colour_quantities import PERCENTILES, ColourQuantity, quantity
from lyra_petsc.show.render.image_files import contact_sheet, film_writer, half_size, write_png
from lyra_petsc.show.render.render_plan import RenderPlan, run_line_of_sight
from lyra_petsc.show.render.scene_drawing import (
    Bounds,
    SceneDrawing,
    floor_height,
    near_obstacle_points,
    wind_arrows,
)

if TYPE_CHECKING:
    from mpi4py import MPI

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
        drawing = fitted_drawing(comm, plan)
        opened.callback(drawing.close)
        files = on_every_rank(comm, lambda: PictureFiles(plan, opened) if comm.rank == 0 else None)
        for first in range(0, len(states), size):
            show_progress(first, len(states))
            mine = states[first + comm.rank : first + comm.rank + 1]
            images = comm.gather(on_every_rank(comm, lambda: [drawing.image(i) for i in mine]))  # noqa: B023
            on_every_rank(comm, lambda: _write(files, states[first:], images))  # noqa: B023
        written = on_every_rank(comm, lambda: files.finish() if files else [])
        show_progress(len(states), len(states))
        return written


def _write(files: PictureFiles | None, states: list[int], images: list[list[Image]] | None) -> None:
    """Write the images of the first of ``states``, of which each rank has drawn one or none (rank 0)."""
    if files is not None and images is not None:
        for state, image in zip(states, chain.from_iterable(images), strict=False):
            files.write(state, image)


def fitted_drawing(comm: MPI.Comm, plan: RenderPlan) -> SceneDrawing:
    """The drawing, with a camera that fits most of the states drawn, and colours the motion; collective."""
    shown = on_every_rank(comm, lambda: colour_quantity(plan))
    sight = on_every_rank(comm, lambda: run_line_of_sight(plan.run, plan.scene))
    axes = Bounds.axes_of(up_direction(plan.scene))
    fit = CameraFit(plan.scene, sight, axes[2], plan.size[0] / plan.size[1], bar=shown is not None)
    normals = np.concatenate([fit.normals, axes, -axes])
    mine = plan.motion[comm.rank :: comm.size]
    supports, values = on_every_rank(comm, lambda: measure_states(plan.run, mine, normals, shown))
    supports, values = (np.concatenate(comm.allgather(part)) for part in (supports, values))
    n, whole = len(fit.normals), supports.max(axis=0)
    drawn = np.isin(
        np.concatenate([plan.motion[rank :: comm.size] for rank in range(comm.size)]), plan.states
    )
    support = fit.framed_support(supports[drawn, :n])
    bounds = Bounds(axes, -whole[n + 3 :], whole[n : n + 3])
    times = plan.run.times
    obstacles: list[ObstacleSurface] = []
    if plan.scene.obstacles:
        obstacles = on_every_rank(comm, lambda: _obstacles(plan, bounds))
    floor = floor_height(obstacles, bounds, times[plan.motion])
    near = near_obstacle_points(obstacles, bounds, times[plan.states], normals)
    support = np.maximum(support, (near @ fit.normals.T).max(axis=0, initial=-np.inf))
    bounds = bounds.including(near)
    limits = (0.0, 1.0) if shown is None else shown.limits(values, plan.limits)
    wind = None
    if plan.options.wind and plan.scene.wind is not None:
        wind = TimeCurve.of(plan.scene.wind.velocity)
        for velocity in filter(np.any, wind.values):
            feet, arrow = wind_arrows(bounds, velocity)
            ends = np.concatenate([feet, feet + arrow])
            support = np.maximum(support, (ends @ fit.normals.T).max(axis=0))
    view = fit.view(support)
    return on_every_rank(
        comm, lambda: SceneDrawing(plan, view, bounds, shown, limits, wind, obstacles, floor)
    )


def _obstacles(plan: RenderPlan, bounds: Bounds) -> list[ObstacleSurface]:
    from lyra_petsc.show.obstacle_surfaces import obstacle_surfaces  # a slow import that few runs need

    return obstacle_surfaces(plan.run, bounds.middle, bounds.size)


def colour_quantity(plan: RenderPlan) -> ColourQuantity | None:
    if plan.options.field is None:
        return None
    field = quantity(plan.run, plan.options.field)
    return field if plan.options.cells else field.on_vertices(plan.run)


def measure_states(
    run: StoredRun, states: list[int], normals: Array, shown: ColourQuantity | None
) -> tuple[Array, Array]:
    """Support and percentiles of the values of states.

    Parameters
    ----------
    run : StoredRun
    states : list of int
    normals : (n, 3) float64
    shown : ColourQuantity or None

    Returns
    -------
    supports : (len(states), n) float64
        Largest product of a vertex with each normal (the support) [m].
    values : (len(states), 401) float64
        Percentiles of the quantity; NaN without one.

    Raises
    ------
    InputError
        If a state is damaged.
    """
    supports = np.empty((len(states), len(normals)))
    values = np.full((len(states), len(PERCENTILES)), np.nan)
    for row, state in enumerate(states):
        x = run.positions[state]
        supports[row] = (x @ normals.T).max(axis=0)
        if shown is not None:
            values[row] = shown.percentiles(state)
    return supports, values


class PictureFiles:
    """Writes all files of a plan from the images of its states, which are given in ascending order.

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
        """Write the contact sheet and end the film; returns all files written.

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
