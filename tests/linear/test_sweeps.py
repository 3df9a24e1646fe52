"""Gauss-Seidel sweeps over half-stored symmetric rows solve triangular systems, in single precision."""

from __future__ import annotations

import numpy as np

from lyra_petsc.linear import gauss_seidel as sweeps
from lyra_petsc.linear.pattern import BlockPattern

N, GHOSTS = 40, 6


def system() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Stored rows (indptr, columns, blocks (n, 3, 3)), and the full matrix (3 N, 3 (N + GHOSTS))."""
    rng = np.random.default_rng(4)
    indptr, columns, blocks = [0], [], []
    dense = np.zeros((3 * N, 3 * (N + GHOSTS)))
    for row in range(N):
        others = np.flatnonzero(rng.random(N + GHOSTS) < 0.15)
        for column in [row, *others[others > row]]:
            block = rng.standard_normal((3, 3))
            if column == row:
                block = block @ block.T + 20.0 * np.eye(3)
            columns.append(column)
            blocks.append(block.T)  # column by column
            dense[3 * row : 3 * row + 3, 3 * column : 3 * column + 3] = block
            if column < N:
                dense[3 * column : 3 * column + 3, 3 * row : 3 * row + 3] = block.T
        indptr.append(len(columns))
    return np.array(indptr), np.array(columns, dtype=np.int32), np.array(blocks), dense


def triangle(whole: np.ndarray, upper: bool) -> np.ndarray:
    """Upper or lower triangle of the owned part, with its diagonal blocks."""
    out = np.zeros((3 * N, 3 * N))
    for i in range(N):
        for j in range(N):
            if (j >= i) if upper else (j <= i):
                out[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] = whole[3 * i : 3 * i + 3, 3 * j : 3 * j + 3]
    return out


def test_a_sweep_before_and_after_the_coarse_level() -> None:
    indptr, columns, blocks, dense = system()
    ends = indptr[1:] - np.add.reduceat(columns >= N, indptr[:-1])
    owned, beyond = dense[:, : 3 * N], dense[:, 3 * N :]
    single = blocks.reshape(-1, 9).astype(np.float32)
    inverse = np.empty((N, 9), dtype=np.float32)
    sweeps.invert_diagonal(indptr, blocks.reshape(-1, 9), inverse)
    exact = np.linalg.inv(blocks[indptr[:-1]]).reshape(-1, 9)
    np.testing.assert_allclose(inverse, exact, rtol=1e-5, atol=1e-7)

    rng = np.random.default_rng(5)
    b = rng.standard_normal((N, 3)).astype(np.float32)
    x = np.zeros((N + GHOSTS, 3), dtype=np.float32)
    x[N:] = 7.0
    r = np.column_stack([b, b[:, 0]])
    sweeps.backward(indptr, ends, columns, single, inverse, x, r)
    first = np.linalg.solve(triangle(dense, upper=True), b.ravel())
    np.testing.assert_allclose(x[:N].ravel(), first, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(r[:, :3].ravel(), b.ravel() - owned @ first, rtol=1e-4, atol=1e-5)
    assert (x[N:] == 7.0).all()

    x[N:] = rng.standard_normal((GHOSTS, 3))
    sweeps.subtract_ghosts(np.flatnonzero(ends < indptr[1:]), indptr, ends, columns, single, x, r)
    whole = np.concatenate([first, x[N:].ravel()])
    np.testing.assert_allclose(r[:, :3].ravel(), b.ravel() - dense @ whole, rtol=1e-4, atol=1e-5)

    x[:] = rng.standard_normal(x.shape)
    before = x.astype(float)
    residual = b.ravel() - owned @ before[:N].ravel() - beyond @ before[N:].ravel()
    sweeps.forward(indptr, ends, columns, single, inverse, b, x, r)
    step = np.linalg.solve(triangle(dense, upper=False), residual)
    np.testing.assert_allclose(x[:N].ravel(), before[:N].ravel() + step, rtol=1e-4, atol=1e-5)
    assert np.array_equal(x[N:], before[N:].astype(np.float32))

    # and again from there
    before = x.astype(float)
    residual = b.ravel() - dense @ before.ravel()
    sweeps.subtract_ghosts(np.flatnonzero(ends < indptr[1:]), indptr, ends, columns, single, x, r)
    sweeps.backward(indptr, ends, columns, single, inverse, x, r)
    step = np.linalg.solve(triangle(dense, upper=True), residual)
    np.testing.assert_allclose(x[:N].ravel(), before[:N].ravel() + step, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(r[:, :3].ravel(), residual - owned @ step, rtol=1e-4, atol=1e-5)


def test_couplings_to_other_ranks_are_bounded() -> None:
    indptr, columns, blocks, _ = system()
    values, edge = blocks.reshape(-1, 9), np.arange(N)
    ends = indptr[1:] - np.add.reduceat(columns >= N, indptr[:-1])
    roots = np.zeros((N + GHOSTS, 6), dtype=np.float32)
    sweeps.invert_roots(edge, values[indptr[:-1]], roots)
    lower = np.zeros((N + GHOSTS, 3, 3))
    lower[(slice(None), *np.tril_indices(3))] = roots
    expected = np.linalg.inv(np.linalg.cholesky(blocks[indptr[:-1]]))
    np.testing.assert_allclose(lower[:N], expected, rtol=1e-5, atol=1e-7)

    lower[N:] = np.tril(np.random.default_rng(7).standard_normal((GHOSTS, 3, 3)))
    roots[N:] = lower[N:][(slice(None), *np.tril_indices(3))]
    sums = np.empty(N)
    sweeps.relative_couplings(edge, indptr, ends, columns, values, roots, sums)
    for row in range(N):
        couplings = range(ends[row], indptr[row + 1])
        norms = [np.linalg.norm(lower[columns[k]] @ blocks[k] @ lower[row].T, 2) for k in couplings]
        assert sum(norms) - 1e-6 <= sums[row] <= 3.0**0.25 * sum(norms) + 1e-6


def test_inverse_roots_of_directions_without_stiffness_are_zero() -> None:
    values, roots = np.diag([4.0, 0.0, -1.0]).reshape(1, 9), np.ones((1, 6), dtype=np.float32)
    sweeps.invert_roots(np.array([0]), values, roots)
    assert roots.ravel().tolist() == [0.5, 0.0, 0.0, 0.0, 0.0, 0.0]


def test_singular_diagonal_blocks_are_inverted_as_far_as_possible() -> None:
    values = np.zeros((2, 9))
    values[0, [0, 4, 1, 3]] = 4.0  # of rank one
    inverse = np.empty((2, 9), dtype=np.float32)
    sweeps.invert_diagonal(np.array([0, 1, 2]), values, inverse)
    assert inverse[0].tolist() == [0.25, 0, 0, 0, 0.25, 0, 0, 0, 0]
    assert not inverse[1].any()


def test_restriction_is_the_transpose_of_interpolation() -> None:
    rng = np.random.default_rng(6)
    start = np.array([0, 2, 3, 3, 5])
    parents, weights = np.array([0, 1, 1, 0, 2], dtype=np.int32), rng.random(5).astype(np.float32)
    free = np.ones((4, 3), dtype=np.float32)
    free[1, 2] = free[3, 0] = 0.0
    coarse, fine = rng.random((3, 3)).astype(np.float32), rng.random((4, 3)).astype(np.float32)
    up, down = np.zeros((4, 3), dtype=np.float32), np.full((3, 3), 7.0, dtype=np.float32)
    sweeps.add_interpolated(start, parents, weights, free, coarse, up)
    sweeps.restrict(start, parents, weights, free, fine, down)
    assert abs(np.vdot(up, fine) - np.vdot(coarse, down)) < 1e-5
    assert up[1, 2] == up[3, 0] == 0.0
    assert up[3, 1] != 0.0


def test_several_sweeps_before_the_coarse_level() -> None:
    indptr, columns, blocks, dense = system()
    couplings = [(row, k) for row in range(N) for k in range(indptr[row], indptr[row + 1])]
    keys = np.array([row * (N + GHOSTS) + columns[k] for row, k in couplings])
    sweep = sweeps.BlockSweeps(BlockPattern.of_keys(keys, N, N + GHOSTS))
    sweep.invert(blocks.reshape(-1, 9))
    sweep.store(blocks.reshape(-1, 9))
    b = np.random.default_rng(6).standard_normal((N, 3)).astype(np.float32)
    x = np.zeros((N + GHOSTS, 3), dtype=np.float32)
    sweep.begin(b)
    sweep.backward(x)
    sweep.backward_again(x, 1)
    owned, upper = dense[:, : 3 * N], triangle(dense, upper=True)
    expected = np.linalg.solve(upper, b.ravel())
    expected += np.linalg.solve(upper, b.ravel() - owned @ expected)
    np.testing.assert_allclose(x[:N].ravel(), expected, rtol=1e-4, atol=1e-5)
    residual = b.ravel() - owned @ expected
    np.testing.assert_allclose(sweep.r[:, :3].ravel(), residual, rtol=1e-4, atol=1e-5)
