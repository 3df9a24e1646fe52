"""Crossings in the stored states of a run: of triangles with each other, and of sheets with obstacles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.mesh.crossings import have_common_vertex, self_crossings
from lyra_petsc.mesh.start_crossings import Overlaps, overlaps_of
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.output.run_obstacles import run_obstacles

Ints = NDArray[np.int64]


class StateCrossings(NamedTuple):
    """The crossings in one state.

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
    """Finds the crossings in the states of a run, one state in memory at a time.

    Parameters
    ----------
    run : StoredRun

    Raises
    ------
    InputError
        Here and by `of`, if files of the run are gone or damaged.
    """

    def __init__(self, run: StoredRun) -> None:
        self._run, self._obstacles = run, run_obstacles(run)
        self._boxes = {name for name, each in (run.scene.obstacles or {}).items() if each.box is not None}

    def of(self, state: int) -> StateCrossings:
        """The crossings in a state."""
        run, x, time = self._run, self._run.positions[state], float(self._run.times[state])
        pairs = self_crossings(x, run.triangles)
        at_corner = have_common_vertex(run.triangles, pairs)
        overlaps = {
            one.name: overlaps_of(one, x, run.triangles, time, is_box=one.name in self._boxes)
            for one in self._obstacles
        }
        return StateCrossings(pairs[~at_corner], pairs[at_corner], overlaps)
