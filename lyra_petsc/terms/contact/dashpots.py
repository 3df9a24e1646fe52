"""Kernels for impulses between nearest points: mass shares, dashpots, and couples that conserve moments.

Pairs are those from `term.Elastic.dashpots`; only those of this rank, ``mine``, are used. The masses of
vertices are divided between them in proportion to ``weight`` (m,).
"""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import kernel
from lyra_petsc.kernels.vector3 import cross, dot, minus, point

LINE = 1e-12
"""Determinant of the inertia of four points over the cube of its trace below which they are on a line."""


@kernel()
def find_own(points, beta, vertex, number, n, mine):  # type: ignore[no-untyped-def]
    """Which pairs belong to this rank: it owns their vertex, or for pairs without one the nearest vertex with
    the lowest global number (n_local,); its own rows come first, ``n`` of them.
    """
    for e in range(len(points)):
        vertex_row = vertex[e]
        if vertex_row < 0:
            lowest = np.iinfo(np.int64).max
            for i in range(4):
                row = points[e, i]
                if row >= 0 and beta[e, i] != 0.0 and number[Index(row)] < lowest:
                    lowest, vertex_row = number[Index(row)], row
        mine[e] = 0 <= vertex_row < n


@kernel()
def share(points, beta, weight, mine, out):  # type: ignore[no-untyped-def]
    """Add weight_e |β_ei| Σ_j |β_ej| of the pairs e to the first column of out (n_local, 3)."""
    for e in range(len(points)):
        if mine[e]:
            total = 0.0
            for j in range(4):
                total += abs(beta[e, j]) if points[e, j] >= 0 else 0.0
            for i in range(4):
                if points[e, i] >= 0:
                    out[Index(points[e, i]), 0] += weight[e] * abs(beta[e, i]) * total


@kernel()
def damp(v, inverse, points, beta, normal, stiffness, approach, mine, dt, damping, push, out):  # type: ignore[no-untyped-def]
    """Add the impulses [N s] of dashpots in dt [s] to out (n_local, 3), and write the impulse of each to push
    (m,). The weights are the stiffnesses.

    v (n_local, 3) [m/s] are velocities, ``inverse`` (n_local, 3) [1/kg] is 1/m for the part of the mass that
    a pair of weight 1 may move, ``damping`` the ratio to critical damping, ``approach`` (m,) [m/s]
    the speeds of obstacles towards it.
    """
    for e in range(len(points)):
        push[e] = 0.0
        if not mine[e]:
            continue
        inverse_mass, rate = 0.0, -approach[e]
        for i in range(4):
            if points[e, i] >= 0 and beta[e, i] != 0.0:
                row = Index(points[e, i])
                for k in range(3):
                    inverse_mass = max(inverse_mass, inverse[row, k])
                    rate += beta[e, i] * v[row, k] * normal[e, k]
        if inverse_mass > 0.0:
            q = 2.0 * damping * dt * math.sqrt(inverse_mass)
            push[e] = math.expm1(-q) * stiffness[e] / inverse_mass * rate
            for i in range(4):
                if points[e, i] >= 0:
                    for k in range(3):
                        out[Index(points[e, i]), k] += push[e] * beta[e, i] * normal[e, k]


@kernel()
def add_couples(x, points, moment, out):  # type: ignore[no-untyped-def]
    """Add impulses [N s] with given moments (m, 3) [N m s] and no resultant to out (n_local, 3): those of a
    rigid rotation of four points of equal masses. Points on a line get none.
    """
    for e in range(len(points)):
        mean = 0.0, 0.0, 0.0
        for i in range(4):
            p = point(x, points[e, i])
            mean = mean[0] + 0.25 * p[0], mean[1] + 0.25 * p[1], mean[2] + 0.25 * p[2]
        xx = xy = xz = yy = yz = zz = 0.0
        for i in range(4):
            a, b, c = minus(point(x, points[e, i]), mean)
            xx, yy, zz = xx + b * b + c * c, yy + a * a + c * c, zz + a * a + b * b
            xy, xz, yz = xy - a * b, xz - a * c, yz - b * c
        one, two, three = (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)
        u, v, w = cross(two, three), cross(three, one), cross(one, two)
        det, target = dot(one, u), (moment[e, 0], moment[e, 1], moment[e, 2])
        if not det > LINE * (xx + yy + zz) ** 3:
            continue
        rotation = dot(u, target) / det, dot(v, target) / det, dot(w, target) / det
        for i in range(4):
            row = Index(points[e, i])
            push = cross(rotation, minus(point(x, row), mean))
            for k in range(3):
                out[row, k] += push[k]
