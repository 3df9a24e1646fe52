"""The energy of bending by directors on edges, its gradient and Hessian: pure functions on arrays.

Per triangle, with the tangents T and S of ``midedge_shape`` and constants K (3 × 3) and T̄::

    energy = w (½ Σ_i K_ii (T_i − T̄_i)² + Σ_{i<j} K_ij (S_i − S̄_i) (S_j − S̄_j))

With angles up to 45° that is ½ w fᵀ K f of f = T − T̄.

w is 1 but for triangles that have lost nine tenths of their area, with which it vanishes as in
``hinge_energy``: they have hardly a normal. Of director angles φ, normal n, area A and barycentric
coordinates b_c the derivatives of α_i are

    ∂α_i/∂x_c = ω n ± γ_i,   ω = −e_i · e_c / (2A |e_i|),     ∂α_i/∂φ_i = s_i

with γ_i at both ends of the edge only, + at its head, and s_i = ±1 as the triangle runs along the edge or
against it. The second derivatives are, as for the angle of a hinge (``hinge.triangle_turn``),

    −ω_d n ∇b_cᵀ − ω_c ∇b_d nᵀ + σ_c σ_d (n τᵀ + τ nᵀ) − ½ σ_c σ_d s_i (γ ρᵀ + ρ γᵀ),   τ = −m_i / (2 |e_i|²)

with σ = 1 and −1 at the ends of the edge and 0 opposite it. ``blend`` 0 is exact, 1 the positive-semidefinite
∇f K ∇fᵀ.

``tangent`` (E, 4) is as of ``midedge_shape.tangents``, ``frame`` (n_edges, 3) are the directions of edges'
frames, of which γ is computed where it is wanted. Where ``rest``, T̄, is empty all of it is 0. With friction,
``friction`` (E, 2) has for each triangle a factor c and an energy [J]: by the latter the energy is more, and
by c p pᵀ, of the pulls p_i = ∂E/∂α_i, the exact Hessian; without, it is empty.
"""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import kernel
from lyra_petsc.kernels.vectors import add_corners, fetch
from lyra_petsc.terms.hinge import cross, dot, point, scaled
from lyra_petsc.terms.hinge_energy import GONE, add_square_hessian, fade
from lyra_petsc.terms.midedge_shape import (
    BATCH,
    derivatives,
    fading_tangent,
    got,
    load_edges,
    plain_derivatives,
    put,
    row,
    spin,
)

AHEAD = 4
"""Triangles by which blocks are fetched before they are added to: each takes longer than other elements."""


@kernel(inline="always")
def _six(stiffness, e):  # type: ignore[no-untyped-def]
    """K of triangle e: 00, 01, 02, 11, 12, 22."""
    k = stiffness
    return k[e, 0], k[e, 1], k[e, 2], k[e, 3], k[e, 4], k[e, 5]


@kernel(inline="always")
def _at_rest(rest, e):  # type: ignore[no-untyped-def]
    """T̄ and S̄ of triangle e."""
    if rest.shape[0] == 0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    u0, u1, u2 = rest[e, 0], rest[e, 1], rest[e, 2]
    return u0, u1, u2, fading_tangent(u0), fading_tangent(u1), fading_tangent(u2)


@kernel(inline="always")
def _own(k, rest, t0, t1, t2):  # type: ignore[no-untyped-def]
    """K_ii (T_i − T̄_i) of a triangle, and the differences."""
    f0, f1, f2 = t0 - rest[0], t1 - rest[1], t2 - rest[2]
    return k[0] * f0, k[3] * f1, k[5] * f2, f0, f1, f2


@kernel(inline="always")
def _others(k, rest, s0, s1, s2):  # type: ignore[no-untyped-def]
    """Σ_j≠i K_ij (S_j − S̄_j) of a triangle, and the differences."""
    h0, h1, h2 = s0 - rest[3], s1 - rest[4], s2 - rest[5]
    return k[1] * h1 + k[2] * h2, k[1] * h0 + k[4] * h2, k[2] * h0 + k[4] * h1, h0, h1, h2


@kernel(inline="always")
def _twice(own, others):  # type: ignore[no-untyped-def]
    """Twice the energy, of what these two return."""
    return (
        own[0] * own[3]
        + own[1] * own[4]
        + own[2] * own[5]
        + others[0] * others[3]
        + others[1] * others[4]
        + others[2] * others[5]
    )


