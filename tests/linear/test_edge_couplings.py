"""Edge unknowns stored as single values behind the blocks: products, sweeps and constraints."""

from __future__ import annotations

import numpy as np
from oracle import expanded

from lyra_petsc.kernels.scatter import add_mixed_elements
from lyra_petsc.linear.block_rows import BlockRows
from lyra_petsc.linear.edge_couplings import EdgeCouplings, ProductWithEdges
from lyra_petsc.linear.edge_sweeps import SweepsWithEdges, memory_sizes
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


def test_products_agree_with_dense_ones() -> None:
    pattern, values, dense = mixed_rows()
    x, out = RNG.normal(size=(N_LOCAL, 3)), np.full((N_OWNED, 3), np.nan)
    product = ProductWithEdges(pattern, values)
    for factor in (1.0, 2.0):
        product(x, out)
        np.testing.assert_allclose(out.ravel(), factor * (dense @ x.ravel()), rtol=1e-12, atol=1e-12)
        values *= 2.0


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
