"""Rows, columns and offsets of the block pattern against dense sums; indices that pass 32 bits."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from physics import Simulation, grid

from lyra_petsc.assembly import pattern as room
from lyra_petsc.assembly.blocks import BlockRows
from lyra_petsc.assembly.pattern import BlockPattern
from lyra_petsc.errors import InputError

N_OWNED, N_LOCAL = 9, 14


def random_stencil(rng: np.random.Generator, count: int, width: int) -> np.ndarray:
    return np.array([rng.permutation(N_LOCAL)[:width] for _ in range(count)], dtype=np.int32)


def dense(stencil: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """Sum (n_local, n_local, 3, 3) of element blocks."""
    total = np.zeros((N_LOCAL, N_LOCAL, 3, 3))
    for vertices, block in zip(stencil, blocks, strict=True):
        for a, row in enumerate(vertices):
            for b, column in enumerate(vertices):
                total[row, column] += block[a, b]
    return total


@pytest.mark.parametrize("largest", [room.LARGEST_INT32, 20])
def test_sums_of_element_blocks(monkeypatch: pytest.MonkeyPatch, largest: int) -> None:
    monkeypatch.setattr(room, "LARGEST_INT32", largest)
    rng = np.random.default_rng(1)
    stencils = {"three": random_stencil(rng, 8, 3), "four": random_stencil(rng, 5, 4)}
    numbers = 1000 + rng.permutation(N_LOCAL).astype(np.int64)
    pattern = BlockPattern(stencils, N_OWNED, N_LOCAL, numbers)
    assert pattern.offsets["four"].dtype == (np.int32 if largest > 20 else np.int64)
    rows = BlockRows(pattern)
    values = rows.zeros()
    expected = np.zeros((N_LOCAL, N_LOCAL, 3, 3))
    for name, stencil in stencils.items():
        blocks = rng.random((*stencil.shape, stencil.shape[1], 3, 3))
        expected += dense(stencil, blocks)
        rows.add(name, lambda lo, hi, out, b=blocks: np.copyto(out, b[lo:hi]), 1.0, values)
    found = np.zeros_like(expected)
    for row in range(N_OWNED):
        here = slice(pattern.indptr[row], pattern.indptr[row + 1])
        columns = pattern.columns[here]
        assert (np.diff(numbers[columns]) > 0).all()
        assert columns[pattern.diagonal[row] - here.start] == row
        assert set(columns) == {row} | set(np.flatnonzero(expected[row].any(axis=(1, 2))))
        found[row, columns] = values[here]
    np.testing.assert_allclose(found[:N_OWNED], expected[:N_OWNED])


def test_rows_times_columns_pass_32_bits() -> None:
    n = 70_000  # n² > 2³²
    stencil = np.array([[n - 1, n - 2], [0, n - 1]], dtype=np.int32)
    pattern = BlockPattern({"pair": stencil}, n, n, np.arange(n, dtype=np.int64))
    assert pattern.n_blocks == n + 4
    assert pattern.columns[pattern.indptr[n - 1] :].tolist() == [0, n - 2, n - 1]
    assert pattern.columns[pattern.offsets["pair"][1]].tolist() == [[0, n - 1], [0, n - 1]]


def test_no_elements_leave_the_diagonal() -> None:
    pattern = BlockPattern({"none": np.empty((0, 3), np.int32)}, 2, 3, np.arange(3, dtype=np.int64))
    assert pattern.columns.tolist() == [0, 1]
    assert BlockPattern({}, 0, 0, np.empty(0, np.int64)).n_blocks == 0


@pytest.mark.parallel
@pytest.mark.parametrize(("largest", "remedy"), [(100, "64-bit indices"), (400, "more ranks")])
def test_more_than_petsc_can_count(
    comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch, largest: int, remedy: str
) -> None:
    class Small:
        max = largest

    monkeypatch.setattr(
        np, "iinfo", lambda kind, real=np.iinfo: Small if kind is PETSc.IntType else real(kind)
    )
    with pytest.raises(InputError, match=remedy), Simulation({"mesh": grid(1, 1, 7, 7)}, comm):
        pass
