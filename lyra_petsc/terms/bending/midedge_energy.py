"""The energy of bending by directors on edges, its gradient and Hessian: pure functions on arrays.

Per triangle, with the tangents T and S of ``midedge_shape`` and constants K (3 × 3) and T̄::

    energy = w (½ Σ_i K_ii (T_i − T̄_i)² + Σ_{i<j} K_ij (S_i − S̄_i) (S_j − S̄_j))

With angles up to 45° that is ½ w fᵀ K f of f = T − T̄.

w is 1, except for triangles that have lost nine tenths of their area: their normals are ill-defined, and w
goes to 0 with the area as in ``hinge_energy``. With director angles φ, normal n, area A and barycentric
coordinates b_c the derivatives of α_i are

    ∂α_i/∂x_c = ω n ± γ_i,   ω = −e_i · e_c / (2A |e_i|),     ∂α_i/∂φ_i = s_i

with γ_i at the two ends of the edge only, + at its head, and s_i = 1 where the triangle runs along the edge,
−1 where it runs against it. The second derivatives are, as for a hinge (``hinge.triangle_derivatives``),

    −ω_d n ∇b_cᵀ − ω_c ∇b_d nᵀ + σ_c σ_d (n τᵀ + τ nᵀ) − ½ σ_c σ_d s_i (γ ρᵀ + ρ γᵀ),   τ = −m_i / (2 |e_i|²)

with σ = 1 and −1 at the ends of the edge and 0 opposite it. ``convexity`` 0 is exact, 1 the
positive-semidefinite ∇f K ∇fᵀ.

Arrays: ``tangent`` (E, 4) is the output of ``midedge_shape.tangents``; ``frame`` (n_edges, 3) are the
directions t₀ of the edges' frames, from which γ is computed; ``rest`` (E, 3) is T̄, empty if all are 0.
``friction`` (E, 2) is empty without friction, else it has a factor c and an energy [J] for each triangle: the
latter is added to the energy, and c p pᵀ with the moments p_i = ∂E/∂α_i to the exact Hessian.

A triangle's data in a batch (`midedge_shape.BATCH`): rows 0 to 8 e_i, 9 to 17 s_i t₀ of the frames, 18 to 20
T, 21 to 26 K, 27 to 32 T̄ and S̄, 33 to 35 q = s ∂φ/∂(unknown), 36 the c of friction, then results.
"""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import inlined, kernel, subkernel
from lyra_petsc.kernels.vector3 import cross, dot, point, scaled
from lyra_petsc.kernels.vectors import add_corners, fetch
from lyra_petsc.terms.bending.hinge_energy import VANISHED, add_square_hessian, fade
from lyra_petsc.terms.bending.midedge_shape import (
    BATCH,
    coupling_tangent,
    derivatives,
    derivatives_below_45,
    load,
    load_edges,
    spin,
    store,
    vector_at,
)

AHEAD = 4
"""Number of triangles by which the prefetch of blocks runs ahead of the assembly."""


@inlined()
def _stiffness_of(stiffness, e):  # type: ignore[no-untyped-def]
    """K_00, K_01, K_02, K_11, K_12 and K_22 of triangle e."""
    k = stiffness
    return k[e, 0], k[e, 1], k[e, 2], k[e, 3], k[e, 4], k[e, 5]


@inlined()
def _rest_tangents(rest, e):  # type: ignore[no-untyped-def]
    """The three T̄ and the three S̄ of triangle e."""
    if rest.shape[0] == 0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    u0, u1, u2 = rest[e, 0], rest[e, 1], rest[e, 2]
    return u0, u1, u2, coupling_tangent(u0), coupling_tangent(u1), coupling_tangent(u2)


@inlined()
def _diagonal(k, rest, t0, t1, t2):  # type: ignore[no-untyped-def]
    """K_ii (T_i − T̄_i) of a triangle for i = 0, 1, 2, and the three T_i − T̄_i."""
    f0, f1, f2 = t0 - rest[0], t1 - rest[1], t2 - rest[2]
    return k[0] * f0, k[3] * f1, k[5] * f2, f0, f1, f2


