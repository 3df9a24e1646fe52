"""Coulomb friction of pairs in contact during one step: pure functions on arrays.

With the normal n, the normal force N and the coefficients β of the last accepted state, the slip of a pair,
which includes the elastic slip ξ of earlier steps, is

    u = (I − n nᵀ) (Σ β_i x_i − c) + Σ d_i (n · x_i − h_i) + ξ,

where c and h_i are the values of the sum and of n · x_i in that state. For a moving obstacle c is the value
that the sum would have if the pair stuck, and d_i = 0. Between sheets the second sum subtracts a common
rotation of both: n rotates with the triangle, or with both edges, which determines the vectors d_i
perpendicular to n (`rotation_vectors`). As nearest points are a distance apart, any rotation would otherwise
be a slip, and the forces at them would have a moment; so they have none in the accepted state. In a step only
the components of u along two unit vectors t_c perpendicular to n are needed::

    u_c = Σ w_ci · x_i + constant_c,  w_ci = β_i t_c + (d_i · t_c) n

The pair sticks like a spring of stiffness k up to the force μ N and slides beyond it. The potential of this
force is convex::

    D = ½ k |u|²  for k |u| ≤ μ N,  else  μ N |u| − (μ N)² / 2k

Simo & Laursen, An augmented Lagrangian treatment of contact problems involving friction, Computers &
Structures 42 (1992) 97-116 (return mapping), with the normal force of the last step.

In all functions x (n_local, 3) [m] are positions, ``stencil`` (E, 4) local rows, ``gradients`` (E, 2, 4, 3)
w, ``constant`` (E, 2) [m], ``stiffness`` (E,) k [N/m] and ``limit`` (E,) μ N [N].
"""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.contact.pair_distances import EDGE_EDGE, PARALLEL, VERTEX_TRIANGLE
from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import kernel, leaf
from lyra_petsc.kernels.scatter import fetch_ahead
from lyra_petsc.kernels.vector3 import combined, cross, dot, minus, point
from lyra_petsc.kernels.vectors import add_outers

LEVER = 0.25
"""Smallest lever (in the least favourable direction) of the vertices around nearest points over their
distance. With a shorter lever the forces of the couple would be large; friction is reduced instead, to 0 for
no lever."""

PARALLEL_COSINE = 0.7
"""Cosine of the angle of two normals above which they count as equal."""

TIE = 1e-6
"""Barycentric coordinate below which a point counts as being on an edge, and relative difference up to which
squared lengths count as equal: where meshes lie on each other in line, rounding would decide."""

TIE_BREAK = (0.54, 0.62, 0.57)
"""Direction in which triangles are compared, because numbers of vertices depend on the number of ranks;
meshes are hardly ever symmetric to it."""


@leaf()
def rotation_vectors(p, kind, n, rotation):  # type: ignore[no-untyped-def]
    """Write the d_i of a pair between sheets at p (4, 3), for a distance of 1, to rotation (4, 3); returns
    the square [m²] of the lever of p in the least favourable direction.

    The normal n (3,) rotates with the triangle or with both edges: the d_i have the least norm for which Σ
    d_i = 0 on each side and Σ d_i ⊗ p_i = I in the plane perpendicular to n.
    """
    start = 0 if kind == EDGE_EDGE else 1
    xx = xy = xz = yy = yz = zz = 0.0
    for i in range(start, 4):
        begin, end = (0, 2) if i < 2 and start == 0 else (2 - start, 4)
        height, size = 0.0, end - begin
        for k in range(3):
            mean = 0.0
            for j in range(begin, end):
                mean += p[j, k]
            rotation[i, k] = p[i, k] - mean / size
            height += rotation[i, k] * n[k]
        for k in range(3):
            rotation[i, k] -= height * n[k]
        a, b, c = rotation[i, 0], rotation[i, 1], rotation[i, 2]
        xx, xy, xz, yy, yz, zz = xx + a * a, xy + a * b, xz + a * c, yy + b * b, yz + b * c, zz + c * c
    for k in range(3):
        rotation[0, k] = rotation[0, k] if start == 0 else 0.0
    total = xx + yy + zz
    # the term along n makes the matrix invertible
    one = xx + total * n[0] * n[0], xy + total * n[0] * n[1], xz + total * n[0] * n[2]
    two = one[1], yy + total * n[1] * n[1], yz + total * n[1] * n[2]
    three = one[2], two[2], zz + total * n[2] * n[2]
    u, v, w = cross(two, three), cross(three, one), cross(one, two)
    det = dot(one, u)
    product = det / total if total > 0.0 else 0.0
    if not product > PARALLEL * total * total:
        rotation[:] = 0.0
        return 0.0
    for i in range(start, 4):
        r = rotation[i, 0], rotation[i, 1], rotation[i, 2]
        rotation[i, 0], rotation[i, 1], rotation[i, 2] = dot(u, r) / det, dot(v, r) / det, dot(w, r) / det
    return product / (0.5 * total + math.sqrt(max(0.25 * total * total - product, 0.0)))


