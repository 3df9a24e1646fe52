"""What is asked for twice at one place is computed once, unless something else has changed."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, Simulation, grid

from lyra_petsc.terms.remembered import Remembered


def test_a_function_is_called_where_it_was_not_called_last() -> None:
    calls = []

    def double(x: np.ndarray) -> np.ndarray:
        calls.append(x.copy())
        return 2.0 * x

    remembered = Remembered(double)
    at = np.arange(3.0)
    first = remembered(at)
    np.testing.assert_array_equal(first, [0.0, 2.0, 4.0])
    assert remembered(at.copy()) is first
    assert len(calls) == 1
    with pytest.raises(ValueError, match="read-only"):
        first[0] = 1.0
    at[0] = 5.0  # the very array that it was asked at
    assert remembered(at)[0] == 10.0
    remembered.forget()
    remembered(at)
    assert len(calls) == 3


def test_forces_of_moving_clamps_are_always_computed() -> None:
    scene = {"mesh": grid(1, 1, 3, 3), "material": CLOTH | {"bending": 0.1}}
    clamp = {"handles": [{"group": "left", "clamp": True}]}
    with Simulation(scene, MPI.COMM_SELF) as simulation:
        assert isinstance(simulation.system._internal, Remembered)
    with Simulation(scene | clamp, MPI.COMM_SELF) as simulation:
        assert not isinstance(simulation.system._internal, Remembered)
