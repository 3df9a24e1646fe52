"""Forces of hinges that do not fade, from the triangles' ``shape`` (T, 7) of ``hinge_shape``.

The gradient is assembled by triangles, since all forces of a triangle's hinges act along its normal.
"""

from __future__ import annotations

from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import kernel
from lyra_petsc.terms.bending.hinge_shape import fades


@kernel()
def edge_forces(sides, shape, theta, length, k, rest, force):  # type: ignore[no-untyped-def]
    """Write the hinges' moments over their edge lengths [N] into force (E + 1,).

    Entries of hinges that fade, and the last one, are 0.
    """
    force[-1] = 0.0
    for h in range(len(k)):
        force[h] = 0.0 if fades(shape, sides, h) else 2.0 * k[h] * (theta[h] - rest[h]) / length[h]


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
