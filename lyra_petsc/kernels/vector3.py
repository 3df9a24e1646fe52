"""Vectors of three numbers as tuples, in kernels: they stay in registers."""

from __future__ import annotations

from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import inlined


@inlined()
def point(x, i):  # type: ignore[no-untyped-def]
    """Row i of x (n, 3)."""
    i = Index(i)
    return x[i, 0], x[i, 1], x[i, 2]


@inlined()
def cross(a, b):  # type: ignore[no-untyped-def]
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined()
def dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined()
def minus(a, b):  # type: ignore[no-untyped-def]
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inlined()
def scaled(factor, v):  # type: ignore[no-untyped-def]
    """factor v."""
    return factor * v[0], factor * v[1], factor * v[2]


@inlined()
def combined(p, u, q, w):  # type: ignore[no-untyped-def]
    """p u + q w."""
    return p * u[0] + q * w[0], p * u[1] + q * w[1], p * u[2] + q * w[2]


@inlined()
def area_normal(x, s, e):  # type: ignore[no-untyped-def]
    """Normal of triangle e of s (E, 3) at points x (n, 3), with the length of twice its area."""
    a = point(x, s[e, 0])
    return cross(minus(point(x, s[e, 1]), a), minus(point(x, s[e, 2]), a))
