"""Coulomb friction of pairs in contact, for one step: pure functions on arrays.

With the normal n, the normal force N and the barycentric coefficients β of the last accepted state, the
tangential way that a pair has gone, elastic part ξ of the steps before included, is

    u = (I − n nᵀ) (Σ β_i x_i − c) + ξ,

c what the sum was and, of an obstacle that moves, will be if the pair sticks. Up to the force μ N the pair
sticks like a spring of stiffness k, beyond it slides. The potential of this force is convex::

    D = ½ k |u|²  for k |u| ≤ μ N,  else  μ N |u| − (μ N)² / 2k

Simo & Laursen, An augmented Lagrangian treatment of contact problems involving friction, Computers &
Structures 42 (1992) 97-116 (return mapping), with the normal force of the last step.
"""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import kernel, leaf
from lyra_petsc.kernels.scatter import fetch_ahead
from lyra_petsc.kernels.vectors import add_outer
from lyra_petsc.terms.contact_pairs import VERTEX_TRIANGLE

SLIP, SLID, BETA, NORMAL, START, FOOT, FORCE, COLUMNS = 6, 9, 10, 14, 17, 20, 23, 24
"""Where each begins in a row of what is known of pairs, `friction.Pairs`, and how long it is."""

EQUAL = 1e-6
"""Relative difference of squared lengths up to which which is longer is a matter of rounding."""


@leaf()
def way(x, e, stencil, beta, normal, start, slip, u):  # type: ignore[no-untyped-def]
    """u of pair e into u (3,); |u|."""
    along = 0.0
    for k in range(3):
        at = -start[e, k]
        for i in range(4):
            at += beta[e, i] * x[Index(stencil[e, i]), k]
        u[k] = at
        along += normal[e, k] * at
    square = 0.0
    for k in range(3):
        u[k] += slip[e, k] - along * normal[e, k]
        square += u[k] * u[k]
    return math.sqrt(square)


@kernel()
def energies(x, stencil, beta, normal, start, slip, stiffness, limit, out):  # type: ignore[no-untyped-def]
    """D [J] of the first len(out) pairs."""
    u = np.empty(3)
    for e in range(len(out)):
        m = way(x, e, stencil, beta, normal, start, slip, u)
        k, most = stiffness[e], limit[e]
        out[e] = 0.5 * k * m * m if k * m <= most else most * (m - 0.5 * most / k)


@kernel()
def add_gradient(x, stencil, beta, normal, start, slip, stiffness, limit, out):  # type: ignore[no-untyped-def]
    """Add the gradient [N] to rows of out (n_local, 3)."""
    u = np.empty(3)
    for e in range(len(stencil)):
        m = way(x, e, stencil, beta, normal, start, slip, u)
        factor = stiffness[e] if stiffness[e] * m <= limit[e] else limit[e] / m
        for i in range(4):
            for k in range(3):
                out[Index(stencil[e, i]), k] += factor * beta[e, i] * u[k]


@kernel()
def add_hessians(  # type: ignore[no-untyped-def]
    x, stencil, beta, normal, start, slip, stiffness, limit, weight, blend, offsets, values
):  # fmt: skip
    """Add weight (E,) times the Hessians [N/m], all positive semidefinite, to block rows values (n, 3, 3).

    ``offsets`` (E, 10) as of `kernels.scatter`. ``blend`` 0 is exact; 1 takes a spring of the stiffness
    μ N / |u| for what slides, whose energy is nowhere less.
    """
    u, blocks = np.empty(3), values.reshape(-1, 9)
    for e in range(len(stencil)):
        fetch_ahead(e, offsets, blocks, 10)
        m = way(x, e, stencil, beta, normal, start, slip, u)
        _add_hessian(e, m, u, beta, normal, stiffness[e], limit[e], weight[e], blend, offsets, blocks)


