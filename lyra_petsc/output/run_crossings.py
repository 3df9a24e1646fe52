"""What crosses in the states that a run has written: triangles each other, and sheets the obstacles."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.mesh.crossings import have_common_vertex, mutual_crossings, self_crossings
from lyra_petsc.mesh.obstacles import Container, Solid
from lyra_petsc.mesh.overlaps import Overlaps, beyond_planes, in_ball, in_box, out_of_ball
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.output.run_obstacles import run_obstacles

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

Overlap = Callable[[Array, float], Overlaps]
"""What of a sheet at some positions (V, 3) [m] is in an obstacle at a time [s]."""


class StateCrossings(NamedTuple):
    """What crosses in one state.

    Attributes
    ----------
    pairs : (n, 2) int64
        Triangles without a common vertex, in lexicographic order and numbered as in the mesh file.
    corner_pairs : (m, 2) int64
        Triangles with one common vertex that cross elsewhere.
    overlaps : mapping of str to Overlaps
        What is in each obstacle.
    """

    pairs: Ints
    corner_pairs: Ints
    overlaps: Mapping[str, Overlaps]


class RunCrossings:
    """Looks at the states of a run, of which one at a time is in memory.

    Parameters
    ----------
    run : StoredRun

    Raises
    ------
    InputError
        Here and by `of`, if files of the run are gone or damaged.
    """

    def __init__(self, run: StoredRun) -> None:
        self._run = run
        boxes = {name for name, each in (run.scene.obstacles or {}).items() if each.box is not None}
        self._overlaps = {
            one.name: inside(one, run.triangles, is_box=one.name in boxes) for one in run_obstacles(run)
        }

    def of(self, state: int) -> StateCrossings:
        """What crosses in a state."""
        run, x, time = self._run, self._run.positions[state], float(self._run.times[state])
        pairs = self_crossings(x, run.triangles)
        at_corner = have_common_vertex(run.triangles, pairs)
        overlaps = {name: overlap(x, time) for name, overlap in self._overlaps.items()}
        return StateCrossings(pairs[~at_corner], pairs[at_corner], overlaps)


def inside(obstacle: Solid | Container, triangles: Ints, *, is_box: bool) -> Overlap:
    """The function that finds what of a sheet with some triangles is in an obstacle."""

    def overlap(x: Array, time: float) -> Overlaps:
        points = obstacle.positions(time)
        if isinstance(obstacle, Container):
            if obstacle.kind == "planes":
                return beyond_planes(x, triangles, points, obstacle.normals_at(time))
            return out_of_ball(x, triangles, points, obstacle.radius)
        if obstacle.radius > 0.0:
            return in_ball(x, triangles, points, obstacle.radius)
        if is_box:
            return in_box(x, triangles, points)
        crossed = mutual_crossings(x, triangles, points, obstacle.triangles)[:, 0]
        return Overlaps(np.empty(0, np.int64), np.empty((0, 2), np.int64), np.unique(crossed))

    return overlap
