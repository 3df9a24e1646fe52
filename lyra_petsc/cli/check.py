"""The verb ``check`` for a scene: prints what a run would do, without running it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from rich.console import Console
from rich.table import Table

from lyra_petsc.arrays import Ints
from lyra_petsc.cli.marked_places import places_shown
from lyra_petsc.cli.run import read_scene, say
from lyra_petsc.mesh.gmsh_sandbox import describe_sandbox, supported_layers
from lyra_petsc.mesh.topology import connected_pieces
from lyra_petsc.output.recorder import Recorder
from lyra_petsc.phases import Phases
from lyra_petsc.scene.load import default_scene
from lyra_petsc.scene.schema import Contact, Friction, Handle, Obstacle, Scene, coefficients
from lyra_petsc.scene.time_curve import curves
from lyra_petsc.scene.values import one_line
from lyra_petsc.stepping.problem import Problem
from lyra_petsc.stepping.simulation import SteppedScene
from lyra_petsc.terms.protocols import WritesTable
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.units_check import figures

if TYPE_CHECKING:
    from lyra_petsc.mesh.frame_motion import FrameMotion

LISTED_RANKS = 16
"""Number of ranks up to which all are listed; of more only the extremes are."""


def check(comm: MPI.Comm, path: Path | None, settings: Sequence[str], *, trust_mesh: bool = False) -> None:
    """Validate a scene, set it up as a run would, and print the plan on rank 0; collective.

    Raises
    ------
    InputError
        As ``run`` would.
    """
    path = path or default_scene()
    scene = read_scene(comm, path, settings, trust_mesh=trust_mesh)
    with places_shown(comm):
        simulation = SteppedScene(comm, scene, Phases(report=say))
    Recorder(simulation)
    problem = simulation.problem
    points, pattern = problem.points, problem.pattern
    mine = np.array(
        [
            points.n_owned,
            points.n_local - points.n_owned,
            pattern.n_couplings,
            sum(term.n_elements for term in problem.terms.values()),
            points.n_vertices,
            points.n_edges,
        ]
    )
    every, tables = comm.gather(mine, root=0), _tables(problem)
    if every is not None:
        _print(simulation, path, np.array(every), tables)
    simulation.destroy()


def _tables(problem: Problem) -> list[tuple[str, str]]:
    """Rows of the plan about what terms write into tables, at the start; collective."""
    rows, here = [], problem.equations.here()
    for term in problem.terms.values():
        if not isinstance(term, WritesTable):
            continue
        for name, *values in term.table_rows(here.x, here.frozen[term]):
            named = zip(term.table_columns[1:], values, term.table_units[1:], strict=True)
            text = ", ".join(f"{column} {value:.6g} {unit}".strip() for column, value, unit in named)
            rows.append((one_line(str(name)), text))
    return rows


def _print(simulation: SteppedScene, path: Path, ranks: Ints, tables: list[tuple[str, str]]) -> None:
    problem, scene, control = simulation.problem, simulation.scene, simulation.control
    whole = problem.whole
    blocks = int(ranks[:, 2].sum())
    time = scene.time
    if time.static:
        plan_of_steps = f"load factor to {control.end:g}, first increment {control.step:g}; a state at each"
    else:
        steps, every = control.planned_steps(), scene.output.every
        states = 1 + (steps if every is None else math.ceil(control.end / every - 1e-9))
        cut = "at most " if steps > math.ceil(control.end / control.step - 1e-9) else ""
        first = (
            f"the first {simulation.max_steps} (-ts_max_steps) of " if simulation.max_steps < steps else ""
        )
        plan_of_steps = f"{first}{steps} of {cut}{control.step:g} s to t = {control.end:g} s, {states} states"
        plan_of_steps += "; steps end at states and events" if cut else ""
        if time.adaptive:
            written = "a state at each" if every is None else f"{states} states"
            plan_of_steps = (
                f"adaptive to t = {control.end:g} s, {control.smallest:g} to {control.step:g} s, "
                f"tolerance {time.tolerance:g}; {written}"
            )
    width = None if Console().is_terminal else 100
    # without markup, as titles and paths may contain brackets
    console = Console(width=width, highlight=False, soft_wrap=True, markup=False, emoji=False)
    plan = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, value in (
        ("scene", one_line(f"{path}" + (f" ({scene.title})" if scene.title else ""))),
        ("mesh", f"{whole.n_vertices} vertices, {whole.n_triangles} triangles{_pieces(problem)}"),
        ("mean edge", f"{whole.spacing:.4g} m"),
        *_sizes(simulation),
        ("active terms", ", ".join(whole.terms)),
        ("handles", str(len(scene.handles))),
        *_handle_frames(scene),
        *_curves(scene),
        *_creases(simulation),
        *_contact(scene, whole.barrier.gap if whole.barrier else 0.0),
        *tables,
        ("unknowns", f"{problem.points.n_unknowns} (velocities)"),
        (
            "nonzeros",
            f"{9 * blocks} in {blocks} blocks of 3 x 3, {blocks / ranks[:, 0].sum():.1f} blocks a row",
        ),
        ("memory", f"about {_megabytes(ranks):.0f} MB on the fullest rank, beside Python and PETSc"),
        ("integrator", time.scheme),
        ("steps", plan_of_steps),
        ("linear solver", f"{simulation.stepper.preset}: {_solver_options(simulation)}"),
        ("partitioner", problem.partitioner),
        *_sandbox(scene),
    ):
        plan.add_row(name, value)
    console.print(plan)
    console.print(_rank_table(ranks))
    owned = ranks[:, 4]
    console.print(f"load imbalance {owned.max() / owned.mean():.3f} (most owned vertices over mean)")
    for note in simulation.notes:
        console.print(f"note: {note}")


def _pieces(problem: Problem) -> str:
    """Number of pieces of the mesh, if there are several."""
    assert problem.mesh is not None
    pieces = connected_pieces(problem.mesh.triangles).max() + 1
    return f", {pieces} pieces" if pieces > 1 else ""


def _sizes(simulation: SteppedScene) -> list[tuple[str, str]]:
    """Rows of the plan by which wrong units are seen."""
    mesh, scene = simulation.problem.mesh, simulation.scene
    assert mesh is not None
    rest = RestShape(scene, mesh)
    extent = " x ".join(f"{length:.4g}" for length in np.ptp(mesh.positions, axis=0))
    rows = [("size", f"{extent} m"), ("mass", f"{rest.mass.sum():.4g} kg")]
    names = [f"material {block.group}" if block.group else "material" for block in scene.material]
    return [
        *rows,
        *((one_line(name), str(figure)) for name, figure in zip(names, figures(rest), strict=True)),
    ]


def _curves(scene: Scene) -> list[tuple[str, str]]:
    """Rows of the plan about values that change in time, or with the load factor."""
    return [
        (one_line(key), f"{curve}; steps end at its {len(curve.kinks)} kinks")
        for key, curve in curves(scene).items()
    ]


def _creases(simulation: SteppedScene) -> list[tuple[str, str]]:
    """Rows of the plan about creases."""
    mesh, scene = simulation.problem.mesh, simulation.scene
    if not scene.creases:
        return []
    from lyra_petsc.terms import creases  # imported only where it is needed

    assert mesh is not None
    return [(one_line(name), text) for name, text in creases.plan(RestShape(scene, mesh))]


def _sandbox(scene: Scene) -> list[tuple[str, str]]:
    """Row of the plan about gmsh's sandbox; only for scenes with gmsh scripts."""
    if not scene.has_scripts:
        return []
    return [("gmsh's sandbox", describe_sandbox(supported_layers(), trusted=scene.trusts_meshes))]


