"""``lyra_petsc.kernels.vectors`` in plain numba: the same functions, to compare numbers and times."""

from __future__ import annotations

from typing import Any

from numba import njit, types
from numba.extending import overload

AHEAD = 64

plain: Any = njit(inline="always")


def _total(given):  # type: ignore[no-untyped-def]
    """Three numbers, or the sum of pairs of a factor and three numbers."""


@overload(_total)  # type: ignore[untyped-decorator]
def _total_overload(given):  # type: ignore[no-untyped-def]
    if not isinstance(given[0], types.BaseTuple):
        return lambda given: given

    def of_pairs(given):  # type: ignore[no-untyped-def]
        a = b = c = 0.0
        for factor, of in given:
            a, b, c = a + factor * of[0], b + factor * of[1], c + factor * of[2]
        return a, b, c

    return of_pairs


@njit
def gather(blocks, columns, x, lo, hi, ahead):  # type: ignore[no-untyped-def]
    a = b = c = blocks.dtype.type(0.0)
    for k in range(lo, hi):
        x0, x1, x2 = x[columns[k], 0], x[columns[k], 1], x[columns[k], 2]
        a += blocks[k, 0] * x0 + blocks[k, 3] * x1 + blocks[k, 6] * x2
        b += blocks[k, 1] * x0 + blocks[k, 4] * x1 + blocks[k, 7] * x2
        c += blocks[k, 2] * x0 + blocks[k, 5] * x1 + blocks[k, 8] * x2
    return a, b, c


@plain
def scatter(blocks, columns, out, lo, hi, factors):  # type: ignore[no-untyped-def]
    f0, f1, f2 = factors
    for k in range(lo, hi):
        for i in range(3):
            out[columns[k], i] += (
                blocks[k, 3 * i] * f0 + blocks[k, 3 * i + 1] * f1 + blocks[k, 3 * i + 2] * f2
            )


@njit
def gather_edges(blocks, indices, x, lo, hi, ahead):  # type: ignore[no-untyped-def]
    flat = x.reshape(-1)
    a = b = c = blocks.dtype.type(0.0)
    for k in range(lo, hi):
        for i in range(4):
            factor = flat[indices[k, i]]
            a += blocks[k, i] * factor
            b += blocks[k, 4 + i] * factor
            c += blocks[k, 8 + i] * factor
    return a, b, c


@plain
def scatter_edges(blocks, indices, out, lo, hi, factors):  # type: ignore[no-untyped-def]
    flat = out.reshape(-1)
    f0, f1, f2 = factors
    for k in range(lo, hi):
        for i in range(4):
            flat[indices[k, i]] += blocks[k, i] * f0 + blocks[k, 4 + i] * f1 + blocks[k, 8 + i] * f2


@plain
def add_outers(blocks, at, diagonal, pairs):  # type: ignore[no-untyped-def]
    flat = blocks.reshape(-1, 9)
    if at >= 0:
        k = at >> 1
        for i in range(3):
            for left, right in pairs:
                for j in range(3):
                    if at & 1:
                        flat[k, 3 * i + j] += right[i] * left[j]
                    else:
                        flat[k, 3 * i + j] += left[i] * right[j]
            flat[k, 4 * i] += diagonal


@njit
def _add_pair(flat, at, n, right, left):  # type: ignore[no-untyped-def]
    if at >= 0:
        k = at >> 1
        if at & 1:
            right, left = left, right
        for i in range(3):
            for j in range(3):
                flat[k, 3 * i + j] += n[i] * right[j] + left[i] * n[j]


@njit
def add_six(blocks, offsets, e, n, six):  # type: ignore[no-untyped-def]
    flat = blocks.reshape(-1, 9)
    _add_pair(flat, offsets[e, 0], n, _total(six[0][0]), _total(six[0][1]))
    _add_pair(flat, offsets[e, 1], n, _total(six[1][0]), _total(six[1][1]))
    _add_pair(flat, offsets[e, 2], n, _total(six[2][0]), _total(six[2][1]))
    _add_pair(flat, offsets[e, 3], n, _total(six[3][0]), _total(six[3][1]))
    _add_pair(flat, offsets[e, 4], n, _total(six[4][0]), _total(six[4][1]))
    _add_pair(flat, offsets[e, 5], n, _total(six[5][0]), _total(six[5][1]))


@njit
def add_triangle(blocks, offsets, e, f, three):  # type: ignore[no-untyped-def]
    flat = blocks.reshape(-1, 9)
    u, v = _total(f[0]), _total(f[1])
    for i in range(3):
        for j in range(3):
            of = [0.0, 0.0, 0.0, 0.0]  # (1, 1), (1, 2), (2, 1), (2, 2)
            for b in range(3):
                uu, uv, vu, vv, g = three[b]
                here = 1.0 if i == j else 0.0
                of[b + (b == 2)] = uu * u[i] * u[j] + uv * u[i] * v[j] + vu * v[i] * u[j] + vv * v[i] * v[j]
                of[b + (b == 2)] += g * here
                if b == 1:
                    of[2] = uu * u[j] * u[i] + uv * u[j] * v[i] + vu * v[j] * u[i] + vv * v[j] * v[i]
                    of[2] += g * here
            b11, b12, b21, b22 = of
            made = (
                b11 + b12 + b21 + b22,
                -(b11 + (b12 if offsets[e, 1] & 1 else b21)),
                -(b22 + (b21 if offsets[e, 2] & 1 else b12)),
                b11,
                b21 if offsets[e, 4] & 1 else b12,
                b22,
            )
            for pair in range(6):
                if offsets[e, pair] >= 0:
                    flat[offsets[e, pair] >> 1, 3 * i + j] += made[pair]


@plain
def store_block(blocks, k, out, at):  # type: ignore[no-untyped-def]
    for i in range(3):
        for j in range(3):
            out[at >> 1, 3 * i + j] = blocks[k, 3 * j + i if at & 1 else 3 * i + j]


@plain
def fetch(blocks, k):  # type: ignore[no-untyped-def]
    pass
