"""Energies, gradients and Hessians of hinges that fade, because a triangle has hardly any area.

Such hinges are rare. Their kernels are separate from those of the others, and called only if some hinges
fade, so that most scenes need not compile them. ``fading`` (F,) are the numbers of these hinges.
"""

from __future__ import annotations

import numpy as np

from lyra_petsc.kernels.element import inlined, kernel, subkernel
from lyra_petsc.kernels.scatter import add_element
from lyra_petsc.kernels.vector3 import point
from lyra_petsc.terms.bending.dihedral_angle import angle_parts
from lyra_petsc.terms.bending.hinge_energy import hinge_energy, hinge_gradient, hinge_hessian, hinge_weight
from lyra_petsc.terms.bending.hinge_rows import ends


@inlined()
def limits_of(limit, sides, h):  # type: ignore[no-untyped-def]
    """The limits of |normal|² of the two triangles of hinge h."""
    return limit[sides[h, 0] >> 2], limit[sides[h, 1] >> 2]


@kernel()
def weights(x, s, sides, limit, out):  # type: ignore[no-untyped-def]
    """Write the factor w(a1) w(a2) of each hinge into out (E,); 1 unless a triangle has nearly collapsed."""
    for h in range(s.shape[0]):
        x0, x1, x2, x3 = point(x, s[h, 0]), point(x, s[h, 1]), point(x, s[h, 2]), point(x, s[h, 3])
        _, _, square1, square2 = angle_parts(x0, x1, x2, x3)
        limits = limits_of(limit, sides, h)
        out[h] = hinge_weight(square1, square2, limits[0], limits[1])


@kernel()
def energies(x, s, sides, fading, limit, theta, k, rest, out):  # type: ignore[no-untyped-def]
    """Write the energy [J] of hinges that fade into out; hinges beyond its end are left out."""
    for h in fading:
        if h < out.shape[0]:
            x0, x1, x2, x3 = point(x, s[h, 0]), point(x, s[h, 1]), point(x, s[h, 2]), point(x, s[h, 3])
            _, _, square1, square2 = angle_parts(x0, x1, x2, x3)
            out[h] = hinge_energy(theta[h], square1, square2, k[h], rest[h], limits_of(limit, sides, h))


@kernel()
def add_gradient(x, s, sides, fading, limit, theta, k, rest, out):  # type: ignore[no-untyped-def]
    """Add the energy's gradient [N] of hinges that fade to out (n_local, 3)."""
    g = np.empty((4, 3))
    for h in fading:
        x0, x1, x2, x3 = point(x, s[h, 0]), point(x, s[h, 1]), point(x, s[h, 2]), point(x, s[h, 3])
        limits = limits_of(limit, sides, h)
        moment = hinge_gradient(x0, x1, x2, x3, theta[h], k[h], rest[h], limits, g)
        for a in range(4):
            for i in range(3):
                out[s[h, a], i] += moment * g[a, i]


@inlined()
def _pair_index(a, b):  # type: ignore[no-untyped-def]
    """Index of the coupling of corners a and b among (0, 0), (0, 1), …, (2, 2) of a triangle."""
    low, high = min(a, b), max(a, b)
    return low * (5 - low) // 2 + high


@inlined()
def _same_block(at, swapped):  # type: ignore[no-untyped-def]
    """Offset of the same block, to which values are added transposed if ``swapped``."""
    return 2 * (at >> 1) + int(swapped) if at >= 0 else at


@subkernel()
def hinge_offsets(h, s, sides, within, across, out):  # type: ignore[no-untyped-def]
    """Write the offsets of all couplings of hinge h into out (10,)."""
    one, two, p, q = sides[h, 0] >> 2, sides[h, 1] >> 2, sides[h, 0] & 3, sides[h, 1] & 3
    (i, j), (m, k) = ends(p), ends(q)  # the second triangle runs against the edge
    out[0] = within[one, _pair_index(i, i)]
    out[1] = _same_block(within[one, _pair_index(i, j)], s[h, 0] < s[h, 1])
    out[2] = _same_block(within[one, _pair_index(i, p)], s[h, 0] < s[h, 2])
    out[3] = _same_block(within[two, _pair_index(k, q)], s[h, 0] < s[h, 3])
    out[4] = within[one, _pair_index(j, j)]
    out[5] = _same_block(within[one, _pair_index(j, p)], s[h, 1] < s[h, 2])
    out[6] = _same_block(within[two, _pair_index(m, q)], s[h, 1] < s[h, 3])
    out[7] = within[one, _pair_index(p, p)]
    out[8] = across[h]
    out[9] = within[two, _pair_index(q, q)]


@kernel()
def add_hessian(  # type: ignore[no-untyped-def]
    x, s, sides, fading, limit, theta, k, rest, convexity, weight, within, across, values
):
    """Add weight (E,) times all blocks of hinges that fade; ``convexity`` 0 is exact."""
    offsets = np.empty(10, dtype=within.dtype)
    gradient, blocks = np.empty((4, 3)), np.empty((4, 4, 3, 3))
    for h in fading:
        x0, x1, x2, x3 = point(x, s[h, 0]), point(x, s[h, 1]), point(x, s[h, 2]), point(x, s[h, 3])
        limits = limits_of(limit, sides, h)
        hinge_hessian(x0, x1, x2, x3, theta[h], k[h], rest[h], limits, convexity, gradient, blocks)
        hinge_offsets(h, s, sides, within, across, offsets)
        add_element(weight[h], blocks, offsets, values)