def _contact(scene: Scene, gap: float) -> list[tuple[str, str]]:
    """Rows of the plan about contact with a ``gap`` [m], and obstacles; none without contact."""
    contact = scene.contact
    if contact is None:
        return []
    by = "" if contact.gap else " by the mesh"
    parts = [
        f"gap {gap:.4g} m{by}",
        f"thickness {contact.thickness:g} m",
        f"friction {_friction(contact.friction)}",
    ]
    parts += [] if contact.self else ["with obstacles alone"]
    parts += ["a start that crosses is untangled"] if contact.untangle else []
    return [("contact", ", ".join(parts)), *_obstacles(scene, contact)]


def _obstacles(scene: Scene, contact: Contact) -> list[tuple[str, str]]:
    rows = []
    for name, obstacle in (scene.obstacles or {}).items():
        friction = contact.friction if obstacle.friction is None else obstacle.friction
        parts = [f"inside of a {obstacle.shape}" if obstacle.inside else obstacle.shape]
        if obstacle.motion is not None:
            parts.append(f"moves by {obstacle.motion!r}" if isinstance(obstacle.motion, str) else "moves")
        if obstacle.mesh is not None and obstacle.mesh.frames is not None:
            from lyra_petsc.mesh.obstacles import surface_motion  # with frames only

            parts += _frames(surface_motion(obstacle), obstacle, scene)
        rows.append((one_line(f"obstacle {name}"), ", ".join([*parts, f"friction {_friction(friction)}"])))
    return rows


