"""Products of block rows in double and single precision, compared with dense products."""

from __future__ import annotations

import numpy as np
import pytest
from numba.core.errors import TypingError

from lyra_petsc.linear.block_product import multiply_half
from lyra_petsc.linear.block_rows import squared_norm_without

N, GHOSTS = 23, 4


def dense_rows() -> np.ndarray:
    """Rows (N, N + GHOSTS, 3, 3) of a symmetric matrix, a third of whose blocks are not zero."""
    rng = np.random.default_rng(1)
    rows = rng.standard_normal((N, N + GHOSTS, 3, 3)) * (rng.random((N, N + GHOSTS, 1, 1)) < 0.3)
    for row in range(N):
        rows[row:N, row] = rows[row, row:N].transpose(0, 2, 1)
        rows[row, row] += rows[row, row].T
    return rows


@pytest.mark.parametrize(("kind", "tolerance"), [(np.float64, 1e-13), (np.float32, 1e-5)])
def test_products_agree_with_dense_ones(kind: type, tolerance: float) -> None:
    rows = dense_rows()
    present = rows.any(axis=(2, 3)) & (np.arange(N + GHOSTS) >= np.arange(N)[:, None])
    np.fill_diagonal(present, True)
    rank = np.concatenate([[0], np.cumsum(present.sum(axis=1))])
    row, column = np.nonzero(present)
    blocks = np.ascontiguousarray(rows[row, column].transpose(0, 2, 1), dtype=kind).reshape(-1, 9)
    columns = column.astype(np.int32)
    x = np.random.default_rng(2).standard_normal((N + GHOSTS, 3)).astype(kind)
    out = np.full((N, 3), np.nan, dtype=kind)
    ends = rank[:-1] + present[:, :N].sum(axis=1)
    multiply_half(rank, ends, columns, blocks, x, np.full((N, 4), np.nan, dtype=kind), out)
    np.testing.assert_allclose(out, np.einsum("rcij,cj->ri", rows, x), rtol=tolerance, atol=20 * tolerance)


def test_products_do_not_read_the_next_block_or_row() -> None:
    blocks, out = np.full((3, 9), np.nan), np.empty((1, 3))
    blocks[1], x = 1.0, np.full((3, 3), np.nan)
    x[0] = 1.0
    columns = np.array([1, 0, 2], dtype=np.int32)
    multiply_half(np.array([1, 2]), np.array([2]), columns, blocks, x, np.full((1, 4), np.nan), out)
    assert out.tolist() == [[3.0, 3.0, 3.0]]


def test_arrays_of_other_types_are_refused() -> None:
    blocks, x, sums, out = np.ones((1, 9)), np.ones((1, 3)), np.empty((1, 4)), np.empty((1, 3))
    given = np.array([0, 1]), np.array([1]), np.array([0], dtype=np.int32)
    with pytest.raises(TypingError, match="contiguous arrays of two dimensions and one type"):
        multiply_half(*given, blocks, x.astype(np.float32), sums, out)
    with pytest.raises(TypingError, match="contiguous arrays"):
        multiply_half(*given, np.ones((3, 9))[::2], x, sums, out)


@pytest.mark.parametrize("left_out", [[], [0], [4], [0, 1, 3], [0, 1, 2, 3, 4]])
def test_norms_skip_left_out_entries_of_any_value(left_out: list[int]) -> None:
    vector = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    expected = float(np.sum(np.delete(vector, left_out) ** 2))
    vector[left_out] = 1e200
    assert squared_norm_without(vector, np.array(left_out, dtype=np.int64)) == expected
