"""Energies of hinges and their gradients, from the triangles' ``shape`` (T, 7) of ``hinge_shape``.

The gradient is assembled by triangles, since all forces of a triangle's hinges act along its normal.
"""

from __future__ import annotations

import numpy as np

from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import kernel
from lyra_petsc.kernels.vector3 import point
from lyra_petsc.terms.bending.dihedral_angle import angle_parts
from lyra_petsc.terms.bending.hinge_energy import hinge_energy, hinge_gradient, hinge_weight
from lyra_petsc.terms.bending.hinge_shape import fades


@kernel(inline="always")
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
def energies(x, s, sides, shape, limit, theta, k, rest, out):  # type: ignore[no-untyped-def]
    """Write the energy [J] of the first len(out) hinges."""
    for h in range(out.shape[0]):
        change = theta[h] - rest[h]
        out[h] = k[h] * change * change
        if fades(shape, sides, h):
            x0, x1, x2, x3 = point(x, s[h, 0]), point(x, s[h, 1]), point(x, s[h, 2]), point(x, s[h, 3])
            _, _, square1, square2 = angle_parts(x0, x1, x2, x3)
            out[h] = hinge_energy(theta[h], square1, square2, k[h], rest[h], limits_of(limit, sides, h))


@kernel()
def edge_forces(x, s, sides, shape, limit, theta, length, k, rest, force, out):  # type: ignore[no-untyped-def]
    """Write the hinges' moments over their edge lengths [N] into force (E + 1,).

    Entries of hinges that fade, and the last one, are 0; the gradients of hinges that fade are added to out
    (n_local, 3).
    """
    g = np.empty((4, 3))
    force[-1] = 0.0
    for h in range(s.shape[0]):
        if not fades(shape, sides, h):
            force[h] = 2.0 * k[h] * (theta[h] - rest[h]) / length[h]
        else:
            force[h] = 0.0
            x0, x1, x2, x3 = point(x, s[h, 0]), point(x, s[h, 1]), point(x, s[h, 2]), point(x, s[h, 3])
            limits = limits_of(limit, sides, h)
            moment = hinge_gradient(x0, x1, x2, x3, theta[h], k[h], rest[h], limits, g)
            for a in range(4):
                for i in range(3):
                    out[s[h, a], i] += moment * g[a, i]


@kernel()
def add_gradient(corners, hinges, shape, force, out):  # type: ignore[no-untyped-def]
    """Add the energy's gradient [N] to out (n_local, 3), except that of hinges that fade.

    At an end of an edge it is the hinge's ``force`` times the cotangent of the angle at the other end.
    """
    for t in range(corners.shape[0]):
        c0, c1, c2 = shape[t, 3], shape[t, 4], shape[t, 5]
        h0, h1, h2 = Index(hinges[t, 0] >> 1), Index(hinges[t, 1] >> 1), Index(hinges[t, 2] >> 1)
        p0, p1, p2 = force[h0], force[h1], force[h2]
        f1 = p0 * c2 + p2 * c0 - p1 * (c0 + c2)
        f2 = p0 * c1 + p1 * c0 - p2 * (c0 + c1)
        i0, i1, i2 = Index(corners[t, 0]), Index(corners[t, 1]), Index(corners[t, 2])
        for i in range(3):
            n = shape[t, i]
            out[i0, i] -= (f1 + f2) * n
            out[i1, i] += f1 * n
            out[i2, i] += f2 * n
