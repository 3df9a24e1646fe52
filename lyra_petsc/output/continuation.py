"""Continuing a run from a checkpoint: restoring the simulation, and what the scene has changed since."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.output.checkpoint import Checkpoint, TermArrays
from lyra_petsc.output.file_operations import reason
from lyra_petsc.output.hdf5 import read_slab
from lyra_petsc.output.mesh_file import frame_changes
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.stored import open_stored, read_stored
from lyra_petsc.output.xdmf import group_name
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.block import Block
from lyra_petsc.scene.dump import Change, obstacle_motions, scene_changes
from lyra_petsc.scene.load import load_scene
from lyra_petsc.stepping import term_states
from lyra_petsc.stepping.simulation import SteppedScene
from lyra_petsc.terms.handles.motion import Motion


def used_groups(content: object, key: str = "") -> set[str]:
    """Names of the mesh's groups that a scene, or a part of it, uses: values of ``group`` and ``between``."""
    if isinstance(content, str):
        return {content} if key in ("group", "between") else set()
    parts: Iterable[tuple[str, object]] = ()
    if isinstance(content, Block):
        parts = content
    elif isinstance(content, Mapping):
        parts = (("", part) for part in content.values())
    elif isinstance(content, Sequence):
        parts = ((key, part) for part in content)
    return set().union(*(used_groups(part, name) for name, part in parts))


def term_arrays(simulation: SteppedScene) -> TermArrays:
    """The arrays of the scene's terms in checkpoints; collective."""
    layout, stateful = simulation.problem.points, simulation.problem.equations.active.stateful
    elements = {name: rows.shape[1] for name, rows in term_states.element_arrays(stateful, layout).items()}
    vertices, edges = term_states.vertex_arrays(stateful), term_states.edge_arrays(stateful, layout)
    return TermArrays(vertices.keys(), edges.keys(), elements)


def checkpoint_of(simulation: SteppedScene) -> Checkpoint:
    """What a checkpoint holds of the present state, in views of its arrays; collective."""
    equations, layout = simulation.problem.equations, simulation.problem.points
    n, (saved, scalars) = layout.n_owned, simulation.saved_state()
    stateful = equations.active.stateful
    rows = {"position": equations.x[:n], "velocity": equations.v[:n], **saved}
    for number, start in enumerate(sorted(equations.reference.late)):
        rows[f"start_{number}"] = equations.reference.late[start]
    arrays = {name: layout.split(values)[0] for name, values in rows.items()}
    arrays |= term_states.vertex_arrays(stateful)
    edges: dict[str, NDArray[Any]] = {}
    if layout.n_edges_global:
        edges = {name: layout.split(values)[1] for name, values in rows.items()}
        edges |= term_states.edge_arrays(stateful, layout)
    elements = term_states.element_arrays(stateful, layout)
    return Checkpoint(arrays, scalars, Path(), edges=edges, elements=elements)


def restore(simulation: SteppedScene, checkpoint: Checkpoint, vertices: FileOrder) -> None:
    """Restore a simulation from a checkpoint; collective.

    Raises
    ------
    InputError
        On every rank, if the scene cannot continue from the checkpoint, or another program has written it.
    """
    try:
        before, now = checkpoint.scalars["scheme"], simulation.scene.time.scheme
        if "static" in (now, before) and now != before:
            raise InputError(
                "a motion does not go on as a static analysis, nor the other way round: run without --resume",
                file=checkpoint.file,
                key="time.analysis",
            )
        take(simulation, checkpoint, vertices)
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(
            f"does not hold what this program writes ({reason(error)}): run without --resume",
            file=checkpoint.file,
        ) from error
    on_root(vertices.comm, lambda: _refuse_crossings(simulation, checkpoint.file))


