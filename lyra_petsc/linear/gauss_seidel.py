"""Gauss-Seidel on symmetric block rows of which one half is stored; each sweep reads the matrix once.

A = L + D + Lᵀ with the stored upper half Lᵀ. A sweep gathers with Lᵀ and, as soon as an unknown is known,
scatters with it, so that neither the other half nor the residual needs a second pass. Between ranks the
sweeps are block Jacobi: ghosts keep their values. Single precision halves the memory traffic, which limits
the speed of a sweep, and suffices for a preconditioner. Indices are unsigned, as numba checks the sign
of signed ones. Tiny numbers are set to zero to avoid subnormal products (below 1.2e-38), which take a hundred
times longer; they occur as round-off in the out-of-plane couplings of a flat sheet.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.cache import Index, cached
from lyra_petsc.kernels.vectors import AHEAD, gather, scatter

if TYPE_CHECKING:
    from lyra_petsc.linear.pattern import BlockPattern

Floats = NDArray[np.float32]

TINY = np.float32(1e-20)
"""Velocities [m/s] below it are set to zero."""

NEGLIGIBLE = 1e-12
"""Entries below this fraction of the smallest diagonal entry are set to zero."""


@cached(inline="always")
def flushed(value):  # type: ignore[no-untyped-def]
    return value if abs(value) > TINY else np.float32(0.0)


@cached()
def negligible_size(indptr, values):  # type: ignore[no-untyped-def]
    """Size up to which entries of values (n_blocks, 9) are negligible."""
    smallest = np.float64(np.inf)
    for row in range(Index(len(indptr) - 1)):
        k = Index(indptr[row])
        for i in (0, 4, 8):
            if 0.0 < values[k, i] < smallest:
                smallest = values[k, i]
    return smallest * NEGLIGIBLE


@cached()
def store(values, threshold, blocks):  # type: ignore[no-untyped-def]
    """blocks (n_blocks, 9) = values (n_blocks, 9) in single precision; 0 for sizes up to ``threshold``."""
    for block in range(Index(len(blocks))):
        for i in range(Index(9)):
            value = values[block, i]
            blocks[block, i] = value if abs(value) > threshold else 0.0


@cached()
def invert_diagonal(indptr, values, inverse):  # type: ignore[no-untyped-def]
    """inverse (n, 9) = inverses of the symmetric diagonal blocks of values (n_blocks, 9).

    Of a singular block only the diagonal is inverted.
    """
    for row in range(Index(len(inverse))):
        k = Index(indptr[row])
        a, b, c = values[k, 0], values[k, 1], values[k, 2]
        d, e, f = values[k, 4], values[k, 5], values[k, 8]
        p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
        u, v, w = a * f - c * c, b * c - a * e, a * d - b * b
        det = a * p + b * q + c * r
        if abs(det) > 1e-14 * abs(a * d * f):
            s = 1.0 / det
            p, q, r, u, v, w = s * p, s * q, s * r, s * u, s * v, s * w
        else:
            q = r = v = 0.0
            p = 1.0 / a if a != 0.0 else 0.0
            u = 1.0 / d if d != 0.0 else 0.0
            w = 1.0 / f if f != 0.0 else 0.0
        inverse[row, 0], inverse[row, 1], inverse[row, 2] = p, q, r
        inverse[row, 3], inverse[row, 4], inverse[row, 5] = q, u, v
        inverse[row, 6], inverse[row, 7], inverse[row, 8] = r, v, w


@cached()
def invert_roots(rows, values, roots):  # type: ignore[no-untyped-def]
    """roots (n_local, 6) = L⁻¹ of the Cholesky factors of diagonal blocks, values (n, 9), of rows (n,).

    The lower triangle is stored row by row; it is 0 in directions of zero or negative stiffness.
    """
    for number in range(Index(len(rows))):
        row, k = Index(rows[number]), number
        smallest = 1e-12 * max(values[k, 0], values[k, 4], values[k, 8])
        b, c, e = values[k, 1], values[k, 2], values[k, 5]
        d, f = values[k, 4], values[k, 8]
        p = q = r = l10 = l20 = l21 = 0.0
        if values[k, 0] > smallest:
            p = 1.0 / np.sqrt(values[k, 0])
            l10, l20 = b * p, c * p
        d -= l10 * l10
        if d > smallest:
            q = 1.0 / np.sqrt(d)
            l21 = (e - l10 * l20) * q
        f -= l20 * l20 + l21 * l21
        if f > smallest:
            r = 1.0 / np.sqrt(f)
        roots[row, 0], roots[row, 1], roots[row, 2] = p, -q * l10 * p, q
        roots[row, 3], roots[row, 4], roots[row, 5] = r * (l21 * q * l10 - l20) * p, -r * l21 * q, r


@cached()
def relative_couplings(rows, indptr, ends, columns, values, roots, sums):  # type: ignore[no-untyped-def]
    """sums (n,) = upper bounds of Σ_j ‖L_i⁻¹ C_ij L_j⁻ᵀ‖ over each row's couplings C_ij to ghosts.

    A spectral norm is bounded by the fourth root of the sum of the fourth powers of the singular values.
    """
    m = np.empty((3, 3))
    for number in range(Index(len(rows))):
        row = Index(rows[number])
        total = 0.0
        a0, a1, a2 = roots[row, 0], roots[row, 1], roots[row, 2]
        a3, a4, a5 = roots[row, 3], roots[row, 4], roots[row, 5]
        for k in range(Index(ends[row]), Index(indptr[row + Index(1)])):
            j = Index(columns[k])
            b0, b1, b2 = roots[j, 0], roots[j, 1], roots[j, 2]
            b3, b4, b5 = roots[j, 3], roots[j, 4], roots[j, 5]
            for i in range(Index(3)):  # the stored block is the transpose: row i of it belongs to the ghost
                s0, s1, s2 = values[k, 3 * i], values[k, 3 * i + 1], values[k, 3 * i + 2]
                m[i, 0], m[i, 1], m[i, 2] = s0 * a0, s0 * a1 + s1 * a2, s0 * a3 + s1 * a4 + s2 * a5
            xx = yy = zz = xy = xz = yz = 0.0
            for i in range(Index(3)):
                s0, s1, s2 = m[0, i], m[1, i], m[2, i]
                x, y, z = s0 * b0, s0 * b1 + s1 * b2, s0 * b3 + s1 * b4 + s2 * b5
                xx, yy, zz = xx + x * x, yy + y * y, zz + z * z
                xy, xz, yz = xy + x * y, xz + x * z, yz + y * z
            squares = xx * xx + yy * yy + zz * zz + 2.0 * (xy * xy + xz * xz + yz * yz)
            total += np.sqrt(np.sqrt(squares))
        sums[number] = total


@cached(inline="always")
def solved(inverse, row, s0, s1, s2):  # type: ignore[no-untyped-def]
    """Unknowns of a point: the inverse of its block times the right-hand side (s0, s1, s2)."""
    y0 = inverse[row, 0] * s0 + inverse[row, 1] * s1 + inverse[row, 2] * s2
    y1 = inverse[row, 3] * s0 + inverse[row, 4] * s1 + inverse[row, 5] * s2
    y2 = inverse[row, 6] * s0 + inverse[row, 7] * s1 + inverse[row, 8] * s2
    return flushed(y0), flushed(y1), flushed(y2)


@cached(fastmath=True)
def backward(indptr, ends, columns, blocks, inverse, x, r):  # type: ignore[no-untyped-def]
    """A backward sweep over the owned points: solves (D + Lᵀ) x = r, starting from x (n_local, 3).

    ``ends`` (n_owned,) is where a row's couplings to ghosts begin. r (n_owned, 4), whose fourth column is
    padding, is b − L x on entry (as ``forward`` leaves it; b if x is zero) and b − A x on exit, both for
    unchanged ghosts.
    """
    n = Index(len(ends))
    for swept in range(n):
        row = n - Index(1) - swept
        lo, hi = Index(indptr[row] + 1), Index(ends[row])
        s0, s1, s2 = gather(blocks, columns, x, lo, hi, -AHEAD)
        y0, y1, y2 = solved(inverse, row, r[row, 0] - s0, r[row, 1] - s1, r[row, 2] - s2)
        decrement = x[row, 0] - y0, x[row, 1] - y1, x[row, 2] - y2
        x[row, 0], x[row, 1], x[row, 2] = y0, y1, y2
        r[row, 0] = r[row, 1] = r[row, 2] = 0.0
        scatter(blocks, columns, r, lo, hi, decrement)


@cached(fastmath=True)
def subtract_ghosts(rows, indptr, ends, columns, blocks, x, r):  # type: ignore[no-untyped-def]
    """r −= (couplings to ghosts) · x (n_local, 3), for the owned rows (n,) that have such couplings."""
    for number in range(Index(len(rows))):
        row = Index(rows[number])
        s0, s1, s2 = gather(blocks, columns, x, Index(ends[row]), Index(indptr[row + Index(1)]), AHEAD)
        r[row, 0] -= s0
        r[row, 1] -= s1
        r[row, 2] -= s2


@cached(fastmath=True)
def forward(indptr, ends, columns, blocks, inverse, b, x, r):  # type: ignore[no-untyped-def]
    """A forward sweep from x (n_local, 3) with fixed ghosts; r (n_owned, 4) becomes b − L x."""
    n = Index(len(ends))
    for row in range(n):
        r[row, 0], r[row, 1], r[row, 2] = b[row, 0], b[row, 1], b[row, 2]
    for row in range(n):
        lo, hi = Index(indptr[row] + 1), Index(indptr[row + Index(1)])
        s0, s1, s2 = gather(blocks, columns, x, lo, hi, AHEAD)
        y0, y1, y2 = solved(inverse, row, r[row, 0] - s0, r[row, 1] - s1, r[row, 2] - s2)
        x[row, 0], x[row, 1], x[row, 2] = y0, y1, y2
        scatter(blocks, columns, r, lo, Index(ends[row]), (-y0, -y1, -y2))


@cached(fastmath=True)
def restrict(start, parents, weights, free, r, out):  # type: ignore[no-untyped-def]
    """out (C, 3) = interpolationᵀ · r (n, 3), where only free coordinates count."""
    out[:] = 0.0
    for row in range(Index(len(start) - 1)):
        r0, r1, r2 = free[row, 0] * r[row, 0], free[row, 1] * r[row, 1], free[row, 2] * r[row, 2]
        for p in range(Index(start[row]), Index(start[row + Index(1)])):
            c, w = Index(parents[p]), weights[p]
            out[c, 0] += w * r0
            out[c, 1] += w * r1
            out[c, 2] += w * r2


@cached(fastmath=True)
def add_interpolated(start, parents, weights, free, coarse, x):  # type: ignore[no-untyped-def]
    """x (n, 3) += interpolation · coarse (C, 3) in the free coordinates."""
    for row in range(Index(len(start) - 1)):
        e0 = e1 = e2 = np.float32(0.0)
        for p in range(Index(start[row]), Index(start[row + Index(1)])):
            c, w = Index(parents[p]), weights[p]
            e0 += w * coarse[c, 0]
            e1 += w * coarse[c, 1]
            e2 += w * coarse[c, 2]
        x[row, 0] += free[row, 0] * e0
        x[row, 1] += free[row, 1] * e1
        x[row, 2] += free[row, 2] * e2


@cached()
def begin(b, r):  # type: ignore[no-untyped-def]
    """Copy the first n rows of b (n_local, 3) into r (n, 4)."""
    for row in range(Index(len(r))):
        r[row, 0], r[row, 1], r[row, 2] = b[row, 0], b[row, 1], b[row, 2]


class BlockSweeps:
    """Gauss-Seidel sweeps over a pattern's rows, and their residual.

    Parameters
    ----------
    pattern : BlockPattern

    Attributes
    ----------
    b, x : (n_local, 3)
        Right-hand side and solution.
    r : (n_owned, 4)
        Residual; the fourth column is padding.
    flops : float
        Operations of a sweep.
    """

    def __init__(self, pattern: BlockPattern) -> None:
        n = pattern.n_owned
        self._rows = pattern.indptr, pattern.ends, pattern.columns
        self._with_ghosts = np.flatnonzero(pattern.ends < pattern.indptr[1:])
        self._blocks = np.empty((pattern.n_blocks, 9), dtype=np.float32)
        self._inverse = np.empty((n, 9), dtype=np.float32)
        self._increment: Floats | None = None  # only needed for more than one sweep
        self.x, self.b = (np.zeros((pattern.n_local, 3), dtype=np.float32) for _ in range(2))
        self.r = np.zeros((n, 4), dtype=np.float32)
        self.flops = 18.0 * pattern.n_couplings

    def diagonal(self, values: Array, rows: Ints) -> Array:
        """Blocks (n, 9) of rows (n,) that sweeps invert, from block rows (n_blocks, 9)."""
        blocks: Array = values[self._rows[0][rows]]
        return blocks

    def invert(self, values: Array) -> None:
        """Invert the diagonal blocks of block rows (n_blocks, 9)."""
        invert_diagonal(self._rows[0], values, self._inverse)

    def store(self, values: Array) -> None:
        """Copy block rows (n_blocks, 9)."""
        store(values, negligible_size(self._rows[0], values), self._blocks)

    def shrink(self, rows: Ints, factor: Array) -> None:
        """Divide the inverses of the diagonal blocks of rows (n,) by ``factor`` (n, 1)."""
        self._inverse[rows] /= factor

    def begin(self, b: Floats) -> None:
        """Set the residual to b (n_local, 3), that of x = 0."""
        begin(b, self.r)

    def add(self, rows: Ints, more: Floats) -> None:
        """Add to the residual of rows (n,)."""
        self.r[rows, :3] += more

    def backward(self, x: Floats) -> None:
        """One `backward` sweep."""
        backward(*self._rows, self._blocks, self._inverse, x, self.r)

    def inertia(self, values: Array) -> Array | None:
        """None: more than one sweep does not pay without edges."""
        return None

    def backward_again(self, x: Floats, number: int) -> None:
        """Another `backward` sweep, from the full residual b − A x; ``number`` is not used."""
        if self._increment is None:
            self._increment = np.zeros_like(x)
        self._increment[:] = 0.0
        backward(*self._rows, self._blocks, self._inverse, self._increment, self.r)
        x += self._increment

    def subtract_ghosts(self, x: Floats) -> None:
        """Subtract the couplings to ghosts times x from the residual."""
        subtract_ghosts(self._with_ghosts, *self._rows, self._blocks, x, self.r)

    def correct(self, x: Floats) -> bool:
        """False: coarser levels correct all unknowns of x (n_local, 3)."""
        return False

    def forward(self, b: Floats, x: Floats, number: int = 0) -> None:
        """One `forward` sweep; ``number`` is not used."""
        forward(*self._rows, self._blocks, self._inverse, b, x, self.r)
