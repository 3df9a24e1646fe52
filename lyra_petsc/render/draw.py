"""Draws what was planned; the ranks share the states."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.output.agreement import on_each
from lyra_petsc.render.camera import Fit, line_of_sight, upwards
from lyra_petsc.render.files import PictureFiles
from lyra_petsc.render.ground import Bounds
from lyra_petsc.render.held import HeldVertices
from lyra_petsc.render.plan import Asked, Plan
from lyra_petsc.render.quantities import Quantity, material_coordinates, quantity
from lyra_petsc.render.stage import Look, Stage, wind_arrows
from lyra_petsc.render.surface import over_whole_sheet
from lyra_petsc.render.survey import Survey, survey
from lyra_petsc.render.timing import decimals, spread_states

if TYPE_CHECKING:
    from mpi4py import MPI

LOOKED_AT = 9
"""States from which the direction of the camera is found."""


def draw(comm: MPI.Comm, asked: Asked, plan: Plan, tell: Callable[[int, int], None]) -> list[Path]:
    """Draw and write everything; collective.

    Parameters
    ----------
    comm : MPI.Comm
    asked : Asked
    plan : Plan
        The same on all ranks.
    tell : callable
        Called on all ranks with the number of states drawn so far, and of all; may raise to end.

    Returns
    -------
    list of Path
        What was written; empty but on rank 0.

    Raises
    ------
    InputError
        If results cannot be read.
    OutputError
        If a picture cannot be written; a film is whole or not there.
    """
    states = plan.states
    shown = on_each(comm, lambda: quantity(plan.run, asked.field) if asked.field else None)
    sight = on_each(comm, lambda: _line_of_sight(plan))
    normals = Bounds.axes_of(upwards(plan.scene))
    fit = Fit(plan.scene, sight, normals[2], plan.size[0] / plan.size[1], bar=shown is not None)
    around = np.concatenate([fit.normals, normals, -normals])
    mine = plan.motion[comm.rank :: comm.size]
    part = on_each(comm, lambda: survey(plan.run, mine, around, shown if plan.limits is None else None))
    whole = comm.bcast(_joined(comm.gather(part)))
    with ExitStack() as open_now:
        stage = on_each(comm, lambda: _stage(asked, plan, shown, fit, whole))
        open_now.callback(stage.close)
        files = PictureFiles(plan) if comm.rank == 0 else None
        if files is not None:
            open_now.push(files)
        on_each(comm, lambda: files.__enter__() if files else None)
        for first in range(0, len(states), comm.size):
            tell(first, len(states))
            image = on_each(comm, lambda: _image(stage, plan, states[first:], comm.rank))  # noqa: B023
            images = comm.gather(image)
            on_each(comm, lambda: _take(files, states[first:], images))  # noqa: B023
        written = on_each(comm, lambda: files.finish() if files else [])
        tell(len(states), len(states))
        return written


def _line_of_sight(plan: Plan) -> NDArray[np.float64]:
    shapes = (plan.run.positions[state] for state in spread_states(plan.run.times, LOOKED_AT))
    return line_of_sight(plan.scene, upwards(plan.scene), shapes, plan.run.triangles)


def _joined(parts: list[Survey] | None) -> Survey | None:
    if parts is None:
        return None
    whole = parts[0]
    for part in parts[1:]:
        whole = whole.join(part)
    return whole


def _stage(asked: Asked, plan: Plan, shown: Quantity | None, fit: Fit, whole: Survey) -> Stage:
    run, scene = plan.run, plan.scene
    n_fit = len(fit.normals)
    reach, up = whole.reach[:n_fit], upwards(scene)
    bounds = Bounds(Bounds.axes_of(up), -whole.reach[n_fit + 3 :], whole.reach[n_fit : n_fit + 3])
    wind = np.array(scene.wind.velocity) if asked.wind and scene.wind is not None else None
    if wind is not None:
        feet, arrow = wind_arrows(bounds, wind)
        ends = np.concatenate([feet, feet + arrow])
        reach = np.maximum(reach, (ends @ fit.normals.T).max(axis=0))
    corner_uv = None
    if plan.texture is not None:
        given = run.corner_uv
        corner_uv = over_whole_sheet(material_coordinates(run)) if given is None else given
    look = Look(
        size=plan.size,
        colors=plan.colors,
        quantity=shown,
        limits=plan.limits or whole.limits,
        texture=plan.texture,
        corner_uv=corner_uv,
        held=HeldVertices(run) if asked.handles else None,
        wind=wind,
        ground=asked.ground and scene.gravity is not None,
        label=asked.label,
        unit="" if scene.time.analysis == "static" else "s",
        decimals=decimals(run.times),
    )
    return Stage(look, fit.view(reach), bounds, run.triangles, len(run.rest))


def _image(stage: Stage, plan: Plan, states: list[int], rank: int) -> NDArray[np.uint8] | None:
    if rank >= len(states):
        return None
    state = states[rank]
    return stage.image(state, float(plan.run.times[state]), plan.run.positions[state])


def _take(
    files: PictureFiles | None, states: list[int], images: list[NDArray[np.uint8] | None] | None
) -> None:
    if files is not None and images is not None:
        for state, image in zip(states, images, strict=False):
            if image is not None:
                files.take(state, image)
