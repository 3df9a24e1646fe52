"""Edge unknowns stored as single values behind the blocks: products, sweeps and constraints."""

from __future__ import annotations

import numpy as np
from oracle import expanded

from lyra_petsc.kernels.scatter import add_mixed_elements
from lyra_petsc.linear.block_rows import BlockRows
from lyra_petsc.linear.edge_couplings import EdgeCouplings, ProductWithEdges
from lyra_petsc.linear.edge_sweeps import SweepsWithEdges, memory_sizes
from lyra_petsc.linear.gauss_seidel import store
from lyra_petsc.linear.pattern import BlockPattern
from lyra_petsc.terms.term import MixedStencil

N_VERTICES, N_OWNED, N_LOCAL = 20, 32, 38
"""Rows 20 to 31 and 35 to 37 hold three edges each, all others a vertex."""

RNG = np.random.default_rng(11)


def mixed_rows(*, definite: bool = False) -> tuple[BlockPattern, np.ndarray, np.ndarray]:
    """Pattern and values of elements of three vertices and three edges, and the dense matrix."""
    vertex_rows = np.concatenate([np.arange(N_VERTICES), np.arange(N_OWNED, N_OWNED + 3)])
    edge_rows = np.concatenate([np.arange(N_VERTICES, N_OWNED), np.arange(N_OWNED + 3, N_LOCAL)])
    places = (3 * edge_rows[:, None] + np.arange(3)).ravel()
    places = places[places != 3 * N_OWNED - 1]  # this one is padding
    vertices = np.array([RNG.choice(vertex_rows, 3, replace=False) for _ in range(40)], dtype=np.int32)
    edges = np.array([RNG.choice(places, 3, replace=False) for _ in range(40)], dtype=np.int64)
    pair = RNG.choice(vertex_rows, (8, 2)).astype(np.int32)
    coupling = MixedStencil(vertices, edges)
    pattern = BlockPattern({"corners": vertices, "mixed": coupling, "pair": pair}, N_OWNED, N_LOCAL)
    half = RNG.normal(size=(40, 12, 12))
    blocks = half @ half.transpose(0, 2, 1) if definite else half + half.transpose(0, 2, 1)
    values = np.zeros((pattern.n_stored, 3, 3))
    add_mixed_elements(np.ones(40), blocks, 3, pattern.offsets["corners"], pattern.offsets["mixed"], values)
    BlockRows(pattern).add_diagonal(np.full(N_OWNED, 2.0), values)
    dense = expanded(pattern, values, N_LOCAL).reshape(3 * N_OWNED, 3 * N_LOCAL)
    return pattern, values, dense


def couplings_of(pattern: BlockPattern) -> EdgeCouplings:
    found = pattern.edge_couplings
    assert found is not None
    return found


def test_rows_without_edges_have_none() -> None:
    assert BlockPattern({"pair": np.array([[0, 1]], np.int32)}, 2, 2).edge_couplings is None


def test_products_agree_with_dense_ones() -> None:
    pattern, values, dense = mixed_rows()
    x, out = RNG.normal(size=(N_LOCAL, 3)), np.full((N_OWNED, 3), np.nan)
    product = ProductWithEdges(pattern, values)
    for factor in (1.0, 2.0):
        product(x, out)
        np.testing.assert_allclose(out.ravel(), factor * (dense @ x.ravel()), rtol=1e-12, atol=1e-12)
        values *= 2.0


def test_sums_and_multiples_agree_with_dense_ones() -> None:
    pattern, values, dense = mixed_rows()
    rows, diagonal = BlockRows(pattern), RNG.normal(size=N_OWNED)
    more = np.zeros_like(dense)
    np.fill_diagonal(more, np.repeat(diagonal, 3))

    def check(found: np.ndarray, expected: np.ndarray) -> None:
        whole = expanded(pattern, found, N_LOCAL).reshape(dense.shape)
        np.testing.assert_allclose(whole, expected, rtol=1e-13, atol=1e-13)

    rows.scale(values, 3.0, diagonal, sums := rows.zeros())
    check(sums, 3.0 * dense + more)
    rows.set_diagonal(diagonal, sums)
    check(sums, more)
    rows.add_blocks(values, np.arange(pattern.n_blocks), sums)
    check(sums, dense + more)
    # among couplings of vertices that were absent
    pair = np.array([[0, 19], [3, N_LOCAL]], dtype=np.int32)
    extended, place = pattern.extended(pattern.missing([pair], N_LOCAL + 1), N_LOCAL + 1)
    BlockRows(extended).add_blocks(values, place, sums := BlockRows(extended).zeros())
    wide = expanded(extended, sums, N_LOCAL + 1)
    np.testing.assert_array_equal(wide[:, :, :N_LOCAL].reshape(dense.shape), dense)


