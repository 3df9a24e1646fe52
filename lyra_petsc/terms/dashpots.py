"""Kernels of the impulses between nearest points: shares of masses, dashpots, and what keeps moments.

Pairs of dashpots are as `term.Elastic.dashpots` gives them; only those of this rank, ``mine``, count.
"""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import kernel
from lyra_petsc.terms.hinge import cross, dot, minus, point

LINE = 1e-12
"""Determinant of the inertia of four points over the cube of its trace below which they are on a line."""


@kernel()
def find_own(points, beta, vertex, number, n, mine):  # type: ignore[no-untyped-def]
    """Which pairs are this rank's: it owns their vertex, or of pairs without one that with the least global
    number (n_local,) that a nearest point is on or beside; its own rows come first, ``n`` of them.
    """
    for e in range(len(points)):
        first = vertex[e]
        if first < 0:
            least = np.iinfo(np.int64).max
            for i in range(4):
                row = points[e, i]
                if row >= 0 and beta[e, i] != 0.0 and number[Index(row)] < least:
                    least, first = number[Index(row)], row
        mine[e] = 0 <= first < n


@kernel()
def share(points, beta, mine, out):  # type: ignore[no-untyped-def]
    """Add |β_ei| Σ_j |β_ej| of the pairs e to the first column of out (n_local, 3)."""
    for e in range(len(points)):
        if mine[e]:
            total = 0.0
            for j in range(4):
                total += abs(beta[e, j]) if points[e, j] >= 0 else 0.0
            for i in range(4):
                if points[e, i] >= 0:
                    out[Index(points[e, i]), 0] += abs(beta[e, i]) * total


@kernel()
def damp(v, inverse, points, beta, normal, stiffness, pushed, mine, dt, damping, push, out):  # type: ignore[no-untyped-def]
    """Add the impulses [N s] of dashpots in dt [s] to out (n_local, 3), and keep each in push (m,).

    By velocities v (n_local, 3) [m/s] and 1/m (n_local, 3) [1/kg] of the parts of the masses that a pair may
    move; ``damping`` is over the critical one, ``pushed`` (m,) [m] how far obstacles came nearer.
    """
    for e in range(len(points)):
        push[e] = 0.0
        if not mine[e]:
            continue
        most, rate = 0.0, -pushed[e] / dt
        for i in range(4):
            if points[e, i] >= 0 and beta[e, i] != 0.0:
                row = Index(points[e, i])
                for k in range(3):
                    most = max(most, inverse[row, k])
                    rate += beta[e, i] * v[row, k] * normal[e, k]
        if most > 0.0:
            push[e] = math.expm1(-2.0 * damping * dt * math.sqrt(stiffness[e] * most)) / most * rate
            for i in range(4):
                if points[e, i] >= 0:
                    for k in range(3):
                        out[Index(points[e, i]), k] += push[e] * beta[e, i] * normal[e, k]


@kernel()
def add_couples(x, points, moment, out):  # type: ignore[no-untyped-def]
    """Add impulses [N s] with these moments (m, 3) [N m s] and without resultant to out (n_local, 3): as in a
    rigid rotation of each four points of equal masses. Points on a line get none.
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
        det, given = dot(one, u), (moment[e, 0], moment[e, 1], moment[e, 2])
        if not det > LINE * (xx + yy + zz) ** 3:
            continue
        turn = dot(u, given) / det, dot(v, given) / det, dot(w, given) / det
        for i in range(4):
            row = Index(points[e, i])
            push = cross(turn, minus(point(x, row), mean))
            for k in range(3):
                out[row, k] += push[k]