@leaf()
def _tangents(n):  # type: ignore[no-untyped-def]
    """Two unit vectors perpendicular to n and to each other.

    Duff, Burgess, Christensen, Hery, Kensler, Liani & Villemin, Building an orthonormal basis, revisited,
    Journal of Computer Graphics Techniques 6 (2017) 1-8.
    """
    sign = math.copysign(1.0, n[2])
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    return (1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), (b, sign + n[1] * n[1] * a, -n[1])


@leaf()
def _slip(x, e, stencil, gradients, constant):  # type: ignore[no-untyped-def]
    """u_1, u_2 and |u| of pair e."""
    u1, u2 = constant[e, 0], constant[e, 1]
    for i in range(4):
        row = Index(stencil[e, i])
        for k in range(3):
            u1 += gradients[e, 0, i, k] * x[row, k]
            u2 += gradients[e, 1, i, k] * x[row, k]
    return u1, u2, math.sqrt(u1 * u1 + u2 * u2)


@leaf()
def _force(x, e, stencil, gradients, constant, stiffness, limit):  # type: ignore[no-untyped-def]
    """The components of ∂D/∂u [N] of pair e."""
    u1, u2, norm = _slip(x, e, stencil, gradients, constant)
    factor = stiffness[e] if stiffness[e] * norm <= limit[e] else limit[e] / norm
    return factor * u1, factor * u2


@leaf()
def _gradient(gradients, e, component, i):  # type: ignore[no-untyped-def]
    """w of a component and vertex i of pair e."""
    return gradients[e, component, i, 0], gradients[e, component, i, 1], gradients[e, component, i, 2]


@kernel()
def energies(x, stencil, gradients, constant, stiffness, limit, out):  # type: ignore[no-untyped-def]
    """Write D [J] of the first len(out) pairs to out."""
    for e in range(len(out)):
        _, _, norm = _slip(x, e, stencil, gradients, constant)
        k, limit_e = stiffness[e], limit[e]
        out[e] = 0.5 * k * norm * norm if k * norm <= limit_e else limit_e * (norm - 0.5 * limit_e / k)


@kernel()
def add_gradient(x, stencil, gradients, constant, stiffness, limit, out):  # type: ignore[no-untyped-def]
    """Add the gradients [N] to out (n_local, 3)."""
    for e in range(len(stencil)):
        f1, f2 = _force(x, e, stencil, gradients, constant, stiffness, limit)
        for i in range(4):
            row = Index(stencil[e, i])
            for k in range(3):
                out[row, k] += f1 * gradients[e, 0, i, k] + f2 * gradients[e, 1, i, k]