def test_prescribed_unknowns_are_decoupled() -> None:
    pattern, values, dense = mixed_rows(definite=True)
    rows, mask = BlockRows(pattern), np.zeros((N_LOCAL, 3), dtype=bool)
    mask[[2, 5, N_VERTICES + 3, N_OWNED + 1, N_LOCAL - 1], [0, 1, 2, 0, 1]] = mask[[7, N_OWNED - 1]] = True
    held, before, constrained = mask.ravel(), values.copy(), rows.constrained_entries(mask)
    rows.constrain(values, mask, constrained)
    found = expanded(pattern, values, N_LOCAL).reshape(dense.shape)
    free = ~held[: 3 * N_OWNED, None] & ~held[None, :]
    np.testing.assert_array_equal(found[free], dense[free])
    own = np.diag(found)[held[: 3 * N_OWNED]]
    assert own.min() > 0.0
    assert np.count_nonzero(found[~free]) == len(own)
    # nothing else has changed
    flat, old = values.ravel(), before.ravel()
    assert set(np.flatnonzero(flat != old)) <= set(constrained.changed)


def test_enlarged_diagonals() -> None:
    pattern, values, dense = mixed_rows(definite=True)
    BlockRows(pattern).scale_diagonal(values, 1.5)
    found = np.diag(expanded(pattern, values, N_LOCAL).reshape(dense.shape)) / np.diag(dense)
    np.testing.assert_allclose(found, 1.5)


def test_zeros_of_blocks_are_left_out() -> None:
    pattern, _, _ = mixed_rows()
    couplings = couplings_of(pattern)
    assert couplings.n_vertices == N_VERTICES
    assert pattern.n_stored < 0.8 * pattern.whole.n_blocks
    assert 9 * pattern.n_couplings < 0.8 * 9 * pattern.whole.n_couplings


