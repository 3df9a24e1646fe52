"""Geometry of hinges and their triangles: normals, cotangents, dihedral angles."""

from __future__ import annotations

import math

from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import inlined, kernel
from lyra_petsc.kernels.vector3 import cross, dot, minus, point
from lyra_petsc.terms.bending import dihedral_angle


@kernel()
def triangles(x, corners, limit, out):  # type: ignore[no-untyped-def]
    """Write the geometry of triangles into out (T, 7), from which derivatives of hinges are computed.

    Unit normal (3), cotangents of the corners' angles (3), |normal| [m²] (twice the area). All are 0 for
    triangles whose hinges fade, that is, |normal|² is not above ``limit`` (T,). Returns whether any do.
    """
    any_fades = False
    for t in range(corners.shape[0]):
        a, b, c = point(x, corners[t, 0]), point(x, corners[t, 1]), point(x, corners[t, 2])
        e0, e1, e2 = minus(c, b), minus(a, c), minus(b, a)
        m = cross(e2, e0)
        square = dot(m, m)
        if not square > limit[t]:
            out[t, :] = 0.0
            any_fades = True
            continue
        size = math.sqrt(square)
        inverse = 1.0 / size
        out[t, 0], out[t, 1], out[t, 2] = inverse * m[0], inverse * m[1], inverse * m[2]
        out[t, 3] = -inverse * dot(e1, e2)
        out[t, 4] = -inverse * dot(e2, e0)
        out[t, 5] = -inverse * dot(e0, e1)
        out[t, 6] = size
    return any_fades


@inlined()
def triangles_at(sides, h):  # type: ignore[no-untyped-def]
    """Numbers of the two triangles of hinge h."""
    return Index(sides[h, 0] >> 2), Index(sides[h, 1] >> 2)


@inlined()
def fades(shape, sides, h):  # type: ignore[no-untyped-def]
    """Whether hinge h fades, because one of its triangles has hardly any area."""
    # no ``or``: with a branch numba counts references to the arrays here, for each hinge
    one, two = triangles_at(sides, h)
    return (shape[one, 6] == 0.0) | (shape[two, 6] == 0.0)


@kernel()
def angle_parts(x, s, sides, shape, sine, cosine, length):  # type: ignore[no-untyped-def]
    """Write sines and cosines (E,) of dihedral angles, up to a common factor, and edge lengths (E,) [m].

    Angles of hinges that fade are 0.
    """
    for h in range(s.shape[0]):
        e = minus(point(x, s[h, 1]), point(x, s[h, 0]))
        length[h] = math.sqrt(dot(e, e))
        if fades(shape, sides, h):
            sine[h], cosine[h] = 0.0, 1.0
            continue
        one, two = triangles_at(sides, h)
        n1 = shape[one, 0], shape[one, 1], shape[one, 2]
        n2 = shape[two, 0], shape[two, 1], shape[two, 2]
        sine[h], cosine[h] = dot(cross(n1, n2), e) / length[h], dot(n1, n2)


@kernel()
def angle_parts_of_points(x, s, sine, cosine):  # type: ignore[no-untyped-def]
    """Write sines and cosines (E,) of dihedral angles, up to a common factor, of hinges s (E, 4)."""
    for h in range(s.shape[0]):
        x0, x1, x2, x3 = point(x, s[h, 0]), point(x, s[h, 1]), point(x, s[h, 2]), point(x, s[h, 3])
        sine[h], cosine[h], _, _ = dihedral_angle.angle_parts(x0, x1, x2, x3)