def _handle_frames(scene: Scene) -> list[tuple[str, str]]:
    """Rows of the plan about handles that move through frames."""
    rows = []
    for number, handle in enumerate(scene.handles):
        if handle.frames is not None:
            from lyra_petsc.mesh.frame_motion import handle_frames  # with frames only

            name = f"handle {number}" + (f" {handle.group}" if handle.group else "")
            rows.append((one_line(name), ", ".join(_frames(handle_frames(handle), handle, scene))))
    return rows


def _frames(motion: FrameMotion, mover: Handle | Obstacle, scene: Scene) -> list[str]:
    """What frames do with a handle or an obstacle."""
    times, step = motion.frames.times, scene.time.step
    parts = [f"{len(times)} frames from {times[0]:g} to {times[-1]:g} s, {mover.interpolation}"]
    parts += ["repeated"] if motion.repeats else []
    if isinstance(step, float) and step > motion.interval:
        parts.append(f"steps of {step:g} s pass over {step / motion.interval:.3g} frames each")
    return parts


def _friction(friction: float | Friction) -> str:
    static, kinetic = coefficients(friction)
    return f"{static:g}" if static == kinetic else f"{static:g} (sliding {kinetic:g})"


def _rank_table(ranks: Ints) -> Table:
    """Table of the ranks' parts of the mesh; a ghost row is one vertex or three edges."""
    edges = ["owned edges"] if ranks[:, 5].any() else []
    heads = ["rank", "owned vertices", *edges, "ghosts", "ghost share", "blocks", "elements"]
    table = Table(*heads, box=None, header_style="")
    shown = list(enumerate(ranks))
    if len(shown) > LISTED_RANKS:
        order = np.argsort(ranks[:, 4])
        shown = [(int(rank), ranks[rank]) for rank in (*order[:2], *order[-2:])]
    for rank, (owned, ghosts, blocks, elements, n_vertices, n_edges) in shown:
        counts = [n_vertices, n_edges] if edges else [n_vertices]
        share = f"{ghosts / max(owned + ghosts, 1):.1%}"
        table.add_row(*map(str, (rank, *counts, ghosts, share, blocks, elements)))
    return table


def _megabytes(ranks: Ints) -> float:
    """Estimated memory [MB] of the fullest rank: matrix, preconditioner, assembly buffers, element data."""
    return float((ranks[:, 2] * 9 * 8 * 4 + ranks[:, 3] * 350 + ranks[:, :2].sum(axis=1) * 400).max() / 1e6)


def _solver_options(simulation: SteppedScene) -> str:
    stepper = simulation.stepper
    options = PETSc.Options()
    named = [f"-{name} {options.getString(name, '')}" for name in stepper.our_options]
    ksp = stepper.solver.ksp
    return " ".join(named) or f"-ksp_type {ksp.getType()} -pc_type {ksp.getPC().getType()}"