@inlined()
def _coupling(k, rest, s0, s1, s2):  # type: ignore[no-untyped-def]
    """Σ_j≠i K_ij (S_j − S̄_j) of a triangle for i = 0, 1, 2, and the three S_i − S̄_i."""
    h0, h1, h2 = s0 - rest[3], s1 - rest[4], s2 - rest[5]
    return k[1] * h1 + k[2] * h2, k[1] * h0 + k[4] * h2, k[2] * h0 + k[4] * h1, h0, h1, h2


@inlined()
def _twice_energy(diagonal, coupling):  # type: ignore[no-untyped-def]
    """Twice the energy, from the results of `_diagonal` and `_coupling`."""
    return (
        diagonal[0] * diagonal[3]
        + diagonal[1] * diagonal[4]
        + diagonal[2] * diagonal[5]
        + coupling[0] * coupling[3]
        + coupling[1] * coupling[4]
        + coupling[2] * coupling[5]
    )


@inlined()
def _twice_friction(friction, e):  # type: ignore[no-untyped-def]
    """Twice the energy of friction of triangle e."""
    return 2.0 * friction[e, 1] if friction.shape[0] > 0 else 0.0


@kernel()
def energies(tangent, stiffness, rest, limit, friction, out):  # type: ignore[no-untyped-def]
    """Energy [J] of the first len(out) triangles; infinite if an edge is too far from its frame."""
    for e in range(out.shape[0]):
        t0, t1, t2, square = tangent[e, 0], tangent[e, 1], tangent[e, 2], tangent[e, 3]
        if square <= VANISHED * limit[e]:
            out[e] = 0.0
            continue
        k, bar = _stiffness_of(stiffness, e), _rest_tangents(rest, e)
        s0, s1, s2 = coupling_tangent(t0), coupling_tangent(t1), coupling_tangent(t2)
        diagonal, coupling = _diagonal(k, bar, t0, t1, t2), _coupling(k, bar, s0, s1, s2)
        out[e] = 0.5 * (_twice_energy(diagonal, coupling) + _twice_friction(friction, e))
        if square < limit[e]:
            out[e] *= fade(square, limit[e])[0]
        if not out[e] < np.inf:
            out[e] = np.inf


@inlined()
def _axpy(f, u, v):  # type: ignore[no-untyped-def]
    """f u + v."""
    return f * u[0] + v[0], f * u[1] + v[1], f * u[2] + v[2]


@inlined()
def _combine(a, u, b, v, c, w):  # type: ignore[no-untyped-def]
    """a u + b v + c w."""
    return (
        a * u[0] + b * v[0] + c * w[0],
        a * u[1] + b * v[1] + c * w[1],
        a * u[2] + b * v[2] + c * w[2],
    )


@subkernel()
def _load_constants(  # type: ignore[no-untyped-def]
    edges, sign, frame, tangent, stiffness, rest, friction, length, first, batch
):
    """Fill rows 9 to 36 of a batch with triangles from ``first`` on, except T̄, S̄ and c if these are empty."""
    last = edges.shape[0] - 1
    # several short loops are faster than one that reads everything
    for number in range(BATCH):
        e, i = min(first + number, last), Index(number)
        store(batch, 9, i, scaled(float(sign[e, 0]), vector_at(frame, edges[e, 0], 0)))
        store(batch, 12, i, scaled(float(sign[e, 1]), vector_at(frame, edges[e, 1], 0)))
        store(batch, 15, i, scaled(float(sign[e, 2]), vector_at(frame, edges[e, 2], 0)))
    for number in range(BATCH):
        e, i = min(first + number, last), Index(number)
        store(batch, 18, i, vector_at(tangent, e, 0))
        k = _stiffness_of(stiffness, e)
        store(batch, 21, i, (k[0], k[1], k[2]))
        store(batch, 24, i, (k[3], k[4], k[5]))
    for number in range(BATCH):
        e, i = min(first + number, last), Index(number)
        q0, q1 = sign[e, 0] / length[edges[e, 0]], sign[e, 1] / length[edges[e, 1]]
        store(batch, 33, i, (q0, q1, sign[e, 2] / length[edges[e, 2]]))
    for number in range(BATCH if rest.shape[0] > 0 else 0):
        i = Index(number)
        bar = _rest_tangents(rest, min(first + number, last))
        store(batch, 27, i, (bar[0], bar[1], bar[2]))
        store(batch, 30, i, (bar[3], bar[4], bar[5]))
    for number in range(BATCH if friction.shape[0] > 0 else 0):
        batch[Index(BATCH * 36) + Index(number)] = friction[min(first + number, last), 0]