@kernel()
def add_hessians(x, stencil, gradients, constant, stiffness, limit, weight, convexity, offsets, values):  # type: ignore[no-untyped-def]  # fmt: skip
    """Add weight (E,) times the Hessians [N/m], all positive semidefinite, to block rows values (n, 3, 3).

    ``offsets`` (E, 10) as in `kernels.scatter`. ``convexity`` 0 is exact; 1 replaces sliding by a spring
    of the secant stiffness μ N / |u|, whose energy is an upper bound.
    """
    blocks = values.reshape(-1, 9)
    for e in range(len(stencil)):
        fetch_ahead(e, offsets, blocks, 10)
        u1, u2, norm = _slip(x, e, stencil, gradients, constant)
        sticks = stiffness[e] * norm <= limit[e]
        factor = weight[e] * (stiffness[e] if sticks else limit[e] / norm)
        reduction = 0.0 if sticks else (1.0 - convexity) * factor / (norm * norm)
        h11, h12, h22 = factor - reduction * u1 * u1, -reduction * u1 * u2, factor - reduction * u2 * u2
        for b in range(4):
            v, w = _gradient(gradients, e, 0, b), _gradient(gradients, e, 1, b)
            if dot(v, v) == 0.0 and dot(w, w) == 0.0:  # a point of an obstacle
                continue
            right, second_right = combined(h11, v, h12, w), combined(h12, v, h22, w)
            for a in range(b + 1):
                pairs = (_gradient(gradients, e, 0, a), right), (_gradient(gradients, e, 1, a), second_right)
                add_outers(blocks, offsets[e, (7 - a) * a // 2 + b], 0.0, pairs)


@kernel()
def return_map(x, stencil, gradients, constant, stiffness, limit, tangents, slip, heat, slides):  # type: ignore[no-untyped-def]  # fmt: skip
    """Return mapping: update the elastic slip ξ, ``slip`` (E, 3); writes the heat [J] and whether pairs
    slide, (E,).

    ``constant`` includes the slip before the step.
    """
    for e in range(len(stencil)):
        u1, u2, norm = _slip(x, e, stencil, gradients, constant)
        u, elastic_limit = (u1, u2), limit[e] / stiffness[e]
        heat[e], slides[e] = 0.0, norm > elastic_limit
        for c in range(2):
            before = 0.0
            for k in range(3):
                before += tangents[e, c, k] * slip[e, k]
            for k in range(3):
                slip[e, k] += (u[c] - before) * tangents[e, c, k]
        if norm > elastic_limit:
            heat[e] = limit[e] * (norm - elastic_limit)
            for k in range(3):
                slip[e, k] *= elastic_limit / norm


@kernel()
def choose_triangles(x, stencil, points, number, kind, obstacle, beta, normal, at):  # type: ignore[no-untyped-def]
    """For pairs ``at`` (E,) whose nearest point is on an edge or vertex of a sheet, choose the triangle
    around it that defines the rotation of the normal; overwrites at and β (E, 4).

    The triangle's normal must be near that of the pair. Of several, the one farthest along `TIE_BREAK` is
    taken, which does not depend on the number of ranks.
    """
    new_beta, head, link = np.empty(4), np.full(len(x), -1), np.empty(len(kind), dtype=np.int64)
    for e in range(len(kind)):  # pairs of one vertex need not follow each other
        if kind[e] == VERTEX_TRIANGLE and obstacle[e] < 0:
            row = Index(points[e, 0])
            link[e], head[row] = head[row], e
    for m in range(len(at)):
        e = at[m]
        if kind[e] != VERTEX_TRIANGLE or obstacle[e] >= 0:
            continue
        nearest = _snap_to_edges(x, stencil, e, beta, normal, m)
        if nearest == 3:
            continue
        best_cosine, farthest, chosen = -1.0, -math.inf, e
        other = head[Index(points[e, 0])]
        while other >= 0:
            common, along = 0, 0.0
            for i in range(1, 4):
                common += 1 if _vertex_beta(number, beta, m, e, number[other, i]) != 0.0 else 0
                along += dot(TIE_BREAK, point(x, stencil[other, i]))
            if common == nearest:
                cosine = _cosine(x, stencil, other, normal, m)
                better = cosine > best_cosine and best_cosine < PARALLEL_COSINE
                if better or (cosine >= PARALLEL_COSINE and along > farthest):
                    best_cosine, farthest, chosen = cosine, along, other
            other = link[other]
        for i in range(4):
            new_beta[i] = beta[m, 0] if i == 0 else _vertex_beta(number, beta, m, e, number[chosen, i])
        for i in range(4):
            beta[m, i] = new_beta[i]
        at[m] = chosen


@leaf()
def _snap_to_edges(x, stencil, e, beta, normal, m):  # type: ignore[no-untyped-def]
    """Move a nearest point that is within `TIE` of an edge or vertex of its triangle there, with β
    and the normal in row m; returns the number of vertices with non-zero β.
    """
    largest, nearest, removed = 1, 3, 0.0
    for i in range(2, 4):
        largest = i if abs(beta[m, i]) > abs(beta[m, largest]) else largest
    for i in range(1, 4):
        if abs(beta[m, i]) < TIE:
            removed, nearest, beta[m, i] = removed + beta[m, i], nearest - 1, 0.0
    if removed != 0.0:
        beta[m, largest] += removed
        g = 0.0, 0.0, 0.0
        for i in range(4):
            b, place = beta[m, i], point(x, stencil[e, i])
            g = g[0] + b * place[0], g[1] + b * place[1], g[2] + b * place[2]
        length = math.sqrt(dot(g, g))
        for k in range(3):
            normal[m, k] = g[k] / length
    return nearest


@leaf()
def _vertex_beta(number, beta, m, e, vertex):  # type: ignore[no-untyped-def]
    """β in row m of a vertex of the triangle of pair e; 0 for other vertices."""
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
def write_keys(points, number, kind, obstacle, beta, at, out):  # type: ignore[no-untyped-def]
    """Write the keys that identify pairs ``at`` (E,) with β (E, 4) to out (E, 10).

    For a vertex of a sheet and a triangle only the vertices with non-zero β count.
    """
    for m in range(len(at)):
        e, first = at[m], 1
        is_vertex = kind[e] == VERTEX_TRIANGLE and points[e, 0] >= 0
        while is_vertex and first < 3 and beta[m, first] == 0.0:
            first += 1
        first = 1 if beta[m, first] == 0.0 else first
        out[m, 4], out[m, 5] = kind[e], obstacle[e]
        for i in range(4):
            column = first if is_vertex and i > 0 and beta[m, i] == 0.0 else i
            out[m, i], out[m, 6 + i] = number[e, column], min(points[e, column], 0)


@kernel()
def measure(x, stencil, points, keys, pair, beta, normal, out):  # type: ignore[no-untyped-def]
    """Write the geometry of pairs with keys (E, 10) at positions x to ``out``: `FrictionPairs.tangents`,
    ``gradients``, ``start``, ``contact_point`` and ``factor``; β (E, 4) of obstacles' points become 0.

    ``pair`` (E,) are their numbers among ``stencil`` and ``points``, ``normal`` (E, 3) unit normals.
    """
    tangents, gradients, starts, contact_point, factor = out
    p, rotation = np.empty((4, 3)), np.empty((4, 3))
    for m in range(len(pair)):
        e, side, distance = pair[m], 0.0, 0.0
        for i in range(4):
            beta[m, i] = beta[m, i] if points[e, i] >= 0 else 0.0
            side += beta[m, i]
        for k in range(3):
            place = 0.0
            for i in range(4):
                p[i, k] = x[Index(stencil[e, i]), k]
                place += beta[m, i] * p[i, k]
            distance += place * normal[m, k]
            contact_point[m, k] = side * place if abs(side) > 0.5 else 0.0  # 0 between sheets
        factor[m], rotation[:] = 1.0, 0.0
        if keys[m, 5] < 0:
            lever = rotation_vectors(p, keys[m, 4], normal[m], rotation)
            factor[m] = min(lever / (LEVER * distance) ** 2, 1.0)
        n = normal[m, 0], normal[m, 1], normal[m, 2]
        tangent_pair = _tangents(n)
        for c in range(2):
            t, total, start = tangent_pair[c], 0.0, 0.0
            for i in range(3, -1, -1):
                turn = -total  # Σ d_i = 0
                if i > 0:
                    turn = distance * dot(t, (rotation[i, 0], rotation[i, 1], rotation[i, 2]))
                total += turn
                for k in range(3):
                    gradients[m, c, i, k] = beta[m, i] * t[k] + turn * n[k]
                    start += gradients[m, c, i, k] * p[i, k]
            starts[m, c] = start
            for k in range(3):
                tangents[m, c, k] = t[k]


@leaf()
def _is_new(key, begin, i):  # type: ignore[no-untyped-def]
    """Whether entry i of a key differs from the entries from ``begin`` on before it."""
    return i == begin or (key[i] != key[begin] and (i == begin + 1 or key[i] != key[i - 1]))


@leaf()
def _similarity(keys, a, old, b):  # type: ignore[no-untyped-def]
    """Similarity of two pairs with keys (10,) in rows a and b and the same first vertex; −1 if they are not
    the same contact. A contact of a vertex with triangles is the same if these have a nearest vertex in
    common.
    """
    first, second = keys[a], old[b]
    if first[4] != second[4] or first[5] != second[5] or first[6] != second[6]:
        return -1
    if first[4] != VERTEX_TRIANGLE or first[6] != 0:
        for k in range(10):
            if first[k] != second[k]:
                return -1
        return 20
    begin, common, n_first, n_second = 7 if first[5] >= 0 else 1, 0, 0, 0
    for i in range(begin, begin + 3):
        n_first += 1 if _is_new(first, begin, i) else 0
        if not _is_new(second, begin, i):
            continue
        n_second += 1
        for j in range(begin, begin + 3):
            if first[j] == second[i]:
                common += 1
                break
    if first[5] < 0 and common == 0:
        return -1
    return 10 + 2 * common - n_first - n_second


@leaf()
def _precedes(keys, a, others, b):  # type: ignore[no-untyped-def]
    """Whether the key in row a precedes that of others in row b."""
    for k in range(10):
        if keys[a, k] != others[b, k]:
            return keys[a, k] < others[b, k]
    return False


@kernel()
def match_pairs(keys, old, slip, forces, rows):  # type: ignore[no-untyped-def]
    """Find the row of old (M, 10) that each of keys (N, 10) continues, −1 for none; both are in ascending
    order.

    Of several equally similar pairs the one with the longest elastic slip (M, 3) is chosen; of sliding pairs,
    which have equal elastic slip, the one with the largest of the normal ``forces`` (M,).
    """
    size = 1
    while size < 2 * len(old):
        size *= 2
    head, link = np.full(size, -1), np.empty(len(old), dtype=np.int64)
    for b in range(len(old)):
        row = Index(old[b, 0] & (size - 1))
        link[b], head[row] = head[row], b
    candidate = 0  # the first row of ``old`` that does not precede the key
    for a in range(len(keys)):
        while candidate < len(old) and _precedes(old, candidate, keys, a):
            candidate += 1
        alone = candidate + 1 >= len(old) or _precedes(old, candidate, old, candidate + 1)
        if candidate < len(old) and alone and not _precedes(keys, a, old, candidate):
            rows[a] = candidate  # the same key
            continue
        rows[a], best_fit, longest, largest = -1, -1, 0.0, 0.0
        b = head[Index(keys[a, 0] & (size - 1))]
        while b >= 0:
            if old[b, 0] == keys[a, 0]:
                fits, length = _similarity(keys, a, old, b), 0.0
                for k in range(3):
                    length += slip[b, k] * slip[b, k]
                force, longer = forces[b], length > longest * (1.0 + TIE)
                longer = longer or (length >= longest * (1.0 - TIE) and force > largest)
                if fits >= 0 and (fits > best_fit or (fits == best_fit and longer)):
                    rows[a], best_fit, longest, largest = b, fits, length, force
            b = link[b]
