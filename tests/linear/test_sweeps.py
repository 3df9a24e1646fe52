"""Gauss-Seidel sweeps over half-stored symmetric rows solve triangular systems, in single precision."""

from __future__ import annotations

import numpy as np

from lyra_petsc.linear import gauss_seidel as sweeps

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


def test_singular_diagonal_blocks_are_inverted_as_far_as_possible() -> None:
    values = np.zeros((2, 9))
    values[0, [0, 4, 1, 3]] = 4.0  # of rank one
    inverse = np.empty((2, 9), dtype=np.float32)
    sweeps.invert_diagonal(np.array([0, 1, 2]), values, inverse)
    assert inverse[0].tolist() == [0.25, 0, 0, 0, 0.25, 0, 0, 0, 0]
    assert not inverse[1].any()