@inlined()
def _unpack(batch, i):  # type: ignore[no-untyped-def]
    """Data of triangle i of a batch: e_i, N, |N|², T and its ``derivatives_below_45``, γ_i, K, T̄ with S̄, q
    and the c of friction.
    """
    e0, e1, e2 = load(batch, 0, i), load(batch, 3, i), load(batch, 6, i)
    normal = cross(e1, e2)
    spins = spin(load(batch, 9, i), e0), spin(load(batch, 12, i), e1), spin(load(batch, 15, i), e2)
    t0, t1, t2 = load(batch, 18, i)
    slopes = derivatives_below_45(t0), derivatives_below_45(t1), derivatives_below_45(t2)
    (k0, k1, k2), (k3, k4, k5) = load(batch, 21, i), load(batch, 24, i)
    (u0, u1, u2), (u3, u4, u5) = load(batch, 27, i), load(batch, 30, i)
    k, rest, q = (k0, k1, k2, k3, k4, k5), (u0, u1, u2, u3, u4, u5), load(batch, 33, i)
    c = batch[Index(BATCH * 36) + i]
    return e0, e1, e2, normal, dot(normal, normal), (t0, t1, t2), slopes, spins, k, rest, q, c


@inlined()
def _moments(k, rest, tangent, slopes):  # type: ignore[no-untyped-def]
    """The moments p of a triangle, and the results of `_diagonal` and `_coupling`."""
    t0, t1, t2 = tangent
    (a0, _, s0, b0, _), (a1, _, s1, b1, _), (a2, _, s2, b2, _) = slopes
    d, c = _diagonal(k, rest, t0, t1, t2), _coupling(k, rest, s0, s1, s2)
    return (d[0] * a0 + c[0] * b0, d[1] * a1 + c[1] * b1, d[2] * a2 + c[2] * b2), d, c


@inlined()
def _corner_gradients(e0, e1, e2, normal, square, spins, moments):  # type: ignore[no-untyped-def]
    """Gradients Σ_i p_i ∂α_i/∂x_c at corners 1 and 2; those of all three corners sum to 0."""
    (p0, p1, p2), (g0, g1, g2) = moments, spins
    n = scaled(1.0 / square, normal)  # n / 2A
    q0, q1, q2 = p0 / math.sqrt(dot(e0, e0)), p1 / math.sqrt(dot(e1, e1)), p2 / math.sqrt(dot(e2, e2))
    moment = _combine(q0, e0, q1, e1, q2, e2)
    return (
        _axpy(-dot(e1, moment), n, _combine(p2, g2, -p0, g0, 0.0, g1)),
        _axpy(-dot(e2, moment), n, _combine(p0, g0, -p1, g1, 0.0, g2)),
    )


