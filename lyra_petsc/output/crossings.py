"""Triangles that cross in the states that a run has written."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.mesh.crossings import have_common_vertex, self_crossings
from lyra_petsc.output.read_run import StoredRun

Ints = NDArray[np.int64]


class StateCrossings(NamedTuple):
    """What crosses in one state.

    Attributes
    ----------
    pairs : (n, 2) int64
        Triangles without a common vertex, in lexicographic order and numbered as in the mesh file.
    corner_pairs : (m, 2) int64
        Triangles with one common vertex that cross elsewhere.
    """

    pairs: Ints
    corner_pairs: Ints


def state_crossings(run: StoredRun, state: int) -> StateCrossings:
    """The triangles that cross in a state of a run; holds one state in memory.

    Raises
    ------
    InputError
        If the files are gone or damaged.
    """
    pairs = self_crossings(run.positions[state], run.triangles)
    at_corner = have_common_vertex(run.triangles, pairs)
    return StateCrossings(pairs[~at_corner], pairs[at_corner])
