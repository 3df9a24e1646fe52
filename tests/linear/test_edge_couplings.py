"""Edge unknowns stored as single values behind the blocks: products and constraints."""

from __future__ import annotations

import numpy as np
from oracle import expanded

from lyra_petsc.kernels.scatter import add_mixed_elements
from lyra_petsc.linear.block_rows import BlockRows
from lyra_petsc.linear.edge_couplings import ProductWithEdges
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
