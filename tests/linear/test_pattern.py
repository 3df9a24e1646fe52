"""Half storage of block rows compared with dense sums; indices beyond 32 bits."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from oracle import expanded
from petsc4py import PETSc
from physics import Simulation, grid

from lyra_petsc.errors import InputError
from lyra_petsc.kernels.scatter import add_elements
from lyra_petsc.linear import pattern as block_pattern
from lyra_petsc.linear.block_rows import BlockRows
from lyra_petsc.linear.pattern import BlockPattern
from lyra_petsc.terms.term import OffDiagonal

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


def symmetric(blocks: np.ndarray) -> np.ndarray:
    """Element blocks (E, n, n, 3, 3) that are symmetric as matrices."""
    return blocks + blocks.transpose(0, 2, 1, 4, 3)


@pytest.mark.parametrize("largest", [block_pattern.LARGEST_INT32, 20])
def test_sums_of_element_blocks(monkeypatch: pytest.MonkeyPatch, largest: int) -> None:
    monkeypatch.setattr(block_pattern, "LARGEST_INT32", largest)
    rng = np.random.default_rng(1)
    stencils = {"three": random_stencil(rng, 8, 3), "four": random_stencil(rng, 5, 4)}
    pattern = BlockPattern(stencils, N_OWNED, N_LOCAL)
    assert pattern.offsets["four"].dtype == (np.int32 if largest > 20 else np.int64)
    rows = BlockRows(pattern)
    values = rows.zeros()
    expected = np.zeros((N_LOCAL, N_LOCAL, 3, 3))
    for name, stencil in stencils.items():
        blocks = symmetric(rng.random((*stencil.shape, stencil.shape[1], 3, 3)))
        weight = rng.random(len(stencil))
        expected += dense(stencil, weight[:, None, None, None, None] * blocks)
        add_elements(weight, blocks, pattern.offsets[name], values)
    found, n_couplings = np.zeros_like(expected), 0
    for row in range(N_OWNED):
        here = slice(pattern.indptr[row], pattern.indptr[row + 1])
        columns = pattern.columns[here]
        assert (np.diff(columns) > 0).all()
        coupled = set(np.flatnonzero(expected[row].any(axis=(1, 2)))) | {row}
        assert set(columns) == {column for column in coupled if column >= row}
        n_couplings += len(coupled)
        found[row, columns] = values[here].transpose(0, 2, 1)  # column by column
        found[columns, row] = values[here]
    np.testing.assert_allclose(found[:N_OWNED], expected[:N_OWNED])
    assert pattern.n_couplings == n_couplings

    x = rng.standard_normal((N_LOCAL, 3))
    product = np.einsum("rcij,cj->ri", expected[:N_OWNED], x)
    np.testing.assert_allclose(rows.product(values, x), product)

    rows.scale(values, 2.0, diagonal := rng.random(N_OWNED), sums := np.ones_like(values))
    of_diagonal = diagonal[:, None] * x[:N_OWNED]
    np.testing.assert_allclose(rows.product(sums, x), 2.0 * product + of_diagonal)
    rows.set_diagonal(diagonal, sums)
    np.testing.assert_array_equal(rows.product(sums, x), of_diagonal)


def test_products_of_rows_and_columns_beyond_32_bits() -> None:
    n = 70_000  # n² > 2³²
    stencil = np.array([[n - 1, n - 2], [0, n - 1]], dtype=np.int32)
    pattern = BlockPattern({"pair": OffDiagonal(stencil)}, n, n)
    assert pattern.n_blocks == n + 2
    assert pattern.n_couplings == n + 4
    assert pattern.columns[: pattern.indptr[1]].tolist() == [0, n - 1]
    assert pattern.columns[pattern.indptr[n - 2] :].tolist() == [n - 2, n - 1, n - 1]
    assert (pattern.offsets["pair"] % 2).tolist() == [0, 1]
    assert pattern.columns[pattern.offsets["pair"] // 2].tolist() == [n - 1, n - 1]


@pytest.mark.parametrize("largest", [block_pattern.LARGEST_INT32, 80])
def test_further_couplings_extend_a_pattern(monkeypatch: pytest.MonkeyPatch, largest: int) -> None:
    monkeypatch.setattr(block_pattern, "LARGEST_INT32", largest)
    rng = np.random.default_rng(5)
    fixed, more = random_stencil(rng, 8, 3), random_stencil(rng, 5, 2)
    more[0] = N_LOCAL + 1, 2  # with a ghost that is new
    small = BlockPattern({"fixed": fixed}, N_OWNED, N_LOCAL)
    needed = small.missing([more], N_LOCAL + 2)
    made, place = small.extended(needed, N_LOCAL + 2)
    assert not len(made.missing([more], N_LOCAL + 2))
    made.locate({"more": more})
    once = BlockPattern({"fixed": fixed, "more": more}, N_OWNED, N_LOCAL + 2)
    np.testing.assert_array_equal(made.columns, once.columns)
    np.testing.assert_array_equal(made.indptr, once.indptr)
    for name in ("fixed", "more"):
        np.testing.assert_array_equal(made.offsets[name], once.offsets[name])
        assert made.offsets[name].dtype == once.offsets[name].dtype
    made.locate({"more": np.array([[0, N_LOCAL]], dtype=np.int32)})
    assert made.offsets["more"][0, 1] == block_pattern.MISSING
    # and blocks of the small one are found again
    values = np.zeros((made.n_blocks, 3, 3))
    values[place] = before = rng.random((small.n_blocks, 3, 3))
    wide = expanded(made, values, N_LOCAL + 2)
    np.testing.assert_array_equal(wide[:, :, :N_LOCAL], expanded(small, before, N_LOCAL))
    assert not wide[:, :, N_LOCAL:].any()


@pytest.mark.parallel
@pytest.mark.parametrize(("largest", "remedy"), [(100, "64-bit indices"), (400, "more ranks")])
def test_sizes_beyond_petscs_integers_are_refused(
    comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch, largest: int, remedy: str
) -> None:
    class Small:
        max = largest

    monkeypatch.setattr(
        np, "iinfo", lambda kind, real=np.iinfo: Small if kind is PETSc.IntType else real(kind)
    )
    with pytest.raises(InputError, match=remedy), Simulation({"mesh": grid(1, 1, 7, 7)}, comm):
        pass