@kernel(inline="always")
def _more(friction, e):  # type: ignore[no-untyped-def]
    """Twice the energy that friction adds to that of triangle e."""
    return 2.0 * friction[e, 1] if friction.shape[0] > 0 else 0.0


@kernel()
def energies(tangent, stiffness, rest, limit, friction, out):  # type: ignore[no-untyped-def]
    """Energy [J] of the first len(out) triangles; infinite where an edge is too far from its frame."""
    for e in range(out.shape[0]):
        t0, t1, t2, square = tangent[e, 0], tangent[e, 1], tangent[e, 2], tangent[e, 3]
        if square <= GONE * limit[e]:
            out[e] = 0.0
            continue
        k, bar = _six(stiffness, e), _at_rest(rest, e)
        s0, s1, s2 = fading_tangent(t0), fading_tangent(t1), fading_tangent(t2)
        out[e] = 0.5 * (_twice(_own(k, bar, t0, t1, t2), _others(k, bar, s0, s1, s2)) + _more(friction, e))
        if square < limit[e]:
            out[e] *= fade(square, limit[e])[0]
        if not out[e] < np.inf:
            out[e] = np.inf


@kernel(inline="always")
def _along(f, u, v):  # type: ignore[no-untyped-def]
    """f u + v."""
    return f * u[0] + v[0], f * u[1] + v[1], f * u[2] + v[2]


@kernel(inline="always")
def _weighted(a, u, b, v, c, w):  # type: ignore[no-untyped-def]
    return (
        a * u[0] + b * v[0] + c * w[0],
        a * u[1] + b * v[1] + c * w[1],
        a * u[2] + b * v[2] + c * w[2],
    )


@kernel()
def _load(  # type: ignore[no-untyped-def]
    edges, sign, frame, tangent, stiffness, rest, friction, length, first, batch
):
    """Into rows 9 to 36 of a batch the frames' directions, as e_i runs, T, K, T̄ and S̄, ∂φ/∂(unknown) times
    s, and friction's c.

    T̄, S̄ and c that there are none of are left as they are.
    """
    last = edges.shape[0] - 1
    # several short loops take less time than one that reads everything
    for number in range(BATCH):
        e, i = min(first + number, last), Index(number)
        put(batch, 9, i, scaled(float(sign[e, 0]), row(frame, edges[e, 0], 0)))
        put(batch, 12, i, scaled(float(sign[e, 1]), row(frame, edges[e, 1], 0)))
        put(batch, 15, i, scaled(float(sign[e, 2]), row(frame, edges[e, 2], 0)))
    for number in range(BATCH):
        e, i = min(first + number, last), Index(number)
        put(batch, 18, i, row(tangent, e, 0))
        k = _six(stiffness, e)
        put(batch, 21, i, (k[0], k[1], k[2]))
        put(batch, 24, i, (k[3], k[4], k[5]))
    for number in range(BATCH):
        e, i = min(first + number, last), Index(number)
        q0, q1 = sign[e, 0] / length[edges[e, 0]], sign[e, 1] / length[edges[e, 1]]
        put(batch, 33, i, (q0, q1, sign[e, 2] / length[edges[e, 2]]))
    for number in range(BATCH if rest.shape[0] > 0 else 0):
        i = Index(number)
        bar = _at_rest(rest, min(first + number, last))
        put(batch, 27, i, (bar[0], bar[1], bar[2]))
        put(batch, 30, i, (bar[3], bar[4], bar[5]))
    for number in range(BATCH if friction.shape[0] > 0 else 0):
        batch[Index(BATCH * 36) + Index(number)] = friction[min(first + number, last), 0]


@kernel(inline="always")
def _loaded(batch, i):  # type: ignore[no-untyped-def]
    """What was loaded of triangle i: e_i, N, |N|², T and their derivatives up to 45°, γ_i, K, T̄ with S̄,
    ∂φ/∂(unknown) times s, friction's c.
    """
    e0, e1, e2 = got(batch, 0, i), got(batch, 3, i), got(batch, 6, i)
    normal = cross(e1, e2)
    spins = spin(got(batch, 9, i), e0), spin(got(batch, 12, i), e1), spin(got(batch, 15, i), e2)
    tangent = got(batch, 18, i)
    slopes = plain_derivatives(tangent[0]), plain_derivatives(tangent[1]), plain_derivatives(tangent[2])
    (k0, k1, k2), (k3, k4, k5) = got(batch, 21, i), got(batch, 24, i)
    (u0, u1, u2), (u3, u4, u5) = got(batch, 27, i), got(batch, 30, i)
    k, rest, q = (k0, k1, k2, k3, k4, k5), (u0, u1, u2, u3, u4, u5), got(batch, 33, i)
    c = batch[Index(BATCH * 36) + i]
    return e0, e1, e2, normal, dot(normal, normal), tangent, slopes, spins, k, rest, q, c