@subkernel()
def _compute_gradients(batch):  # type: ignore[no-untyped-def]
    """Store the gradients by the corners 1 and 2 and by the edges' unknowns in rows 37 to 45 of a batch.

    They hold for triangles with all angles up to 45°.
    """
    for number in range(BATCH):
        i = Index(number)
        e0, e1, e2, normal, square, tangent, slopes, spins, k, rest, q, _ = _unpack(batch, i)
        moments, _, _ = _moments(k, rest, tangent, slopes)
        one, two = _corner_gradients(e0, e1, e2, normal, square, spins, moments)
        store(batch, 37, i, one)
        store(batch, 40, i, two)
        store(batch, 43, i, (q[0] * moments[0], q[1] * moments[1], q[2] * moments[2]))


@kernel()
def add_gradient(  # type: ignore[no-untyped-def]
    x, stencil, edges, indices, sign, frame, tangent, stiffness, rest, limit, friction, length, out
):
    """Add the energy's gradient [N] to out (n_local, 3); edge unknowns are φ times ``length`` (n_edges,)."""
    flat, batch = out.reshape(-1), np.zeros(46 * BATCH)
    for e in range(stencil.shape[0]):
        i = Index(e % BATCH)
        if i == 0:
            load_edges(x, stencil, e, batch)
            _load_constants(edges, sign, frame, tangent, stiffness, rest, friction, length, e, batch)
            _compute_gradients(batch)
        t0, t1, t2, square = tangent[e, 0], tangent[e, 1], tangent[e, 2], tangent[e, 3]
        if max(abs(t0), abs(t1), abs(t2)) < 1.0 and square >= limit[e]:
            one, two, edge_forces = load(batch, 37, i), load(batch, 40, i), load(batch, 43, i)
        else:
            if square <= VANISHED * limit[e]:
                continue
            slopes = derivatives(t0), derivatives(t1), derivatives(t2)
            e0, e1, e2, normal, _, _, _, spins, k, bar, q, _ = _unpack(batch, i)
            (p0, p1, p2), diagonal, coupling = _moments(k, bar, (t0, t1, t2), slopes)
            weight, slope = 1.0, 0.0
            if square < limit[e]:
                weight, slope, _ = fade(square, limit[e])
                slope *= _twice_energy(diagonal, coupling) + _twice_friction(friction, e)  # 2 · ½
            p0, p1, p2 = weight * p0, weight * p1, weight * p2
            one, two = _corner_gradients(e0, e1, e2, normal, square, spins, (p0, p1, p2))
            one = _axpy(slope, cross(normal, e1), one)
            two = _axpy(slope, cross(normal, e2), two)
            edge_forces = q[0] * p0, q[1] * p1, q[2] * p2
        for j in range(3):
            out[stencil[e, 0], j] -= one[j] + two[j]
            out[stencil[e, 1], j] += one[j]
            out[stencil[e, 2], j] += two[j]
            flat[indices[e, j]] += edge_forces[j]


@inlined()
def _outers(g, w):  # type: ignore[no-untyped-def]
    """Σ_i g_i w_iᵀ of three vectors g and three w, a 3 × 3 block by rows."""
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


@inlined()
def _symmetric(a, b, c, d):  # type: ignore[no-untyped-def]
    """a bᵀ + b aᵀ + c dᵀ + d cᵀ, a 3 × 3 block by rows."""
    xx, yy, zz = (
        2.0 * (a[0] * b[0] + c[0] * d[0]),
        2.0 * (a[1] * b[1] + c[1] * d[1]),
        2.0 * (a[2] * b[2] + c[2] * d[2]),
    )
    xy = a[0] * b[1] + a[1] * b[0] + c[0] * d[1] + c[1] * d[0]
    xz = a[0] * b[2] + a[2] * b[0] + c[0] * d[2] + c[2] * d[0]
    yz = a[1] * b[2] + a[2] * b[1] + c[1] * d[2] + c[2] * d[1]
    return xx, xy, xz, xy, yy, yz, xz, yz, zz


@inlined()
def _sum(u, v):  # type: ignore[no-untyped-def]
    """Sum of two 3 × 3 blocks."""
    return (
        u[0] + v[0], u[1] + v[1], u[2] + v[2],
        u[3] + v[3], u[4] + v[4], u[5] + v[5],
        u[6] + v[6], u[7] + v[7], u[8] + v[8],
    )  # fmt: skip


