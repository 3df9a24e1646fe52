"""The verb ``check`` for a run's folder: crossings of triangles with each other and with obstacles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lyra_petsc.arrays import Ints
from lyra_petsc.contact.crossings import have_common_vertex
from lyra_petsc.contact.joined import crossings_beside_seams
from lyra_petsc.contact.overlaps import Overlaps, behind_wall, find_overlaps
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.mesh.obstacles import Container, Solid
from lyra_petsc.mesh.symmetry import Wall, symmetry_walls
from lyra_petsc.output.file_operations import on_every_rank
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.parallel import on_root
from lyra_petsc.show.obstacle_surfaces import run_obstacles

if TYPE_CHECKING:
    from mpi4py import MPI

NO_TIES: Ints = np.empty((0, 2), dtype=np.int64)


class StateCrossings(NamedTuple):
    """The crossings in one state.

    Attributes
    ----------
    pairs : (n, 2) int64
        Triangles without a common vertex, in lexicographic order and numbered as in the mesh file.
    corner_pairs : (m, 2) int64
        Triangles with one common vertex that cross elsewhere.
    overlaps : mapping of str to Overlaps
        Parts of sheets inside each obstacle, and behind each symmetry plane.
    """

    pairs: Ints
    corner_pairs: Ints
    overlaps: Mapping[str, Overlaps]


def run_walls(run: StoredRun) -> list[Wall]:
    """The symmetry planes that contact lets no sheet of a run pass.

    Raises
    ------
    InputError
        If files of the run are gone or damaged.
    """
    scene = run.scene
    if scene.contact is None or not any(handle.symmetry for handle in scene.handles):
        return []
    return symmetry_walls(scene, _mesh_of(run))


def _mesh_of(run: StoredRun) -> Mesh:
    """The mesh of a run, without rest angles."""
    stored, flat_rest = run.mesh, np.zeros(len(run.triangles), dtype=bool)
    start = run.positions[0] if stored.start is None else stored.start
    return Mesh(start, stored.rest, stored.triangles, stored.corner_uv, flat_rest, stored.groups)


def run_ties(run: StoredRun) -> Ints:
    """Pairs of vertices (n, 2) that the seams of a run hold together.

    Raises
    ------
    InputError
        If files of the run are gone or damaged.
    """
    if not run.scene.seams:
        return NO_TIES
    from lyra_petsc.mesh.seams import tied_pairs

    return tied_pairs(run.scene, _mesh_of(run))


def crossings_of(
    run: StoredRun,
    obstacles: Sequence[Solid | Container],
    state: int,
    walls: Sequence[Wall] = (),
    tied: Ints = NO_TIES,
) -> StateCrossings:
    """Crossings in a state of a run with these obstacles, symmetry planes and `run_ties`.

    Raises
    ------
    InputError
        If files of the run are gone or damaged.
    """
    x, time = run.positions[state], float(run.times[state])
    pairs = crossings_beside_seams(x, run.triangles, tied)
    at_corner = have_common_vertex(run.triangles, pairs)
    boxes = {name for name, block in (run.scene.obstacles or {}).items() if block.box is not None}
    overlaps = {
        one.name: find_overlaps(one, x, run.triangles, time, is_box=one.name in boxes) for one in obstacles
    }
    overlaps |= {wall.container.name: behind_wall(x, run.triangles, wall) for wall in walls}
    return StateCrossings(pairs[~at_corner], pairs[at_corner], overlaps)


MAX_NAMED = 3
"""Number of pairs of a state that are listed; together with obstacles twice as many."""

PAIRS = "{:>5} {:>11} {:>16} {:>17}  "
INSIDE = "{:>11} {:>8} {:>12}  "
"""Columns of the table; the second ones only if the scene has obstacles or symmetry planes as walls."""


def check_run(comm: MPI.Comm, folder: Path, *, crossings: bool = False) -> int:
    """Print the crossings in each state of a run on rank 0; collective. Each rank checks some of the states.

    Parameters
    ----------
    comm : MPI.Comm
    folder : Path
        Folder of the run, which may still be running.
    crossings : bool
        Whether crossings of sheets are a failure even if the scene has no self-contact.

    Returns
    -------
    int
        Exit code: 1 for crossings that contact should prevent, or with ``crossings`` for any.

    Raises
    ------
    InputError
        If the folder is not that of a run, or is damaged.
    """
    run = on_root(comm, lambda: StoredRun(folder))
    scene = on_root(comm, lambda: run.scene)
    obstacles = on_every_rank(comm, lambda: run_obstacles(run))
    walls = on_every_rank(comm, lambda: run_walls(run))
    tied = on_every_rank(comm, lambda: run_ties(run))
    row = PAIRS + (INSIDE if scene.obstacles or walls else "")
    time = "load factor" if scene.time.static else "time [s]"
    heads = ("no common vertex", "one common vertex", "vertices in", "edges in", "triangles in")
    _print(comm, f"{folder}: {len(run)} states; pairs of triangles that cross, with")
    _print(comm, row.format("state", time, *heads) + "first")
    rows = []
    for begin in range(0, len(run), comm.size):
        counted = on_every_rank(
            comm, partial(_count_in_state, run, obstacles, walls, tied, begin + comm.rank)
        )
        for state, one in enumerate(comm.allgather(counted), start=begin):
            if one is not None:
                rows.append(one[0])
                _print(comm, row.format(state, f"{run.times[state]:g}", *one[0]) + one[1])
    counts = np.array(rows)
    pairs, inside = counts[:, :2].sum(axis=1), counts[:, 2:].sum(axis=1)
    _print(comm, _summary("crossings", pairs, "pairs"))
    if scene.obstacles or walls:
        subject = "parts of sheets in obstacles" + (" or behind symmetry planes" if walls else "")
        _print(comm, _summary(subject, inside, "vertices, edges and triangles"))
    judged = crossings or (scene.contact is not None and scene.contact.self)
    if not judged:
        _print(comm, "the scene has no contact of sheets; --crossings makes a crossing exit code 1")
    return int(inside.any() or (judged and pairs.any()))


def _count_in_state(
    run: StoredRun, obstacles: Sequence[Solid | Container], walls: Sequence[Wall], tied: Ints, state: int
) -> tuple[list[int], str] | None:
    """Counts of a state for its row of the table, and the names to print; None beyond the last state."""
    if state >= len(run):
        return None
    crossings = crossings_of(run, obstacles, state, walls, tied)
    inside = [[len(part) for part in overlap] for overlap in crossings.overlaps.values()]
    in_all = np.sum(inside, axis=0, dtype=int).tolist() if inside else [0, 0, 0]
    pairs = np.concatenate([crossings.pairs[:MAX_NAMED], crossings.corner_pairs[:MAX_NAMED]])[:MAX_NAMED]
    names = [f"{one}-{other}" for one, other in pairs.tolist()]
    names += [
        _describe(name, overlap) for name, overlap in crossings.overlaps.items() if len(overlap.triangles)
    ]
    return [len(crossings.pairs), len(crossings.corner_pairs), *in_all], ", ".join(names[: 2 * MAX_NAMED])


def _describe(name: str, overlap: Overlaps) -> str:
    """Name of an obstacle, and the first vertex or triangle in it."""
    if len(overlap.vertices):
        return f"{name}: vertex {overlap.vertices[0]}"
    return f"{name}: triangle {overlap.triangles[0]}"


def _summary(subject: str, counts: Ints, unit: str) -> str:
    if not counts.any():
        return f"no {subject} in {len(counts)} states"
    worst = int(counts.argmax())
    affected = f"{subject} in {(counts > 0).sum()} of {len(counts)} states"
    return f"{affected}, most in state {worst}: {counts[worst]} {unit}"


def _print(comm: MPI.Comm, line: str) -> None:
    if comm.rank == 0:
        print(line.rstrip(), flush=True)