@kernel(inline="always")
def _pulls(k, rest, tangent, slopes):  # type: ignore[no-untyped-def]
    """p of a triangle, and what they are made of: as of `_own` and `_others`."""
    t0, t1, t2 = tangent
    (a0, _, s0, b0, _), (a1, _, s1, b1, _), (a2, _, s2, b2, _) = slopes
    own, others = _own(k, rest, t0, t1, t2), _others(k, rest, s0, s1, s2)
    p0, p1, p2 = own[0] * a0 + others[0] * b0, own[1] * a1 + others[1] * b1, own[2] * a2 + others[2] * b2
    return (p0, p1, p2), own, others


@kernel(inline="always")
def _forces(e0, e1, e2, normal, square, spins, pulls):  # type: ignore[no-untyped-def]
    """Σ_i p_i ∂α_i of the corners 1 and 2; of all three it is 0."""
    (p0, p1, p2), (g0, g1, g2) = pulls, spins
    n = scaled(1.0 / square, normal)  # over 2A
    q0, q1, q2 = p0 / math.sqrt(dot(e0, e0)), p1 / math.sqrt(dot(e1, e1)), p2 / math.sqrt(dot(e2, e2))
    pull = _weighted(q0, e0, q1, e1, q2, e2)
    return (
        _along(-dot(e1, pull), n, _weighted(p2, g2, -p0, g0, 0.0, g1)),
        _along(-dot(e2, pull), n, _weighted(p0, g0, -p1, g1, 0.0, g2)),
    )


@kernel()
def _compute_forces(batch):  # type: ignore[no-untyped-def]
    """Into rows 37 to 45 of a batch the gradients at the corners 1 and 2 and of the edges' unknowns, as if no
    angle were beyond 45°.
    """
    for number in range(BATCH):
        i = Index(number)
        e0, e1, e2, normal, square, tangent, slopes, spins, k, rest, q, _ = _loaded(batch, i)
        pulls, _, _ = _pulls(k, rest, tangent, slopes)
        one, two = _forces(e0, e1, e2, normal, square, spins, pulls)
        put(batch, 37, i, one)
        put(batch, 40, i, two)
        put(batch, 43, i, (q[0] * pulls[0], q[1] * pulls[1], q[2] * pulls[2]))


@kernel()
def add_gradient(  # type: ignore[no-untyped-def]
    x, stencil, edges, places, sign, frame, tangent, stiffness, rest, limit, friction, length, out
):
    """Add the energy's gradient [N] to out (n_local, 3); edge unknowns are φ times ``length`` (n_edges,)."""
    flat, batch = out.reshape(-1), np.zeros(46 * BATCH)
    for e in range(stencil.shape[0]):
        i = Index(e % BATCH)
        if i == 0:
            load_edges(x, stencil, e, batch)
            _load(edges, sign, frame, tangent, stiffness, rest, friction, length, e, batch)
            _compute_forces(batch)
        t0, t1, t2, square = tangent[e, 0], tangent[e, 1], tangent[e, 2], tangent[e, 3]
        if max(abs(t0), abs(t1), abs(t2)) < 1.0 and square >= limit[e]:
            one, two, moments = got(batch, 37, i), got(batch, 40, i), got(batch, 43, i)
        else:
            if square <= GONE * limit[e]:
                continue
            slopes = derivatives(t0), derivatives(t1), derivatives(t2)
            e0, e1, e2, normal, _, _, _, spins, k, bar, q, _ = _loaded(batch, i)
            (p0, p1, p2), own, others = _pulls(k, bar, (t0, t1, t2), slopes)
            weight, slope = 1.0, 0.0
            if square < limit[e]:
                weight, slope, _ = fade(square, limit[e])
                slope *= _twice(own, others) + _more(friction, e)  # 2 · ½
            p0, p1, p2 = weight * p0, weight * p1, weight * p2
            one, two = _forces(e0, e1, e2, normal, square, spins, (p0, p1, p2))
            one = _along(slope, cross(normal, e1), one)
            two = _along(slope, cross(normal, e2), two)
            moments = q[0] * p0, q[1] * p1, q[2] * p2
        for j in range(3):
            out[stencil[e, 0], j] -= one[j] + two[j]
            out[stencil[e, 1], j] += one[j]
            out[stencil[e, 2], j] += two[j]
            flat[places[e, j]] += moments[j]


