"""Contact on ranks that have next to nothing, or nothing, of the sheets."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import Simulation, grid

pytestmark = pytest.mark.parallel

SQUARE = grid(0.1, 0.1, 1, 1)
"""Two triangles, four vertices."""


def falling(above: float) -> dict[str, Any]:
    return {
        "mesh": [
            SQUARE | {"transform": {"translate": [0, 0, 0.02]}},
            SQUARE | {"transform": {"translate": [0.01, 0.02, 0.02 + above]}},
        ],
        "gravity": [0, 0, -9.81],
        "contact": {"gap": 0.01},
        "obstacles": {
            "floor": {"plane": {"point": [0, 0, 0], "normal": [0, 0, 1]}},
            "ball": {"sphere": {"center": [0.05, 0.05, -0.03], "radius": 0.04}},
        },
        "time": {"end": 1.0, "step": 0.004},
    }


def test_small_sheets_on_any_number_of_ranks(comm: MPI.Comm) -> None:
    ways = []
    for ranks in (MPI.COMM_SELF, comm):
        with Simulation(falling(0.02), ranks) as simulation:
            ways.append(simulation.run(0.004, 20))
            assert simulation.energy("contact") > 0.0
    heights = ways[0][:, 2]
    assert heights.min() > 0.0
    assert heights[4:].max() - heights[:4].max() < 0.015  # the upper one has come near the lower one
    np.testing.assert_allclose(ways[1], ways[0], atol=1e-10)
