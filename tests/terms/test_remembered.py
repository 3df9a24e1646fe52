"""Results for the same argument are computed once, unless something else has changed."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI
from numba import typeof
from physics import Simulation, grid

from lyra_petsc.contact.barrier import NO_PAIRS, ContactBarrier
from lyra_petsc.linear.block_rows import BlockRows
from lyra_petsc.terms.bending.midedge import NO_FRICTION
from lyra_petsc.terms.remembered import Remembered, unwritable


def test_a_function_is_called_again_for_other_arguments_only() -> None:
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


def test_kernels_are_compiled_for_remembered_arrays_only() -> None:
    """Placeholders (no active pairs, a sheet without friction) have the types of remembered arrays."""
    floor = {"floor": {"plane": {"point": [0, 0, -0.01], "normal": [0, 0, 1]}}}
    scene = {"mesh": grid(1, 1, 1, 1), "contact": {"gap": 0.02}, "obstacles": floor}
    with Simulation(scene, MPI.COMM_SELF) as simulation:
        simulation.step(1e-4)
        contact, system = simulation.problem.terms["contact"], simulation.system
        assert isinstance(contact, ContactBarrier)
        active = contact.active_pairs(system.x, system.active.frozen[contact].stage)
        assert len(active.pair)
    assert typeof(NO_PAIRS) == typeof(active)
    assert typeof(NO_FRICTION) == typeof(unwritable(np.zeros((1, 2)))[0])


def test_one_weight_has_the_type_of_many() -> None:
    """For one weight of all elements kernels get an array of the same type as for several."""
    given = []

    class Term:
        name, n_elements = "term", 1

        def add_hessian(
            self, x: object, frozen: object, blend: float, weight: np.ndarray, *_: object
        ) -> None:
            given.append(typeof(weight))

    rows = BlockRows(SimpleNamespace(offsets={}))
    for weight in (2.0, np.broadcast_to(np.ones(1), 1), np.broadcast_to(np.ones(1), 3)):
        rows.add_stiffness(Term(), None, None, 0.0, weight, None)
    assert given == 3 * [typeof(np.ones(1))]