@kernel(inline="always")
def _products(g, w):  # type: ignore[no-untyped-def]
    """Σ_i g_i w_iᵀ of three vectors each, row by row."""
    (a, b, c), (d, e, f) = g, w
    return (
        a[0] * d[0] + b[0] * e[0] + c[0] * f[0],
        a[0] * d[1] + b[0] * e[1] + c[0] * f[1],
        a[0] * d[2] + b[0] * e[2] + c[0] * f[2],
        a[1] * d[0] + b[1] * e[0] + c[1] * f[0],
        a[1] * d[1] + b[1] * e[1] + c[1] * f[1],
        a[1] * d[2] + b[1] * e[2] + c[1] * f[2],
        a[2] * d[0] + b[2] * e[0] + c[2] * f[0],
        a[2] * d[1] + b[2] * e[1] + c[2] * f[1],
        a[2] * d[2] + b[2] * e[2] + c[2] * f[2],
    )


@kernel(inline="always")
def _symmetric(a, b, c, d):  # type: ignore[no-untyped-def]
    """a bᵀ + b aᵀ + c dᵀ + d cᵀ, row by row."""
    xx, yy, zz = (
        2.0 * (a[0] * b[0] + c[0] * d[0]),
        2.0 * (a[1] * b[1] + c[1] * d[1]),
        2.0 * (a[2] * b[2] + c[2] * d[2]),
    )
    xy = a[0] * b[1] + a[1] * b[0] + c[0] * d[1] + c[1] * d[0]
    xz = a[0] * b[2] + a[2] * b[0] + c[0] * d[2] + c[2] * d[0]
    yz = a[1] * b[2] + a[2] * b[1] + c[1] * d[2] + c[2] * d[1]
    return xx, xy, xz, xy, yy, yz, xz, yz, zz


@kernel(inline="always")
def _sum(u, v):  # type: ignore[no-untyped-def]
    return (
        u[0] + v[0], u[1] + v[1], u[2] + v[2],
        u[3] + v[3], u[4] + v[4], u[5] + v[5],
        u[6] + v[6], u[7] + v[7], u[8] + v[8],
    )  # fmt: skip


@kernel(inline="always")
def _times(f, u):  # type: ignore[no-untyped-def]
    return f * u[0], f * u[1], f * u[2], f * u[3], f * u[4], f * u[5], f * u[6], f * u[7], f * u[8]


@kernel(inline="always")
def _bend(spin, e, square, n, scale, pull):  # type: ignore[no-untyped-def]
    """pull (n τᵀ + τ nᵀ − ½ s (γ ρᵀ + ρ γᵀ)) of an edge, of length² ``square``; s ρ = 2 e / |e|² + γ × t."""
    about = _along(2.0 / square, e, cross(spin, scaled(1.0 / math.sqrt(square), e)))
    return _symmetric(n, scaled(scale, cross(e, n)), scaled(-0.5 * pull, spin), about)


