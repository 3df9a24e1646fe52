"""The shape that hinges and their triangles have: normals, cotangents, dihedral angles."""

from __future__ import annotations

import math

from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import kernel
from lyra_petsc.terms import hinge
from lyra_petsc.terms.hinge import cross, dot, minus, point


@kernel()
def triangles(x, corners, limit, out):  # type: ignore[no-untyped-def]
    """Of triangles with limits of |normal|² (T,) what their hinges' derivatives are made of, into out (T, 7).

    Unit normal, cotangents of the corners' angles, |normal| [m²], which is twice the area. Zeros for those
    that have no area left, or so little that their hinges fade.
    """
    for t in range(corners.shape[0]):
        a, b, c = point(x, corners[t, 0]), point(x, corners[t, 1]), point(x, corners[t, 2])
        e0, e1, e2 = minus(c, b), minus(a, c), minus(b, a)
        m = cross(e2, e0)
        square = dot(m, m)
        if not square > limit[t]:
            out[t, :] = 0.0
            continue
        size = math.sqrt(square)
        inverse = 1.0 / size
        out[t, 0], out[t, 1], out[t, 2] = inverse * m[0], inverse * m[1], inverse * m[2]
        out[t, 3] = -inverse * dot(e1, e2)
        out[t, 4] = -inverse * dot(e2, e0)
        out[t, 5] = -inverse * dot(e0, e1)
        out[t, 6] = size


@kernel(inline="always")
def triangles_at(sides, h):  # type: ignore[no-untyped-def]
    """Numbers of a hinge's two triangles."""
    return Index(sides[h, 0] >> 2), Index(sides[h, 1] >> 2)


@kernel(inline="always")
def fades(shape, sides, h):  # type: ignore[no-untyped-def]
    """Whether one of a hinge's triangles has hardly an area left, or none."""
    # no ``or``: a jump would have numba count references to the arrays here, for each hinge
    one, two = triangles_at(sides, h)
    return (shape[one, 6] == 0.0) | (shape[two, 6] == 0.0)


@kernel()
def angle_parts(x, s, sides, shape, sine, cosine, length):  # type: ignore[no-untyped-def]
    """Of hinges' dihedral angles, up to a factor, and lengths [m] of the edges, into (E,) each."""
    for h in range(s.shape[0]):
        x0, x1 = point(x, s[h, 0]), point(x, s[h, 1])
        e = minus(x1, x0)
        length[h] = math.sqrt(dot(e, e))
        if fades(shape, sides, h):
            sine[h], cosine[h], _, _ = hinge.angle_parts(x0, x1, point(x, s[h, 2]), point(x, s[h, 3]))
            continue
        one, two = triangles_at(sides, h)
        n1 = shape[one, 0], shape[one, 1], shape[one, 2]
        n2 = shape[two, 0], shape[two, 1], shape[two, 2]
        sine[h], cosine[h] = dot(cross(n1, n2), e) / length[h], dot(n1, n2)


@kernel()
def angle_parts_of_points(x, s, sine, cosine):  # type: ignore[no-untyped-def]
    """Of hinges' dihedral angles, up to a factor, into (E,) each."""
    for h in range(s.shape[0]):
        x0, x1, x2, x3 = point(x, s[h, 0]), point(x, s[h, 1]), point(x, s[h, 2]), point(x, s[h, 3])
        sine[h], cosine[h], _, _ = hinge.angle_parts(x0, x1, x2, x3)