@leaf()
def _add_hessian(e, m, u, beta, normal, stiffness, limit, weight, blend, offsets, blocks):  # type: ignore[no-untyped-def]  # fmt: skip
    """Add that of pair e with the way u (3,), of length m, to blocks (n_blocks, 9)."""
    sticks = stiffness * m <= limit
    factor = stiffness if sticks else limit / m
    less = 0.0 if sticks else (1.0 - blend) * factor / (m * m)
    n, along = (normal[e, 0], normal[e, 1], normal[e, 2]), (u[0], u[1], u[2])
    for a in range(4):
        for b in range(a, 4):
            both, to = weight * beta[e, a] * beta[e, b], offsets[e, (7 - a) * a // 2 + b]
            if both == 0.0:
                continue
            own, by = both * factor, -both * less
            add_outer(blocks, to, own, (-own * n[0], -own * n[1], -own * n[2]), n)
            if by != 0.0:
                add_outer(blocks, to, 0.0, (by * u[0], by * u[1], by * u[2]), along)


@kernel()
def slide(x, stencil, beta, normal, start, slip, stiffness, limit, heat, slides):  # type: ignore[no-untyped-def]
    """Let ``slip`` be the elastic part of u; the work [J] that sliding takes and whether pairs do, (E,)."""
    u = np.empty(3)
    for e in range(len(stencil)):
        m = way(x, e, stencil, beta, normal, start, slip, u)
        elastic = limit[e] / stiffness[e]
        heat[e], slides[e] = 0.0, m > elastic
        if m > elastic:
            heat[e] = limit[e] * (m - elastic)
            for k in range(3):
                u[k] *= elastic / m
        for k in range(3):
            slip[e, k] = u[k]


@kernel()
def keys(points, number, kind, obstacle, beta, at, out):  # type: ignore[no-untyped-def]
    """What tells pairs ``at`` (E,) with β (E, 4) from others, into out (E, 10).

    Before a vertex of a sheet only what is nearest tells a triangle.
    """
    for m in range(len(at)):
        e, nearest = at[m], 1
        before = kind[e] == VERTEX_TRIANGLE and points[e, 0] >= 0
        while before and nearest < 3 and beta[m, nearest] == 0.0:
            nearest += 1
        nearest = 1 if beta[m, nearest] == 0.0 else nearest
        out[m, 4], out[m, 5] = kind[e], obstacle[e]
        for i in range(4):
            of = nearest if before and i > 0 and beta[m, i] == 0.0 else i
            out[m, i], out[m, 6 + i] = number[e, of], min(points[e, of], 0)


@kernel()
def describe(x, stencil, points, keys, touching, same, old, what):  # type: ignore[no-untyped-def]
    """What is known of pairs with keys (E, 10), into what (E, 24), at positions x (n_local, 3).

    ``touching`` are their numbers among ``stencil`` and ``points``, β, unit normals and normal forces; those
    with a number in ``same`` (E,) of 0 or more go on that row of ``old`` (M, 24).
    """
    numbers, beta, normal, force = touching
    for m in range(len(numbers)):
        e, side, along = numbers[m], 0.0, 0.0
        for k in range(6):
            what[m, k] = keys[m, 4 + k]
        for i in range(4):
            share = beta[m, i] if points[e, i] >= 0 else 0.0
            what[m, BETA + i] = share
            side += share
        for k in range(3):
            start = 0.0
            for i in range(4):
                start += what[m, BETA + i] * x[Index(stencil[e, i]), k]
            what[m, NORMAL + k], what[m, START + k] = normal[m, k], start
            what[m, FOOT + k] = side * start if abs(side) > 0.5 else 0.0  # where the other is an obstacle
            what[m, SLIP + k] = old[same[m], SLIP + k] if same[m] >= 0 else 0.0
            along += what[m, SLIP + k] * normal[m, k]
        for k in range(3):
            what[m, SLIP + k] -= along * normal[m, k]
        what[m, SLID], what[m, FORCE] = old[same[m], SLID] if same[m] >= 0 else 0.0, force[m]


@kernel()
def unpack(what, beta, normal, start, slip, foot):  # type: ignore[no-untyped-def]
    """Columns of what (E, 24) into arrays of their own, (E, 4) and (E, 3)."""
    for e in range(len(what)):
        for i in range(4):
            beta[e, i] = what[e, BETA + i]
        for k in range(3):
            normal[e, k], start[e, k] = what[e, NORMAL + k], what[e, START + k]
            slip[e, k], foot[e, k] = what[e, SLIP + k], what[e, FOOT + k]


@leaf()
def _alike(keys, a, among, b):  # type: ignore[no-untyped-def]
    """How alike two pairs with keys (10,) in rows a and b and the same first vertex are; −1: one does not go
    on in the other. Between a vertex of a sheet and triangles it does if these have a nearest vertex in
    common.
    """
    one, other = keys[a], among[b]
    if one[4] != other[4] or one[5] != other[5]:
        return -1
    if one[4] != VERTEX_TRIANGLE or one[6] != 0:
        for k in range(10):
            if one[k] != other[k]:
                return -1
        return 20
    begins, common, size, others = 7 if one[5] >= 0 else 1, 0, 0, 0
    for i in range(begins, begins + 3):
        size += (
            1 if i == begins or (one[i] != one[begins] and (i == begins + 1 or one[i] != one[i - 1])) else 0
        )
        new = i == begins or (other[i] != other[begins] and (i == begins + 1 or other[i] != other[i - 1]))
        if not new:
            continue
        others += 1
        for j in range(begins, begins + 3):
            if one[j] == other[i]:
                common += 1
                break
    if one[5] < 0 and common == 0:
        return -1
    return 10 + 2 * common - size - others


@kernel()
def find(keys, among, what, place):  # type: ignore[no-untyped-def]
    """Which row of ``among`` (M, 10) goes on in each row of keys (N, 10), −1 where none does.

    Of several that are as much alike the one with the longer elastic part, in their rows of ``what`` (M, 24);
    of those that slide, whose elastic parts are equally long, the one with the larger normal force.
    """
    room = 1
    while room < 2 * len(among):
        room *= 2
    first, following = np.full(room, -1), np.empty(len(among), dtype=np.int64)
    for b in range(len(among)):
        row = Index(among[b, 0] & (room - 1))
        following[b], first[row] = first[row], b
    for a in range(len(keys)):
        place[a], best, longest, largest = -1, -1, 0.0, 0.0
        b = first[Index(keys[a, 0] & (room - 1))]
        while b >= 0:
            if among[b, 0] == keys[a, 0]:
                fits, length = _alike(keys, a, among, b), 0.0
                for k in range(3):
                    length += what[b, SLIP + k] * what[b, SLIP + k]
                force, longer = what[b, FORCE], length > longest * (1.0 + EQUAL)
                longer = longer or (length >= longest * (1.0 - EQUAL) and force > largest)
                if fits >= 0 and (fits > best or (fits == best and longer)):
                    place[a], best, longest, largest = b, fits, length, force
            b = following[b]