@kernel()
def _faded(x0, x1, x2, normal, square, limit, energy, exact, pulls, g1, g2, q, hessian):  # type: ignore[no-untyped-def]
    """The Hessian of f w, of that of f; of the rest, the regularised one has nothing.

    As ``add_hessian`` has it: blocks of corners, couplings of the corners 1 and 2 and of edges with edges.
    """
    three, one, two, edges = hessian
    weight, first, second = fade(square, limit)
    first, second = exact * first, exact * second
    bent = np.zeros((4, 4, 3, 3))
    add_square_hessian((x0, x1, x2), normal, (0, 1, 2), first * energy, bent)
    s1 = scaled(2.0, cross(normal, (x0[0] - x2[0], x0[1] - x2[1], x0[2] - x2[2])))
    s2 = scaled(2.0, cross(normal, (x1[0] - x0[0], x1[1] - x0[1], x1[2] - x0[2])))
    f1 = _weighted(pulls[0], g1[0], pulls[1], g1[1], pulls[2], g1[2])
    f2 = _weighted(pulls[0], g2[0], pulls[1], g2[1], pulls[2], g2[2])
    # w' (∇f ∇sᵀ + ∇s ∇fᵀ) + f w'' ∇s ∇sᵀ, s = |n|²
    t1, t2 = scaled(energy * second, s1), scaled(energy * second, s2)
    p1, p2 = _along(first, f1, t1), _along(first, f2, t2)
    r1, r2 = scaled(first, s1), scaled(first, s2)
    more11 = _products((p1, r1, r1), (s1, f1, (0.0, 0.0, 0.0)))
    more12 = _products((p1, r1, r1), (s2, f2, (0.0, 0.0, 0.0)))
    more22 = _products((p2, r2, r2), (s2, f2, (0.0, 0.0, 0.0)))
    three = (
        _sum(_sum(_times(weight, three[0]), more11), _nine(bent, 1, 1)),
        _sum(_sum(_times(weight, three[1]), more12), _nine(bent, 1, 2)),
        _sum(_sum(_times(weight, three[2]), more22), _nine(bent, 2, 2)),
    )
    m0, m1, m2 = q[0] * pulls[0], q[1] * pulls[1], q[2] * pulls[2]
    one = (
        _along(m0, r1, scaled(weight, one[0])),
        _along(m1, r1, scaled(weight, one[1])),
        _along(m2, r1, scaled(weight, one[2])),
    )
    two = (
        _along(m0, r2, scaled(weight, two[0])),
        _along(m1, r2, scaled(weight, two[1])),
        _along(m2, r2, scaled(weight, two[2])),
    )
    a, b, c, d, e, f = edges
    return three, one, two, (weight * a, weight * b, weight * c, weight * d, weight * e, weight * f)


@kernel(inline="always")
def _nine(blocks, a, b):  # type: ignore[no-untyped-def]
    u = blocks[a, b]
    return u[0, 0], u[0, 1], u[0, 2], u[1, 0], u[1, 1], u[1, 2], u[2, 0], u[2, 1], u[2, 2]


@kernel(inline="always")
def _add_column(flat, at, column, factor):  # type: ignore[no-untyped-def]
    """Add factor times the coupling of a vertex with an edge."""
    if at >= 0:
        first, apart = Index(at >> 2), Index(at & 3) + Index(1)
        flat[first] += factor * column[0]
        flat[first + apart] += factor * column[1]
        flat[first + apart + apart] += factor * column[2]


@kernel(inline="always")
def _add_columns(flat, offsets, e, edge, one, two, factor):  # type: ignore[no-untyped-def]
    """Add factor times the couplings of the corners 1 and 2 with an edge, and minus their sum of 0."""
    both = one[0] + two[0], one[1] + two[1], one[2] + two[2]
    _add_column(flat, offsets[e, edge], both, -factor)
    _add_column(flat, offsets[e, 3 + edge], one, factor)
    _add_column(flat, offsets[e, 6 + edge], two, factor)


@kernel(inline="always")
def _add_number(flat, at, value):  # type: ignore[no-untyped-def]
    """Add the coupling of two edges."""
    if at >= 0:
        flat[Index(at)] += value