@inlined()
def _times(f, u):  # type: ignore[no-untyped-def]
    """A 3 × 3 block times f."""
    return f * u[0], f * u[1], f * u[2], f * u[3], f * u[4], f * u[5], f * u[6], f * u[7], f * u[8]


@inlined()
def _second_derivative(spin, e, square, n, scale, moment):  # type: ignore[no-untyped-def]
    """moment (n τᵀ + τ nᵀ − ½ s (γ ρᵀ + ρ γᵀ)) of edge e, square = |e|²; s ρ = 2 e / |e|² + γ × t."""
    about = _axpy(2.0 / square, e, cross(spin, scaled(1.0 / math.sqrt(square), e)))
    return _symmetric(n, scaled(scale, cross(e, n)), scaled(-0.5 * moment, spin), about)


@subkernel()
def _fade_hessian(x0, x1, x2, normal, square, limit, energy, exact, moments, g1, g2, q, hessian):  # type: ignore[no-untyped-def]
    """The Hessian of w E from that of E, both in the form that `_hessian` returns.

    The regularised one (``exact`` 0) has only the term w ∂²E.
    """
    three, one, two, edges = hessian
    weight, first, second = fade(square, limit)
    first, second = exact * first, exact * second
    bent = np.zeros((4, 4, 3, 3))
    add_square_hessian((x0, x1, x2), normal, (0, 1, 2), first * energy, bent)
    s1 = scaled(2.0, cross(normal, (x0[0] - x2[0], x0[1] - x2[1], x0[2] - x2[2])))
    s2 = scaled(2.0, cross(normal, (x1[0] - x0[0], x1[1] - x0[1], x1[2] - x0[2])))
    f1 = _combine(moments[0], g1[0], moments[1], g1[1], moments[2], g1[2])
    f2 = _combine(moments[0], g2[0], moments[1], g2[1], moments[2], g2[2])
    # w' (∇f ∇sᵀ + ∇s ∇fᵀ) + f w'' ∇s ∇sᵀ, s = |n|²
    t1, t2 = scaled(energy * second, s1), scaled(energy * second, s2)
    p1, p2 = _axpy(first, f1, t1), _axpy(first, f2, t2)
    r1, r2 = scaled(first, s1), scaled(first, s2)
    added11 = _outers((p1, r1, r1), (s1, f1, (0.0, 0.0, 0.0)))
    added12 = _outers((p1, r1, r1), (s2, f2, (0.0, 0.0, 0.0)))
    added22 = _outers((p2, r2, r2), (s2, f2, (0.0, 0.0, 0.0)))
    three = (
        _sum(_sum(_times(weight, three[0]), added11), _block(bent, 1, 1)),
        _sum(_sum(_times(weight, three[1]), added12), _block(bent, 1, 2)),
        _sum(_sum(_times(weight, three[2]), added22), _block(bent, 2, 2)),
    )
    m0, m1, m2 = q[0] * moments[0], q[1] * moments[1], q[2] * moments[2]
    one = (
        _axpy(m0, r1, scaled(weight, one[0])),
        _axpy(m1, r1, scaled(weight, one[1])),
        _axpy(m2, r1, scaled(weight, one[2])),
    )
    two = (
        _axpy(m0, r2, scaled(weight, two[0])),
        _axpy(m1, r2, scaled(weight, two[1])),
        _axpy(m2, r2, scaled(weight, two[2])),
    )
    a, b, c, d, e, f = edges
    return three, one, two, (weight * a, weight * b, weight * c, weight * d, weight * e, weight * f)


@inlined()
def _block(blocks, a, b):  # type: ignore[no-untyped-def]
    """Block (a, b) of an array (4, 4, 3, 3), by rows."""
    u = blocks[a, b]
    return u[0, 0], u[0, 1], u[0, 2], u[1, 0], u[1, 1], u[1, 2], u[2, 0], u[2, 1], u[2, 2]


