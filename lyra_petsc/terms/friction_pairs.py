"""Coulomb friction of pairs in contact, for one step: pure functions on arrays.

With the normal n, the normal force N and the barycentric coefficients β of the last accepted state, the
tangential way that a pair has gone, elastic part ξ of the steps before included, is

    u = (I − n nᵀ) (Σ β_i x_i − c) + Σ d_i (n · x_i − h_i) + ξ,

c and h_i what the sum and n · x_i were; of an obstacle that moves c is what it will be if the pair sticks,
and d_i = 0. Between sheets the second sum takes away that they turn together: n does so with the triangle
or with both edges, which tell the vectors d_i across n (`frame`). Nearest points are a distance apart;
without it any rotation would be a slip, and forces at them would have a moment. With it forces have none
where the state was accepted. In a step u is known by its components along two unit vectors t_c across n::

    u_c = Σ w_ci · x_i + still_c,  w_ci = β_i t_c + (d_i · t_c) n

Up to the force μ N the pair sticks like a spring of stiffness k, beyond it slides. The potential of this
force is convex::

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
from lyra_petsc.kernels.vectors import add_outers
from lyra_petsc.terms.contact_pairs import EDGE_EDGE, VERTEX_TRIANGLE
from lyra_petsc.terms.hinge import combined, cross, dot, minus, point

SLIP, SLID, BETA, NORMAL, START, FOOT, FORCE, GRIP, TURN, COLUMNS = 6, 9, 10, 14, 17, 20, 23, 24, 25, 34
"""Where each begins in a row of what is known of pairs, `friction.Pairs`, and how long it is."""

LEVER = 0.25
"""Of the vertices around nearest points, in the direction in which it is least, over the distance of these:
below, the couple would be large, and friction is less, so that it is not; none where there is no lever."""

UPRIGHT = 0.7
"""Cosine of the angle of two normals from which on they are near each other."""

FLAT = 1e-12
"""Product of the squared levers over the square of their sum below which there is none in some direction."""

ON_EDGE = 1e-7
"""Barycentric coordinate below which a place is on an edge: where meshes lie on each other in line, it is a
matter of rounding in which triangle."""

OBLIQUE = (0.54, 0.62, 0.57)
"""A direction across which no mesh lies: numbers of vertices are others on other ranks."""

EQUAL = 1e-6
"""Relative difference of squared lengths up to which which is longer is a matter of rounding."""


@leaf()
def frame(p, kind, n, turn):  # type: ignore[no-untyped-def]
    """Let turn (4, 3) be the d_i of a pair between sheets at p (4, 3), without the distance as a factor; the
    square [m²] of the lever that p has in the direction in which it is least.

    The normal n (3,) turns with the sheet, by the gradients of barycentric coordinates with the triangle, or
    with both edges: Σ d_i = 0 on each side, Σ d_i ⊗ p_i = I in the plane, and these are the least.
    """
    first = 0 if kind == EDGE_EDGE else 1
    xx = xy = xz = yy = yz = zz = 0.0
    for i in range(first, 4):
        low, high = (0, 2) if i < 2 and first == 0 else (2 - first, 4)
        height, size = 0.0, high - low
        for k in range(3):
            mean = 0.0
            for j in range(low, high):
                mean += p[j, k]
            turn[i, k] = p[i, k] - mean / size
            height += turn[i, k] * n[k]
        for k in range(3):
            turn[i, k] -= height * n[k]
        a, b, c = turn[i, 0], turn[i, 1], turn[i, 2]
        xx, xy, xz, yy, yz, zz = xx + a * a, xy + a * b, xz + a * c, yy + b * b, yz + b * c, zz + c * c
    for k in range(3):
        turn[0, k] = turn[0, k] if first == 0 else 0.0
    total = xx + yy + zz
    # along n, too, there shall be something to be inverted
    one = xx + total * n[0] * n[0], xy + total * n[0] * n[1], xz + total * n[0] * n[2]
    two = one[1], yy + total * n[1] * n[1], yz + total * n[1] * n[2]
    three = one[2], two[2], zz + total * n[2] * n[2]
    u, v, w = cross(two, three), cross(three, one), cross(one, two)
    det = dot(one, u)
    product = det / total if total > 0.0 else 0.0
    if not product > FLAT * total * total:
        turn[:] = 0.0
        return 0.0
    for i in range(first, 4):
        r = turn[i, 0], turn[i, 1], turn[i, 2]
        turn[i, 0], turn[i, 1], turn[i, 2] = dot(u, r) / det, dot(v, r) / det, dot(w, r) / det
    return product / (0.5 * total + math.sqrt(max(0.25 * total * total - product, 0.0)))


@leaf()
def _tangents(n):  # type: ignore[no-untyped-def]
    """Two unit vectors across n and each other.

    Duff, Burgess, Christensen, Hery, Kensler, Liani & Villemin, Building an orthonormal basis, revisited,
    Journal of Computer Graphics Techniques 6 (2017) 1-8.
    """
    sign = math.copysign(1.0, n[2])
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    return (1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), (b, sign + n[1] * n[1] * a, -n[1])


@leaf()
def _way(x, e, stencil, ways, still):  # type: ignore[no-untyped-def]
    """The components of u of pair e, and |u|."""
    one, other = still[e, 0], still[e, 1]
    for i in range(4):
        row = Index(stencil[e, i])
        for k in range(3):
            one += ways[e, 0, i, k] * x[row, k]
            other += ways[e, 1, i, k] * x[row, k]
    return one, other, math.sqrt(one * one + other * other)


@leaf()
def _pull(x, e, stencil, ways, still, stiffness, limit):  # type: ignore[no-untyped-def]
    """∂D/∂u [N] of pair e, its components."""
    one, other, size = _way(x, e, stencil, ways, still)
    factor = stiffness[e] if stiffness[e] * size <= limit[e] else limit[e] / size
    return factor * one, factor * other


@leaf()
def _of(ways, e, component, i):  # type: ignore[no-untyped-def]
    """w of a component and vertex i of pair e."""
    return ways[e, component, i, 0], ways[e, component, i, 1], ways[e, component, i, 2]


@kernel()
def energies(x, stencil, ways, still, stiffness, limit, out):  # type: ignore[no-untyped-def]
    """D [J] of the first len(out) pairs."""
    for e in range(len(out)):
        _, _, size = _way(x, e, stencil, ways, still)
        k, most = stiffness[e], limit[e]
        out[e] = 0.5 * k * size * size if k * size <= most else most * (size - 0.5 * most / k)


@kernel()
def add_gradient(x, stencil, ways, still, stiffness, limit, out):  # type: ignore[no-untyped-def]
    """Add the gradient [N] to rows of out (n_local, 3)."""
    for e in range(len(stencil)):
        one, other = _pull(x, e, stencil, ways, still, stiffness, limit)
        for i in range(4):
            row = Index(stencil[e, i])
            for k in range(3):
                out[row, k] += one * ways[e, 0, i, k] + other * ways[e, 1, i, k]


@kernel()
def add_moments(x, stencil, ways, still, stiffness, limit, out):  # type: ignore[no-untyped-def]
    """Add the moments [N m] of the gradients of pairs between sheets to out (E, 3)."""
    for e in range(len(stencil)):
        one, other = _pull(x, e, stencil, ways, still, stiffness, limit)
        foot = point(x, stencil[e, 0])
        for i in range(1, 4):
            force = combined(one, _of(ways, e, 0, i), other, _of(ways, e, 1, i))
            moment = cross(minus(point(x, stencil[e, i]), foot), force)
            for k in range(3):
                out[e, k] += moment[k]


@kernel()
def add_hessians(x, stencil, ways, still, stiffness, limit, weight, blend, offsets, values):  # type: ignore[no-untyped-def]  # fmt: skip
    """Add weight (E,) times the Hessians [N/m], all positive semidefinite, to block rows values (n, 3, 3).

    ``offsets`` (E, 10) as of `kernels.scatter`. ``blend`` 0 is exact; 1 takes a spring of the stiffness
    μ N / |u| for what slides, whose energy is nowhere less.
    """
    blocks = values.reshape(-1, 9)
    for e in range(len(stencil)):
        fetch_ahead(e, offsets, blocks, 10)
        one, other, size = _way(x, e, stencil, ways, still)
        sticks = stiffness[e] * size <= limit[e]
        factor = weight[e] * (stiffness[e] if sticks else limit[e] / size)
        less = 0.0 if sticks else (1.0 - blend) * factor / (size * size)
        across, mixed, along = factor - less * one * one, -less * one * other, factor - less * other * other
        for b in range(4):
            v, w = _of(ways, e, 0, b), _of(ways, e, 1, b)
            if dot(v, v) == 0.0 and dot(w, w) == 0.0:  # a point of an obstacle
                continue
            right, other_right = combined(across, v, mixed, w), combined(mixed, v, along, w)
            for a in range(b + 1):
                pairs = (_of(ways, e, 0, a), right), (_of(ways, e, 1, a), other_right)
                add_outers(blocks, offsets[e, (7 - a) * a // 2 + b], 0.0, pairs)


@kernel()
def slide(x, stencil, ways, still, stiffness, limit, tangents, slip, heat, slides):  # type: ignore[no-untyped-def]  # fmt: skip
    """Let ``slip`` (E, 3), what has gone into ``still``, be the elastic part of u; the work [J] that sliding
    takes and whether pairs do, (E,).
    """
    for e in range(len(stencil)):
        one, other, size = _way(x, e, stencil, ways, still)
        u, elastic = (one, other), limit[e] / stiffness[e]
        heat[e], slides[e] = 0.0, size > elastic
        for c in range(2):
            before = 0.0
            for k in range(3):
                before += tangents[e, c, k] * slip[e, k]
            for k in range(3):
                slip[e, k] += (u[c] - before) * tangents[e, c, k]
        if size > elastic:
            heat[e] = limit[e] * (size - elastic)
            for k in range(3):
                slip[e, k] *= elastic / size


@kernel()
def choose(x, stencil, points, number, kind, obstacle, beta, normal, at):  # type: ignore[no-untyped-def]
    """Of pairs ``at`` (E,) between a vertex and an edge or vertex of a sheet take the one with the triangle
    around that whose plane turns with them, and its β (E, 4): one with a normal near theirs, and of these the
    one farthest along `OBLIQUE`, which is the same on any ranks.
    """
    ours, first, following = np.empty(4), np.full(len(x), -1), np.empty(len(kind), dtype=np.int64)
    for e in range(len(kind)):  # pairs of a vertex with several patches are not next to each other
        if kind[e] == VERTEX_TRIANGLE and obstacle[e] < 0:
            row = Index(points[e, 0])
            following[e], first[row] = first[row], e
    for m in range(len(at)):
        e = at[m]
        if kind[e] != VERTEX_TRIANGLE or obstacle[e] >= 0:
            continue
        nearest = _round_off(x, stencil, e, beta, normal, m)
        if nearest == 3:
            continue
        best, farthest, one = -1.0, -math.inf, e
        other = first[Index(points[e, 0])]
        while other >= 0:
            common, far = 0, 0.0
            for i in range(1, 4):
                common += 1 if _beta_of(number, beta, m, e, number[other, i]) != 0.0 else 0
                far += dot(OBLIQUE, point(x, stencil[other, i]))
            if common == nearest:
                cosine = _cosine(x, stencil, other, normal, m)
                if (cosine > best and best < UPRIGHT) or (cosine >= UPRIGHT and far > farthest):
                    best, farthest, one = cosine, far, other
            other = following[other]
        for i in range(4):
            ours[i] = beta[m, 0] if i == 0 else _beta_of(number, beta, m, e, number[one, i])
        for i in range(4):
            beta[m, i] = ours[i]
        at[m] = one


@leaf()
def _round_off(x, stencil, e, beta, normal, m):  # type: ignore[no-untyped-def]
    """Let what is `ON_EDGE` of the triangle of pair e be nearest to that, by β and the normal in row m; how
    many vertices it is nearest to then.
    """
    largest, nearest, less = 1, 3, 0.0
    for i in range(2, 4):
        largest = i if abs(beta[m, i]) > abs(beta[m, largest]) else largest
    for i in range(1, 4):
        if abs(beta[m, i]) < ON_EDGE:
            less, nearest, beta[m, i] = less + beta[m, i], nearest - 1, 0.0
    if less != 0.0:
        beta[m, largest] += less
        gap = 0.0, 0.0, 0.0
        for i in range(4):
            b, there = beta[m, i], point(x, stencil[e, i])
            gap = gap[0] + b * there[0], gap[1] + b * there[1], gap[2] + b * there[2]
        length = math.sqrt(dot(gap, gap))
        for k in range(3):
            normal[m, k] = gap[k] / length
    return nearest


@leaf()
def _beta_of(number, beta, m, e, vertex):  # type: ignore[no-untyped-def]
    """β of a vertex of the triangle of pair e, from row m; 0 of others."""
    for i in range(1, 4):
        if number[e, i] == vertex:
            return beta[m, i]
    return 0.0


@leaf()
def _cosine(x, stencil, e, normal, m):  # type: ignore[no-untyped-def]
    """|cos| of the angle between the normal in row m and that of the triangle of pair e."""
    a, b, c = point(x, stencil[e, 1]), point(x, stencil[e, 2]), point(x, stencil[e, 3])
    out = cross(minus(b, a), minus(c, a))
    size = math.sqrt(dot(out, out))
    along = out[0] * normal[m, 0] + out[1] * normal[m, 1] + out[2] * normal[m, 2]
    return abs(along) / size if size > 0.0 else 0.0


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
    """What is known of pairs with keys (E, 10), into what (E, 34), at positions x (n_local, 3).

    ``touching`` are their numbers among ``stencil`` and ``points``, β, unit normals and normal forces; those
    with a number in ``same`` (E,) of 0 or more go on that row of ``old`` (M, 34).
    """
    numbers, beta, normal, force = touching
    p, turn = np.empty((4, 3)), np.empty((4, 3))
    for m in range(len(numbers)):
        e, side, along = numbers[m], 0.0, 0.0
        for k in range(6):
            what[m, k] = keys[m, 4 + k]
        for i in range(4):
            share = beta[m, i] if points[e, i] >= 0 else 0.0
            what[m, BETA + i] = share
            side += share
        distance = 0.0
        for k in range(3):
            start = 0.0
            for i in range(4):
                start += what[m, BETA + i] * x[Index(stencil[e, i]), k]
            what[m, NORMAL + k], what[m, START + k] = normal[m, k], start
            what[m, FOOT + k] = side * start if abs(side) > 0.5 else 0.0  # where the other is an obstacle
            what[m, SLIP + k] = old[same[m], SLIP + k] if same[m] >= 0 else 0.0
            along += what[m, SLIP + k] * normal[m, k]
            distance += start * normal[m, k]
        what[m, GRIP], turn[:] = 1.0, 0.0
        if keys[m, 5] < 0:
            for i in range(4):
                for k in range(3):
                    p[i, k] = x[Index(stencil[e, i]), k]
            lever = frame(p, keys[m, 4], normal[m], turn)
            what[m, GRIP] = min(lever / (LEVER * distance) ** 2, 1.0)
        for i in range(1, 4):
            height = 0.0
            for k in range(3):
                turn[i, k] *= distance
                height += normal[m, k] * (x[Index(stencil[e, i]), k] - x[Index(stencil[e, 0]), k])
            for k in range(3):
                what[m, TURN + 3 * i - 3 + k] = turn[i, k]
                what[m, START + k] += height * turn[i, k]
        for k in range(3):
            what[m, SLIP + k] -= along * normal[m, k]
        what[m, SLID], what[m, FORCE] = old[same[m], SLID] if same[m] >= 0 else 0.0, force[m]


@kernel()
def unpack(what, beta, tangents, ways, still, slip, foot):  # type: ignore[no-untyped-def]
    """What the kernels take of rows of what (E, 34): β (E, 4), t (E, 2, 3), w (E, 2, 4, 3), still (E, 2), ξ
    and where an obstacle is touched (E, 3).
    """
    for e in range(len(what)):
        n = what[e, NORMAL], what[e, NORMAL + 1], what[e, NORMAL + 2]
        across = _tangents(n)
        for i in range(4):
            beta[e, i] = what[e, BETA + i]
        for k in range(3):
            slip[e, k], foot[e, k] = what[e, SLIP + k], what[e, FOOT + k]
        for c in range(2):
            t, couples, still[e, c] = across[c], 0.0, 0.0
            for k in range(3):
                tangents[e, c, k] = t[k]
                still[e, c] += t[k] * (slip[e, k] - what[e, START + k])
            for i in range(3, -1, -1):
                couple = -couples  # of all d_i together there is none
                if i > 0:
                    at = TURN + 3 * i - 3
                    couple = t[0] * what[e, at] + t[1] * what[e, at + 1] + t[2] * what[e, at + 2]
                couples += couple
                for k in range(3):
                    ways[e, c, i, k] = beta[e, i] * t[k] + couple * n[k]


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


@leaf()
def _precedes(keys, a, others, b):  # type: ignore[no-untyped-def]
    """Whether the key in row a comes before that of others in row b."""
    for k in range(10):
        if keys[a, k] != others[b, k]:
            return keys[a, k] < others[b, k]
    return False


@kernel()
def find(keys, among, what, place):  # type: ignore[no-untyped-def]
    """Which row of ``among`` (M, 10) goes on in each row of keys (N, 10), −1 where none does; both ascend.

    Of several that are as much alike the one with the longer elastic part, in their rows of ``what`` (M, 34);
    of those that slide, whose elastic parts are equally long, the one with the larger normal force.
    """
    room = 1
    while room < 2 * len(among):
        room *= 2
    first, following = np.full(room, -1), np.empty(len(among), dtype=np.int64)
    for b in range(len(among)):
        row = Index(among[b, 0] & (room - 1))
        following[b], first[row] = first[row], b
    there = 0  # the first row of ``among`` that does not come before the key
    for a in range(len(keys)):
        while there < len(among) and _precedes(among, there, keys, a):
            there += 1
        alone = there + 1 >= len(among) or _precedes(among, there, among, there + 1)
        if there < len(among) and alone and not _precedes(keys, a, among, there):
            place[a] = there  # the same key: none is more alike
            continue
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