def parts(dense: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the owned part what is on and above the diagonal: blocks of vertices, numbers of edges."""
    owned = dense[:, : 3 * N_OWNED]
    step = np.arange(3 * N_OWNED)
    step[: 3 * N_VERTICES] -= step[: 3 * N_VERTICES] % 3
    upper = owned * (step[None, :] >= step[:, None])
    return owned, upper


def sweeps_of(pattern: BlockPattern, values: np.ndarray) -> SweepsWithEdges:
    """Of block rows that are, as in a run, where the copy will be, in memory that something else had."""
    memory = np.full(max(sum(memory_sizes(pattern)), values.size), np.nan)
    rows = memory[: values.size].reshape(-1, 9)
    rows[:] = values.reshape(-1, 9)
    sweeps = SweepsWithEdges(pattern, couplings_of(pattern), memory)
    sweeps.invert(rows)
    sweeps.store(rows)
    return sweeps


def test_rows_are_copied_in_place() -> None:
    _, values, _ = mixed_rows()
    memory = values.reshape(-1, 9).copy()
    copy = memory.reshape(-1).view(np.float32)[: values.size].reshape(-1, 9)
    store(memory, 0.0, copy)
    np.testing.assert_array_equal(copy, values.reshape(-1, 9).astype(np.float32))


def test_a_sweep_before_and_after_the_coarse_level() -> None:
    pattern, values, dense = mixed_rows(definite=True)
    owned, upper = parts(dense)
    sweeps = sweeps_of(pattern, values)

    def residual() -> np.ndarray:
        return np.concatenate([sweeps.r[:N_VERTICES, :3], sweeps.of_edges[N_VERTICES:N_OWNED]]).ravel()

    b = RNG.normal(size=(N_LOCAL, 3)).astype(np.float32)
    right = b[:N_OWNED].astype(float).ravel()
    x = np.zeros((N_LOCAL, 3), dtype=np.float32)
    sweeps.begin(b)
    sweeps.backward(x)
    first = np.linalg.solve(upper, right)
    np.testing.assert_allclose(x[:N_OWNED].ravel(), first, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(residual(), right - owned @ first, rtol=1e-4, atol=1e-4)

    x[N_OWNED:] = RNG.normal(size=(N_LOCAL - N_OWNED, 3))
    sweeps.subtract_ghosts(x)
    np.testing.assert_allclose(residual(), right - dense @ x.astype(float).ravel(), rtol=1e-4, atol=1e-4)

    x[:] = RNG.normal(size=x.shape)
    before, left = x.astype(float), sweeps.of_edges[N_VERTICES:N_OWNED]
    diagonal = np.diag(dense)[3 * N_VERTICES : 3 * N_OWNED].reshape(-1, 3)
    sweeps.correct(x)
    before[N_VERTICES:N_OWNED] += np.divide(
        left, diagonal, out=np.zeros_like(diagonal), where=diagonal != 0.0
    )
    np.testing.assert_allclose(x, before, rtol=1e-4, atol=1e-5)

    before = x.astype(float).ravel()
    sweeps.forward(b, x)
    step = np.linalg.solve(upper.T, right - dense @ before)
    np.testing.assert_allclose(x[:N_OWNED].ravel(), before[: 3 * N_OWNED] + step, rtol=1e-4, atol=1e-4)

    # and again from there
    before = x.astype(float).ravel()
    sweeps.subtract_ghosts(x)
    sweeps.backward(x)
    step = np.linalg.solve(upper, right - dense @ before)
    np.testing.assert_allclose(x[:N_OWNED].ravel(), before[: 3 * N_OWNED] + step, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(residual(), right - dense @ before - owned @ step, rtol=1e-4, atol=1e-3)


def test_more_sweeps_over_the_vertices() -> None:
    pattern, values, dense = mixed_rows(definite=True)
    owned, upper = parts(dense)
    n = 3 * N_VERTICES
    sweeps = sweeps_of(pattern, values)
    b = RNG.normal(size=(N_LOCAL, 3)).astype(np.float32)
    right, x = b[:N_OWNED].astype(float).ravel(), np.zeros((N_LOCAL, 3), dtype=np.float32)
    sweeps.begin(b)
    sweeps.backward(x)
    expected = x[:N_OWNED].astype(float).ravel()
    expected[:n] += np.linalg.solve(upper[:n, :n], (right - owned @ expected)[:n])
    sweeps.backward_again(x, 1)

    def check() -> None:
        np.testing.assert_allclose(x[:N_OWNED].ravel(), expected, rtol=1e-4, atol=1e-5)
        residual = np.concatenate([sweeps.r[:N_VERTICES, :3], sweeps.of_edges[N_VERTICES:N_OWNED]])
        np.testing.assert_allclose(residual.ravel(), right - owned @ expected, rtol=1e-4, atol=1e-4)

    check()
    expected += np.linalg.solve(upper, right - owned @ expected)
    sweeps.backward_again(x, 2)
    check()

    x[:] = RNG.normal(size=x.shape)
    expected = x.astype(float).ravel()
    expected[:n] += np.linalg.solve(upper[:n, :n].T, (right - dense @ expected)[:n])
    sweeps.forward(b, x, 1)
    np.testing.assert_allclose(x.ravel(), expected, rtol=1e-4, atol=1e-4)


def test_sweeps_invert_the_diagonal_of_edges() -> None:
    pattern, values, dense = mixed_rows(definite=True)
    sweeps = SweepsWithEdges(pattern, couplings_of(pattern))
    rows = np.array([1, N_VERTICES + 1])
    vertex, edges = sweeps.diagonal(values.reshape(-1, 9), rows).reshape(2, 3, 3)
    np.testing.assert_array_equal(vertex, values[pattern.indptr[1]])
    first = 3 * (N_VERTICES + 1)
    np.testing.assert_array_equal(edges, np.diag(np.diag(dense)[first : first + 3]))


def test_enlarged_diagonals_and_added_values_are_stored_in_the_right_rows() -> None:
    pattern, values, _ = mixed_rows(definite=True)
    sweeps = sweeps_of(pattern, values)
    b = np.zeros((N_LOCAL, 3), dtype=np.float32)
    last = N_OWNED - 1  # nothing but ghosts comes after it
    b[last] = 1.0
    found = []
    for factor in (1.0, 4.0):
        sweeps.shrink(np.array([0, last]), np.full((2, 1), factor))
        x = np.zeros_like(b)
        sweeps.begin(b)
        sweeps.backward(x)
        found.append(x[last, 2])
    assert abs(found[1] - found[0] / 4.0) < 1e-6 * abs(found[0])
    sweeps.begin(b)
    sweeps.add(np.array([0, last]), np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], dtype=np.float32))
    assert sweeps.r[0, :3].tolist() == [1.0, 2.0, 3.0]
    assert sweeps.of_edges[last].tolist() == [5.0, 6.0, 7.0]


def test_a_rank_with_a_single_owned_vertex() -> None:
    """All its other rows are ghosts."""
    coupling = MixedStencil(np.array([[0, 2, 3]], np.int32), np.array([[12, 13, 14]], np.int64))
    pattern = BlockPattern({"mixed": coupling}, 1, 5)
    values = RNG.normal(size=(pattern.n_stored, 3, 3))
    x, out = RNG.normal(size=(5, 3)), np.empty((1, 3))
    assert couplings_of(pattern).n_vertices == 1
    ProductWithEdges(pattern, values)(x, out)
    expected = sum(values[k].T @ x[column] for k, column in enumerate(pattern.columns))
    np.testing.assert_allclose(out[0], expected, rtol=1e-13)


def test_negligible_entries_are_dropped() -> None:
    pattern, values, _ = mixed_rows(definite=True)
    rows = BlockRows(pattern)
    x = RNG.normal(size=(N_LOCAL, 3)).astype(np.float32)
    found = []
    for part in (0.0, 1e-14):
        rows.set_diagonal(np.ones(N_OWNED), sums := rows.zeros())
        sums += part * values
        sweeps = sweeps_of(pattern, sums)
        sweeps.begin(x)
        sweeps.backward(y := np.zeros_like(x))
        found.append(y)
    np.testing.assert_array_equal(*found)
