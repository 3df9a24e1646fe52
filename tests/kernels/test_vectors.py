"""SIMD operations on 3×3 blocks agree with those in plain numba."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import plain_vectors
import pytest
from numba import njit

from lyra_petsc.kernels import vectors

N = 40


@cache
def calls(module: Any) -> Any:
    """A compiled function that calls every operation of the module on separate arrays."""
    gather, scatter, add_outers = module.gather, module.scatter, module.add_outers
    add_six, add_triangle = module.add_six, module.add_triangle
    store_block, fetch = module.store_block, module.fetch

    @njit
    def products(blocks, columns, x, gathered, scattered, stored):  # type: ignore[no-untyped-def]
        for row in range(gathered.shape[0]):
            lo, hi = 3 * row, 3 * row + 3
            a, b, c = gather(blocks, columns, x, lo, hi, 8)
            gathered[row, 0], gathered[row, 1], gathered[row, 2] = a, b, c
            scatter(blocks, columns, scattered, lo, hi, (x[row, 0], x[row, 1], x[row, 2]))
            fetch(blocks, row + 8)
            store_block(blocks, row, stored, 4 * row)
            store_block(blocks, row, stored, 4 * row + 3)

    @njit
    def sums(offsets, rows, outer, six, triangle):  # type: ignore[no-untyped-def]
        for e in range(offsets.shape[0]):
            r = rows[e]
            n, a, b = (r[0], r[1], r[2]), (r[3], r[4], r[5]), (r[6], r[7], r[8])
            add_outers(outer, offsets[e, 0], r[9], ((n, a), (b, n)))
            pair, mixed = (a, b), (((r[9], a), (r[10], n)), ((r[11], b),))
            add_six(six, offsets, e, n, (pair, mixed, pair, mixed, pair, mixed))
            own, between = (r[1], r[2], r[2], r[3], r[4]), (r[5], r[6], r[7], r[8], r[9])
            add_triangle(triangle, offsets, e, (a, b), (own, between, own))

    return products, sums


@pytest.mark.parametrize(("kind", "index"), [(np.float32, np.int32), (np.float64, np.int64)])
def test_products_agree_with_plain_numba(kind: type, index: type) -> None:
    random = np.random.default_rng(3)
    blocks = np.append(random.normal(size=(3 * N, 9)), np.zeros((1, 9)), axis=0).astype(kind)
    x = random.normal(size=(N + 1, 3)).astype(kind)
    columns = random.integers(0, N, 3 * N).astype(index)

    def results(module: Any) -> list[np.ndarray]:
        out = [np.zeros((rows, width), dtype=kind) for rows, width in ((N, 3), (N, 4), (2 * N, 9))]
        calls(module)[0](blocks, columns, x, *out)
        return [out[0], out[1][:, :3], out[2]]

    for ours, plain in zip(results(vectors), results(plain_vectors), strict=True):
        np.testing.assert_allclose(ours, plain, rtol=0, atol=20 * np.finfo(kind).eps)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_products_with_edges_agree_with_plain_numba(kind: type) -> None:
    random = np.random.default_rng(5)
    blocks = random.normal(size=(3 * N, 12)).astype(kind)
    x, indices = random.normal(size=(N, 3)).astype(kind), random.integers(0, 3 * N, (3 * N, 4))
    indices[::5, 3] = indices[::5, 2]  # an edge may be there twice
    indices = indices.astype(np.int32)

    def results(module: Any) -> list[np.ndarray]:
        gather_edges, scatter_edges = module.gather_edges, module.scatter_edges

        @njit
        def products(blocks, indices, x, gathered, scattered):  # type: ignore[no-untyped-def]
            for row in range(gathered.shape[0]):
                lo, hi = 3 * row, 3 * row + row % 4
                a, b, c = gather_edges(blocks, indices, x, lo, hi, 8)
                gathered[row, 0], gathered[row, 1], gathered[row, 2] = a, b, c
                scatter_edges(blocks, indices, scattered, lo, hi, (x[row, 0], x[row, 1], x[row, 2]))

        out = [np.zeros((N, 3), dtype=kind) for _ in range(2)]
        products(blocks, indices, x, *out)
        return out

    for ours, plain in zip(results(vectors), results(plain_vectors), strict=True):
        np.testing.assert_allclose(ours, plain, rtol=0, atol=40 * np.finfo(kind).eps)


@pytest.mark.parametrize("index", [np.int32, np.int64])
def test_sums_agree_with_plain_numba(index: type) -> None:
    random = np.random.default_rng(4)
    offsets = random.integers(0, 2 * N, (N, 6)).astype(index)
    some = offsets[::2]  # of these elements, the row of the first point is another rank's
    some[:, 0] = -1
    some[:, 1:][random.random((len(some), 5)) < 0.3] = -1
    rows = random.normal(size=(N, 12))

    def results(module: Any) -> list[np.ndarray]:
        out = [np.ones((N, 3, 3)) for _ in range(3)]
        calls(module)[1](offsets, rows, *out)
        return out

    for ours, plain in zip(results(vectors), results(plain_vectors), strict=True):
        np.testing.assert_allclose(ours, plain, rtol=0, atol=1e-12)