@inlined()
def _add_column(flat, at, column, factor):  # type: ignore[no-untyped-def]
    """Add factor times the coupling (3,) of a vertex with an edge.

    ``at`` is four times the index of the first value plus the stride minus 1; negative if not stored.
    """
    if at >= 0:
        first, stride = Index(at >> 2), Index(at & 3) + Index(1)
        flat[first] += factor * column[0]
        flat[first + stride] += factor * column[1]
        flat[first + stride + stride] += factor * column[2]


@inlined()
def _add_columns(flat, offsets, e, edge, one, two, factor):  # type: ignore[no-untyped-def]
    """Add factor times the couplings of the three corners with an edge; that of corner 0 is −one − two."""
    both = one[0] + two[0], one[1] + two[1], one[2] + two[2]
    _add_column(flat, offsets[e, edge], both, -factor)
    _add_column(flat, offsets[e, 3 + edge], one, factor)
    _add_column(flat, offsets[e, 6 + edge], two, factor)


@inlined()
def _add_scalar(flat, at, value):  # type: ignore[no-untyped-def]
    """Add the coupling of two edges; ``at`` is negative if it is not stored."""
    if at >= 0:
        flat[Index(at)] += value


@inlined()
def _fetch_ahead(e, corners, offsets, values):  # type: ignore[no-untyped-def]
    """Prefetch the matrix values to which a later triangle is added, in units of 3 × 3 blocks."""
    later = min(e + AHEAD, offsets.shape[0] - 1)
    for pair in range(6):
        fetch(values, corners[later, pair] >> 1)
    for pair in range(9):
        fetch(values, (offsets[later, pair] >> 2) // 9)
    for pair in (9, 12, 14):
        fetch(values, offsets[later, pair] // 9)


@inlined()
def _hessian(e0, e1, e2, normal, square, tangent, slopes, spins, k, rest, sliding, q, exact):  # type: ignore[no-untyped-def]
    """The Hessian of one triangle, and the energy, moments p and gradients of α that `_fade_hessian` needs.

    The Hessian is (blocks of the corners 11, 12, 22), couplings (3, 3) of corner 1 with the three edges, the
    same of corner 2, and couplings 00, 01, 02, 11, 12, 22 of edges. ``slopes`` are the ``derivatives`` of T
    and S, ``spins`` the γ, ``rest`` T̄ with S̄ and ``sliding`` the c of friction.
    """
    inverse = 1.0 / math.sqrt(square)  # 1 / 2A
    n = scaled(inverse, normal)
    (a0, c0, _, b0, d0), (a1, c1, _, b1, d1), (a2, c2, _, b2, d2) = slopes
    (p0, p1, p2), diagonal, coupling = _moments(k, rest, tangent, slopes)
    # ∇α_i
    s00, s11, s22 = dot(e0, e0), dot(e1, e1), dot(e2, e2)
    s01, s02, s12 = dot(e0, e1), dot(e0, e2), dot(e1, e2)
    r0, r1, r2 = -inverse / math.sqrt(s00), -inverse / math.sqrt(s11), -inverse / math.sqrt(s22)
    spin0, spin1, spin2 = spins
    g1 = (
        _axpy(r0 * s01, n, scaled(-1.0, spin0)),
        scaled(r1 * s11, n),
        _axpy(r2 * s12, n, spin2),
    )
    g2 = (
        _axpy(r0 * s02, n, spin0),
        _axpy(r1 * s12, n, scaled(-1.0, spin1)),
        scaled(r2 * s22, n),
    )
    # ∇f K ∇fᵀ, and the second derivatives of T and S
    c = exact * sliding
    k00 = a0 * a0 * k[0] + exact * (diagonal[0] * c0 + coupling[0] * d0) + c * p0 * p0
    k11 = a1 * a1 * k[3] + exact * (diagonal[1] * c1 + coupling[1] * d1) + c * p1 * p1
    k22 = a2 * a2 * k[5] + exact * (diagonal[2] * c2 + coupling[2] * d2) + c * p2 * p2
    k01, k02, k12 = b0 * b1 * k[1] + c * p0 * p1, b0 * b2 * k[2] + c * p0 * p2, b1 * b2 * k[4] + c * p1 * p2
    w1 = (
        _combine(k00, g1[0], k01, g1[1], k02, g1[2]),
        _combine(k01, g1[0], k11, g1[1], k12, g1[2]),
        _combine(k02, g1[0], k12, g1[1], k22, g1[2]),
    )
    w2 = (
        _combine(k00, g2[0], k01, g2[1], k02, g2[2]),
        _combine(k01, g2[0], k11, g2[1], k12, g2[2]),
        _combine(k02, g2[0], k12, g2[1], k22, g2[2]),
    )
    # Σ_i p_i ∂²α_i
    m0, m1, m2 = exact * p0, exact * p1, exact * p2
    f0, f1, f2 = m0 * r0, m1 * r1, m2 * r2
    half = 0.5 * math.sqrt(square)
    bend0 = _second_derivative(spin0, e0, s00, n, half * f0 / s00, m0)
    bend1 = _second_derivative(spin1, e1, s11, n, half * f1 / s11, m1)
    bend2 = _second_derivative(spin2, e2, s22, n, half * f2 / s22, m2)
    u1, u2 = scaled(inverse, cross(n, e1)), scaled(inverse, cross(n, e2))
    v1, v2 = f0 * s01 + f1 * s11 + f2 * s12, f0 * s02 + f1 * s12 + f2 * s22
    nothing = (0.0, 0.0, 0.0)
    b11 = _sum(_outers(g1, w1), _sum(_sum(bend2, bend0), _symmetric(scaled(-v1, n), u1, nothing, nothing)))
    b22 = _sum(_outers(g2, w2), _sum(_sum(bend0, bend1), _symmetric(scaled(-v2, n), u2, nothing, nothing)))
    turned = _outers((scaled(-v2, n), scaled(-v1, u2), nothing), (u1, n, nothing))
    b12 = _sum(_outers(g1, w2), _sum(turned, _times(-1.0, bend0)))
    q0, q1, q2 = q
    one = scaled(q0, w1[0]), scaled(q1, w1[1]), scaled(q2, w1[2])
    two = scaled(q0, w2[0]), scaled(q1, w2[1]), scaled(q2, w2[2])
    numbers = q0 * q0 * k00, q0 * q1 * k01, q0 * q2 * k02, q1 * q1 * k11, q1 * q2 * k12, q2 * q2 * k22
    energy = 0.5 * _twice_energy(diagonal, coupling)
    return ((b11, b12, b22), one, two, numbers), (energy, (p0, p1, p2), g1, g2)


@kernel(inline="always")
def _store_block(batch, row, i, block):  # type: ignore[no-untyped-def]
    """Store a 3 × 3 block of triangle i in nine rows of a batch."""
    store(batch, row, i, (block[0], block[1], block[2]))
    store(batch, row + 3, i, (block[3], block[4], block[5]))
    store(batch, row + 6, i, (block[6], block[7], block[8]))


@kernel(inline="always")
def _load_block(batch, row, i):  # type: ignore[no-untyped-def]
    """A 3 × 3 block of triangle i from nine rows of a batch."""
    a, b, c = load(batch, row, i), load(batch, row + 3, i), load(batch, row + 6, i)
    return a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]


@subkernel()
def _compute_hessians(exact, batch):  # type: ignore[no-untyped-def]
    """Store the Hessians of a batch in its rows 37 to 87, for triangles with all angles up to 45°."""
    for number in range(BATCH):
        i = Index(number)
        e0, e1, e2, normal, square, tangent, slopes, spins, k, rest, q, c = _unpack(batch, i)
        (blocks, first, second, numbers), _ = _hessian(
            e0, e1, e2, normal, square, tangent, slopes, spins, k, rest, c, q, exact
        )
        _store_block(batch, 37, i, blocks[0])
        _store_block(batch, 46, i, blocks[1])
        _store_block(batch, 55, i, blocks[2])
        store(batch, 64, i, first[0])
        store(batch, 67, i, first[1])
        store(batch, 70, i, first[2])
        store(batch, 73, i, second[0])
        store(batch, 76, i, second[1])
        store(batch, 79, i, second[2])
        store(batch, 82, i, (numbers[0], numbers[1], numbers[2]))
        store(batch, 85, i, (numbers[3], numbers[4], numbers[5]))


@kernel()
def add_hessian(  # type: ignore[no-untyped-def]
    x,
    stencil,
    convexity,
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
    """Add weight (E,) times the Hessians [N/m] to block rows, at the offsets of the couplings of ``corners``
    (E, 6) and of those with edges (E, 15).

    Only corners 1 and 2 are computed: corner 0 follows from invariance under translation.
    """
    flat, exact, batch = values.reshape(-1), 1.0 - convexity, np.zeros(88 * BATCH)
    for e in range(stencil.shape[0]):
        _fetch_ahead(e, corners, offsets, values)
        i = Index(e % BATCH)
        if i == 0:
            load_edges(x, stencil, e, batch)
            _load_constants(edges, sign, frame, tangent, stiffness, rest, friction, length, e, batch)
            _compute_hessians(exact, batch)
        t0, t1, t2, square = tangent[e, 0], tangent[e, 1], tangent[e, 2], tangent[e, 3]
        if max(abs(t0), abs(t1), abs(t2)) < 1.0 and square >= limit[e]:
            b11, b12, b22 = _load_block(batch, 37, i), _load_block(batch, 46, i), _load_block(batch, 55, i)
            one = load(batch, 64, i), load(batch, 67, i), load(batch, 70, i)
            two = load(batch, 73, i), load(batch, 76, i), load(batch, 79, i)
            h00, h01, h02 = load(batch, 82, i)
            h11, h12, h22 = load(batch, 85, i)
        else:
            if square <= VANISHED * limit[e]:
                continue
            slopes = derivatives(t0), derivatives(t1), derivatives(t2)
            e0, e1, e2, normal, _, _, _, spins, k, bar, q, c = _unpack(batch, i)
            hessian, (energy, moments, g1, g2) = _hessian(
                e0, e1, e2, normal, square, (t0, t1, t2), slopes, spins, k, bar, c, q, exact
            )
            if square < limit[e]:
                energy += 0.5 * _twice_friction(friction, e)
                x0, x1, x2 = point(x, stencil[e, 0]), point(x, stencil[e, 1]), point(x, stencil[e, 2])
                hessian = _fade_hessian(
                    x0, x1, x2, normal, square, limit[e], energy, exact, moments, g1, g2, q, hessian
                )
            (b11, b12, b22), one, two, (h00, h01, h02, h11, h12, h22) = hessian
        factor = weight[e]
        add_corners(values, corners, e, (_times(factor, b11), _times(factor, b12), _times(factor, b22)))
        _add_columns(flat, offsets, e, 0, one[0], two[0], factor)
        _add_columns(flat, offsets, e, 1, one[1], two[1], factor)
        _add_columns(flat, offsets, e, 2, one[2], two[2], factor)
        _add_scalar(flat, offsets[e, 9], factor * h00)
        _add_scalar(flat, offsets[e, 10], factor * h01)
        _add_scalar(flat, offsets[e, 11], factor * h02)
        _add_scalar(flat, offsets[e, 12], factor * h11)
        _add_scalar(flat, offsets[e, 13], factor * h12)
        _add_scalar(flat, offsets[e, 14], factor * h22)