def take(simulation: SteppedScene, checkpoint: Checkpoint, vertices: FileOrder) -> None:
    """Take the state of a checkpoint whose contents are known to be right; collective."""
    scalars = checkpoint.scalars
    equations, layout = simulation.problem.equations, simulation.problem.points
    arrays = {
        name: layout.join(values, checkpoint.edges.get(name)) for name, values in checkpoint.arrays.items()
    }
    for number, start in enumerate(scalars["late_starts"]):
        equations.reference.restore(float(start), arrays[f"start_{number}"])
    equations.state.set(arrays["position"], arrays["velocity"])
    own = layout.start + np.arange(layout.n_vertices)

    values: dict[str, dict[str, Array]] = {}
    for key, rows in checkpoint.elements.items():
        term, name = key.split(".")
        values.setdefault(term, {})[name] = rows
    elements = {}
    for term, of_term in values.items():
        numbers = of_term.pop(term_states.VERTICES).astype(np.int64)
        corners = vertices.look_up(own, numbers.ravel()).reshape(numbers.shape)
        elements[term] = term_states.ElementState(corners, of_term)
    simulation.resume(arrays, scalars, checkpoint.edges, elements)


def _refuse_crossings(simulation: SteppedScene, checkpoint: Path) -> None:
    """Refuse a scene that is changed so that sheets cross each other or obstacles now (rank 0)."""
    if simulation.scene.contact is None:
        return
    with open_stored(checkpoint) as file:
        refuse_crossing_positions(simulation, file["vertices/position"][()])


def refuse_crossing_positions(simulation: SteppedScene, positions: Array) -> None:
    """Refuse positions (V, 3) [m] at which sheets cross each other or obstacles at the present time (rank 0).

    Raises
    ------
    InputError
    """
    from lyra_petsc.contact.start_crossings import PlacedScene, find_start_crossings  # with kernels
    from lyra_petsc.mesh.obstacles import build_obstacles

    scene, mesh = simulation.scene, simulation.problem.mesh
    if mesh is not None:
        obstacles = build_obstacles(scene, mesh.obstacles, Motion)
        placed = PlacedScene(scene, mesh, positions, obstacles, simulation.time)
        find_start_crossings(placed).refuse(f"at {simulation.time_text()}")


def first_positions(folder: Path, order: FileOrder, *, otherwise: Array) -> Array:
    """Positions [m] of this rank's vertices in state 0, or ``otherwise`` if state 0 cannot be read."""
    file, name = folder / "states-0000.h5", f"{group_name(0)}/position"

    def readable() -> bool:
        with suppress(InputError):
            read_stored(file, name, (order.n_global, 3), kinds="f")
            return True
        return False

    if not on_root(order.comm, readable):
        return otherwise
    return order.from_slab(read_slab(file, name, order))


def note_changes(simulation: SteppedScene, before: Path) -> tuple[list[Change], dict[str, Any]]:
    """Add notes for the user on the keys in which the scene differs from that of the file ``before``.

    Collective.

    Returns
    -------
    changes : list of Change
    earlier_motions : dict of str to dict
        By name, how the run moved obstacles until now, if it does so otherwise from now on.
    """
    scene, notes, comm = simulation.scene, simulation.notes, simulation.problem.points.comm
    earlier_motions: dict[str, Any] = {}
    try:
        changes = on_root(comm, lambda: scene_changes(before, scene))
    except InputError as error:
        notes.append(f"{error}; what has changed since the run was begun is not known")
        return [], {}
    if any(change.key.startswith(("obstacles", "motions")) for change in changes):
        with suppress(InputError):  # what is no scene is compared as text only
            earlier = on_root(comm, lambda: obstacle_motions(load_scene(before, meshes_needed=False)))
            names, now = scene.obstacles or {}, obstacle_motions(scene)
            earlier_motions = {n: one for n, one in earlier.items() if n in names and one != now.get(n)}
    frames = on_root(comm, lambda: frame_changes(before.parent, simulation.problem.mesh))
    notes += [f"changed since the run was begun: {text}" for text in frames]
    for change in changes:
        if change.key == "time.end":
            notes.append(str(change))
            continue
        restart = " (begins without memory of earlier steps)" if change.key == "time.integrator" else ""
        notes.append(f"changed since the run was begun: {change}{restart}")
    return changes, earlier_motions