@kernel(inline="always")
def _fetch_ahead(e, corners, offsets, values):  # type: ignore[no-untyped-def]
    """Let what a later triangle is added to come into the caches, as if it were blocks (3 × 3)."""
    later = min(e + AHEAD, offsets.shape[0] - 1)
    for pair in range(6):
        fetch(values, corners[later, pair] >> 1)
    for pair in range(9):
        fetch(values, (offsets[later, pair] >> 2) // 9)
    for pair in (9, 12, 14):
        fetch(values, offsets[later, pair] // 9)


@kernel(inline="always")
def _hessian(e0, e1, e2, normal, square, tangent, slopes, spins, k, rest, sliding, q, exact):  # type: ignore[no-untyped-def]
    """Of one triangle: blocks of the corners 11, 12, 22, couplings of the corners 1 and 2 with the edges,
    those of edges with edges; and what `_faded` is made of.

    Of its edges and normal, of T and their ``derivatives``, γ, K, T̄ with S̄, and friction's c; q is
    ∂φ/∂(unknown) times s.
    """
    inverse = 1.0 / math.sqrt(square)  # 1 / 2A
    n = scaled(inverse, normal)
    (a0, c0, _, b0, d0), (a1, c1, _, b1, d1), (a2, c2, _, b2, d2) = slopes
    (p0, p1, p2), own, others = _pulls(k, rest, tangent, slopes)
    # ∇α_i
    s00, s11, s22 = dot(e0, e0), dot(e1, e1), dot(e2, e2)
    s01, s02, s12 = dot(e0, e1), dot(e0, e2), dot(e1, e2)
    r0, r1, r2 = -inverse / math.sqrt(s00), -inverse / math.sqrt(s11), -inverse / math.sqrt(s22)
    spin0, spin1, spin2 = spins
    g1 = (
        _along(r0 * s01, n, scaled(-1.0, spin0)),
        scaled(r1 * s11, n),
        _along(r2 * s12, n, spin2),
    )
    g2 = (
        _along(r0 * s02, n, spin0),
        _along(r1 * s12, n, scaled(-1.0, spin1)),
        scaled(r2 * s22, n),
    )
    # ∇f K ∇fᵀ, and what T and S add as they bend
    c = exact * sliding
    k00 = a0 * a0 * k[0] + exact * (own[0] * c0 + others[0] * d0) + c * p0 * p0
    k11 = a1 * a1 * k[3] + exact * (own[1] * c1 + others[1] * d1) + c * p1 * p1
    k22 = a2 * a2 * k[5] + exact * (own[2] * c2 + others[2] * d2) + c * p2 * p2
    k01, k02, k12 = b0 * b1 * k[1] + c * p0 * p1, b0 * b2 * k[2] + c * p0 * p2, b1 * b2 * k[4] + c * p1 * p2
    w1 = (
        _weighted(k00, g1[0], k01, g1[1], k02, g1[2]),
        _weighted(k01, g1[0], k11, g1[1], k12, g1[2]),
        _weighted(k02, g1[0], k12, g1[1], k22, g1[2]),
    )
    w2 = (
        _weighted(k00, g2[0], k01, g2[1], k02, g2[2]),
        _weighted(k01, g2[0], k11, g2[1], k12, g2[2]),
        _weighted(k02, g2[0], k12, g2[1], k22, g2[2]),
    )
    # Σ_i p_i ∂²α_i
    m0, m1, m2 = exact * p0, exact * p1, exact * p2
    f0, f1, f2 = m0 * r0, m1 * r1, m2 * r2
    half = 0.5 * math.sqrt(square)
    bend0 = _bend(spin0, e0, s00, n, half * f0 / s00, m0)
    bend1 = _bend(spin1, e1, s11, n, half * f1 / s11, m1)
    bend2 = _bend(spin2, e2, s22, n, half * f2 / s22, m2)
    u1, u2 = scaled(inverse, cross(n, e1)), scaled(inverse, cross(n, e2))
    v1, v2 = f0 * s01 + f1 * s11 + f2 * s12, f0 * s02 + f1 * s12 + f2 * s22
    nothing = (0.0, 0.0, 0.0)
    b11 = _sum(_products(g1, w1), _sum(_sum(bend2, bend0), _symmetric(scaled(-v1, n), u1, nothing, nothing)))
    b22 = _sum(_products(g2, w2), _sum(_sum(bend0, bend1), _symmetric(scaled(-v2, n), u2, nothing, nothing)))
    turned = _products((scaled(-v2, n), scaled(-v1, u2), nothing), (u1, n, nothing))
    b12 = _sum(_products(g1, w2), _sum(turned, _times(-1.0, bend0)))
    q0, q1, q2 = q
    one = scaled(q0, w1[0]), scaled(q1, w1[1]), scaled(q2, w1[2])
    two = scaled(q0, w2[0]), scaled(q1, w2[1]), scaled(q2, w2[2])
    numbers = q0 * q0 * k00, q0 * q1 * k01, q0 * q2 * k02, q1 * q1 * k11, q1 * q2 * k12, q2 * q2 * k22
    return ((b11, b12, b22), one, two, numbers), (0.5 * _twice(own, others), (p0, p1, p2), g1, g2)


@kernel(inline="always")
def _put_nine(batch, at, i, numbers):  # type: ignore[no-untyped-def]
    put(batch, at, i, (numbers[0], numbers[1], numbers[2]))
    put(batch, at + 3, i, (numbers[3], numbers[4], numbers[5]))
    put(batch, at + 6, i, (numbers[6], numbers[7], numbers[8]))


@kernel(inline="always")
def _got_nine(batch, at, i):  # type: ignore[no-untyped-def]
    a, b, c = got(batch, at, i), got(batch, at + 3, i), got(batch, at + 6, i)
    return a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]


@kernel()
def _compute(exact, batch):  # type: ignore[no-untyped-def]
    """The Hessians of a batch, several at a time, as if no angle were beyond 45°."""
    for number in range(BATCH):
        i = Index(number)
        e0, e1, e2, normal, square, tangent, slopes, spins, k, rest, q, c = _loaded(batch, i)
        (blocks, first, second, numbers), _ = _hessian(
            e0, e1, e2, normal, square, tangent, slopes, spins, k, rest, c, q, exact
        )
        _put_nine(batch, 37, i, blocks[0])
        _put_nine(batch, 46, i, blocks[1])
        _put_nine(batch, 55, i, blocks[2])
        put(batch, 64, i, first[0])
        put(batch, 67, i, first[1])
        put(batch, 70, i, first[2])
        put(batch, 73, i, second[0])
        put(batch, 76, i, second[1])
        put(batch, 79, i, second[2])
        put(batch, 82, i, (numbers[0], numbers[1], numbers[2]))
        put(batch, 85, i, (numbers[3], numbers[4], numbers[5]))


@kernel()
def add_hessian(  # type: ignore[no-untyped-def]
    x,
    stencil,
    blend,
    edges,
    sign,
    frame,
    tangent,
    stiffness,
    rest,
    limit,
    friction,
    length,
    weight,
    corners,
    offsets,
    values,
):
    """Add weight (E,) times the Hessians to block rows, where offsets of the couplings of corners (E, 6) and
    of those with edges (E, 15) say.

    A translation does nothing, so that of the corners only the second and the third are looked at.
    """
    flat, exact, batch = values.reshape(-1), 1.0 - blend, np.zeros(88 * BATCH)
    for e in range(stencil.shape[0]):
        _fetch_ahead(e, corners, offsets, values)
        i = Index(e % BATCH)
        if i == 0:
            load_edges(x, stencil, e, batch)
            _load(edges, sign, frame, tangent, stiffness, rest, friction, length, e, batch)
            _compute(exact, batch)
        t0, t1, t2, square = tangent[e, 0], tangent[e, 1], tangent[e, 2], tangent[e, 3]
        if max(abs(t0), abs(t1), abs(t2)) < 1.0 and square >= limit[e]:
            b11, b12, b22 = _got_nine(batch, 37, i), _got_nine(batch, 46, i), _got_nine(batch, 55, i)
            one = got(batch, 64, i), got(batch, 67, i), got(batch, 70, i)
            two = got(batch, 73, i), got(batch, 76, i), got(batch, 79, i)
            h00, h01, h02 = got(batch, 82, i)
            h11, h12, h22 = got(batch, 85, i)
        else:
            if square <= GONE * limit[e]:
                continue
            slopes = derivatives(t0), derivatives(t1), derivatives(t2)
            e0, e1, e2, normal, _, _, _, spins, k, bar, q, c = _loaded(batch, i)
            hessian, (energy, pulls, g1, g2) = _hessian(
                e0, e1, e2, normal, square, (t0, t1, t2), slopes, spins, k, bar, c, q, exact
            )
            if square < limit[e]:
                energy += 0.5 * _more(friction, e)
                x0, x1, x2 = point(x, stencil[e, 0]), point(x, stencil[e, 1]), point(x, stencil[e, 2])
                hessian = _faded(
                    x0, x1, x2, normal, square, limit[e], energy, exact, pulls, g1, g2, q, hessian
                )
            (b11, b12, b22), one, two, (h00, h01, h02, h11, h12, h22) = hessian
        factor = weight[e]
        add_corners(values, corners, e, (_times(factor, b11), _times(factor, b12), _times(factor, b22)))
        _add_columns(flat, offsets, e, 0, one[0], two[0], factor)
        _add_columns(flat, offsets, e, 1, one[1], two[1], factor)
        _add_columns(flat, offsets, e, 2, one[2], two[2], factor)
        _add_number(flat, offsets[e, 9], factor * h00)
        _add_number(flat, offsets[e, 10], factor * h01)
        _add_number(flat, offsets[e, 11], factor * h02)
        _add_number(flat, offsets[e, 12], factor * h11)
        _add_number(flat, offsets[e, 13], factor * h12)
        _add_number(flat, offsets[e, 14], factor * h22)
