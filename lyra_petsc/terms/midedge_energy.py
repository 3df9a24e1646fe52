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
"""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import kernel
from lyra_petsc.kernels.scatter import fetch_ahead
from lyra_petsc.terms.hinge import cross, dot, point, scaled
from lyra_petsc.terms.hinge_energy import GONE, add_square_hessian, fade
from lyra_petsc.terms.midedge_shape import edges_of, fading_tangent, row, tangent_of


@kernel(inline="always")
def _own(stiffness, rest, e, t0, t1, t2):  # type: ignore[no-untyped-def]
    """K_ii (T_i − T̄_i) of triangle e, and the differences."""
    f0, f1, f2 = t0 - rest[e, 0], t1 - rest[e, 1], t2 - rest[e, 2]
    return stiffness[e, 0] * f0, stiffness[e, 3] * f1, stiffness[e, 5] * f2, f0, f1, f2


@kernel(inline="always")
def _others(stiffness, rest, e, s0, s1, s2):  # type: ignore[no-untyped-def]
    """Σ_j≠i K_ij (S_j − S̄_j) of triangle e, and the differences."""
    h0, h1, h2 = (
        s0 - fading_tangent(rest[e, 0]),
        s1 - fading_tangent(rest[e, 1]),
        s2 - fading_tangent(rest[e, 2]),
    )
    k01, k02, k12 = stiffness[e, 1], stiffness[e, 2], stiffness[e, 4]
    return k01 * h1 + k02 * h2, k01 * h0 + k12 * h2, k02 * h0 + k12 * h1, h0, h1, h2


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


@kernel()
def energies(x, stencil, edges, shape, stiffness, rest, limit, out):  # type: ignore[no-untyped-def]
    """Energy [J] of the first len(out) triangles; infinite where an edge is too far from its frame."""
    for e in range(out.shape[0]):
        x0, x1, x2 = point(x, stencil[e, 0]), point(x, stencil[e, 1]), point(x, stencil[e, 2])
        e0, e1, e2, normal, square = edges_of(x0, x1, x2)
        if square <= GONE * limit[e]:
            out[e] = 0.0
            continue
        t0, _, _, s0, _, _ = tangent_of(row(shape, edges[e, 0], 0), e0, normal)
        t1, _, _, s1, _, _ = tangent_of(row(shape, edges[e, 1], 0), e1, normal)
        t2, _, _, s2, _, _ = tangent_of(row(shape, edges[e, 2], 0), e2, normal)
        out[e] = 0.5 * _twice(_own(stiffness, rest, e, t0, t1, t2), _others(stiffness, rest, e, s0, s1, s2))
        if square < limit[e]:
            out[e] *= fade(square, limit[e])[0]
        if not out[e] < np.inf:
            out[e] = np.inf


@kernel()
def add_gradient(  # type: ignore[no-untyped-def]
    x, stencil, edges, places, sign, shape, stiffness, rest, limit, length, out
):
    """Add the energy's gradient [N] to out (n_local, 3); edge unknowns are φ times ``length`` (E, 3)."""
    flat = out.reshape(-1)
    for e in range(stencil.shape[0]):
        x0, x1, x2 = point(x, stencil[e, 0]), point(x, stencil[e, 1]), point(x, stencil[e, 2])
        e0, e1, e2, normal, square = edges_of(x0, x1, x2)
        if square <= GONE * limit[e]:
            continue
        t0, a0, _, s0, b0, _ = tangent_of(row(shape, edges[e, 0], 0), e0, normal)
        t1, a1, _, s1, b1, _ = tangent_of(row(shape, edges[e, 1], 0), e1, normal)
        t2, a2, _, s2, b2, _ = tangent_of(row(shape, edges[e, 2], 0), e2, normal)
        own, others = _own(stiffness, rest, e, t0, t1, t2), _others(stiffness, rest, e, s0, s1, s2)
        p0, p1, p2 = own[0] * a0 + others[0] * b0, own[1] * a1 + others[1] * b1, own[2] * a2 + others[2] * b2
        if square < limit[e]:
            weight, slope, _ = fade(square, limit[e])
            energy = slope * _twice(own, others)  # 2 · ½
            p0, p1, p2 = weight * p0, weight * p1, weight * p2
            for c, edge in ((0, e0), (1, e1), (2, e2)):
                turned = cross(normal, edge)
                for i in range(3):
                    out[stencil[e, c], i] += energy * turned[i]
        q0, q1, q2 = p0 / math.sqrt(dot(e0, e0)), p1 / math.sqrt(dot(e1, e1)), p2 / math.sqrt(dot(e2, e2))
        pull = (
            q0 * e0[0] + q1 * e1[0] + q2 * e2[0],
            q0 * e0[1] + q1 * e1[1] + q2 * e2[1],
            q0 * e0[2] + q1 * e1[2] + q2 * e2[2],
        )
        n = scaled(1.0 / square, normal)  # over 2A
        w0, w1, w2 = -dot(e0, pull), -dot(e1, pull), -dot(e2, pull)
        g0, g1, g2 = row(shape, edges[e, 0], 3), row(shape, edges[e, 1], 3), row(shape, edges[e, 2], 3)
        for i in range(3):
            r0, r1, r2 = p0 * g0[i], p1 * g1[i], p2 * g2[i]
            out[stencil[e, 0], i] += w0 * n[i] + r1 - r2
            out[stencil[e, 1], i] += w1 * n[i] + r2 - r0
            out[stencil[e, 2], i] += w2 * n[i] + r0 - r1
        flat[places[e, 0]] += sign[e, 0] * p0 / length[e, 0]
        flat[places[e, 1]] += sign[e, 1] * p1 / length[e, 1]
        flat[places[e, 2]] += sign[e, 2] * p2 / length[e, 2]


@kernel()
def triangle_hessian(x, e, blend, stencil, edges, sign, shape, stiffness, rest, limit, length, g, w, h):  # type: ignore[no-untyped-def]
    """The Hessian of triangle e into h (12, 12), of edges what is above the diagonal; whether it is not 0.

    g (3, 12) becomes the ∇α_i; beyond the vertices' part it must be 0 off the diagonal. w (3, 9) is scratch.
    """
    x0, x1, x2 = point(x, stencil[e, 0]), point(x, stencil[e, 1]), point(x, stencil[e, 2])
    e0, e1, e2, normal, square = edges_of(x0, x1, x2)
    if square <= GONE * limit[e]:
        return False
    inverse = 1.0 / math.sqrt(square)  # 1 / 2A
    n = scaled(inverse, normal)
    t0, a0, c0, s0, b0, d0 = tangent_of(row(shape, edges[e, 0], 0), e0, normal)
    t1, a1, c1, s1, b1, d1 = tangent_of(row(shape, edges[e, 1], 0), e1, normal)
    t2, a2, c2, s2, b2, d2 = tangent_of(row(shape, edges[e, 2], 0), e2, normal)
    own, others = _own(stiffness, rest, e, t0, t1, t2), _others(stiffness, rest, e, s0, s1, s2)
    p0, p1, p2 = own[0] * a0 + others[0] * b0, own[1] * a1 + others[1] * b1, own[2] * a2 + others[2] * b2
    exact = 1.0 - blend
    # ∇α_i
    s00, s11, s22, s01, s02, s12 = (
        dot(e0, e0),
        dot(e1, e1),
        dot(e2, e2),
        dot(e0, e1),
        dot(e0, e2),
        dot(e1, e2),
    )
    r0, r1, r2 = -inverse / math.sqrt(s00), -inverse / math.sqrt(s11), -inverse / math.sqrt(s22)
    spin0, spin1, spin2 = row(shape, edges[e, 0], 3), row(shape, edges[e, 1], 3), row(shape, edges[e, 2], 3)
    for k in range(3):
        g[0, k], g[0, 3 + k], g[0, 6 + k] = (
            r0 * s00 * n[k],
            r0 * s01 * n[k] - spin0[k],
            r0 * s02 * n[k] + spin0[k],
        )
        g[1, k], g[1, 3 + k], g[1, 6 + k] = (
            r1 * s01 * n[k] + spin1[k],
            r1 * s11 * n[k],
            r1 * s12 * n[k] - spin1[k],
        )
        g[2, k], g[2, 3 + k], g[2, 6 + k] = (
            r2 * s02 * n[k] - spin2[k],
            r2 * s12 * n[k] + spin2[k],
            r2 * s22 * n[k],
        )
    for i in range(3):
        g[i, 9 + i] = sign[e, i] / length[e, i]
    # ∇f K ∇fᵀ, and what T and S add as they bend
    k00 = a0 * a0 * stiffness[e, 0] + exact * (own[0] * c0 + others[0] * d0)
    k11 = a1 * a1 * stiffness[e, 3] + exact * (own[1] * c1 + others[1] * d1)
    k22 = a2 * a2 * stiffness[e, 5] + exact * (own[2] * c2 + others[2] * d2)
    k01, k02, k12 = b0 * b1 * stiffness[e, 1], b0 * b2 * stiffness[e, 2], b1 * b2 * stiffness[e, 4]
    for b in range(9):
        g0, g1, g2 = g[0, b], g[1, b], g[2, b]
        w[0, b] = k00 * g0 + k01 * g1 + k02 * g2
        w[1, b] = k01 * g0 + k11 * g1 + k12 * g2
        w[2, b] = k02 * g0 + k12 * g1 + k22 * g2
    q0, q1, q2 = g[0, 9], g[1, 10], g[2, 11]
    for a in range(9):
        g0, g1, g2 = g[0, a], g[1, a], g[2, a]
        for b in range(9):
            h[a, b] = g0 * w[0, b] + g1 * w[1, b] + g2 * w[2, b]
        h[a, 9], h[a, 10], h[a, 11] = q0 * w[0, a], q1 * w[1, a], q2 * w[2, a]
    h[9, 9], h[9, 10], h[9, 11] = q0 * q0 * k00, q0 * q1 * k01, q0 * q2 * k02
    h[10, 10], h[10, 11], h[11, 11] = q1 * q1 * k11, q1 * q2 * k12, q2 * q2 * k22
    if exact > 0.0:
        # Σ_i p_i ∂²α_i
        m0, m1, m2 = exact * p0, exact * p1, exact * p2
        q0, q1, q2 = m0 * r0, m1 * r1, m2 * r2
        area = math.sqrt(square)
        _turn(spin0, row(shape, edges[e, 0], 6), e0, n, 0.5 * area * q0 / s00, m0, sign[e, 0], 0, w)
        _turn(spin1, row(shape, edges[e, 1], 6), e1, n, 0.5 * area * q1 / s11, m1, sign[e, 1], 1, w)
        _turn(spin2, row(shape, edges[e, 2], 6), e2, n, 0.5 * area * q2 / s22, m2, sign[e, 2], 2, w)
        u0, u1, u2 = (
            scaled(inverse, cross(n, e0)),
            scaled(inverse, cross(n, e1)),
            scaled(inverse, cross(n, e2)),
        )
        v0, v1, v2 = (
            q0 * s00 + q1 * s01 + q2 * s02,
            q0 * s01 + q1 * s11 + q2 * s12,
            q0 * s02 + q1 * s12 + q2 * s22,
        )
        _add_own(h, 0, n, v0, u0, 1, 2, w)
        _add_own(h, 3, n, v1, u1, 2, 0, w)
        _add_own(h, 6, n, v2, u2, 0, 1, w)
        _add_pair(h, 0, 3, n, v0, v1, u0, u1, 2, w)
        _add_pair(h, 0, 6, n, v0, v2, u0, u2, 1, w)
        _add_pair(h, 3, 6, n, v1, v2, u1, u2, 0, w)
    if square < limit[e]:
        energy = 0.5 * _twice(own, others)
        _fade_hessian((x0, x1, x2), normal, square, limit[e], energy, exact, (p0, p1, p2), g, h)
    return True


@kernel(inline="always")
def _turn(spin, about, e, n, scale, pull, sign, i, w):  # type: ignore[no-untyped-def]
    """pull (n τᵀ + τ nᵀ − ½ s (γ ρᵀ + ρ γᵀ)) of an edge into row i of w (3, 9)."""
    across, spin = scaled(scale, cross(e, n)), scaled(-0.5 * pull * sign, spin)
    for k in range(3):
        for m in range(3):
            w[i, 3 * k + m] = n[k] * across[m] + across[k] * n[m] + spin[k] * about[m] + about[k] * spin[m]


@kernel(inline="always")
def _add_own(h, first, n, slope, b, one, two, w):  # type: ignore[no-untyped-def]
    """Add −slope (n bᵀ + b nᵀ) and two rows of w to the block of a corner."""
    for k in range(3):
        for m in range(3):
            more = w[one, 3 * k + m] + w[two, 3 * k + m]
            h[first + k, first + m] += more - slope * (n[k] * b[m] + b[k] * n[m])


@kernel(inline="always")
def _add_pair(h, first, second, n, slope_c, slope_d, b_c, b_d, opposite, w):  # type: ignore[no-untyped-def]
    """Add −slope_d n b_cᵀ − slope_c b_d nᵀ without a row of w to the blocks of two corners."""
    for k in range(3):
        for m in range(3):
            more = -w[opposite, 3 * k + m] - slope_d * n[k] * b_c[m] - slope_c * b_d[k] * n[m]
            h[first + k, second + m] += more
            h[second + m, first + k] += more


@kernel()
def _fade_hessian(corners, normal, square, limit, energy, exact, pulls, g, h):  # type: ignore[no-untyped-def]
    """Turn the Hessian of f in h (12, 12) into that of f w; of the rest, the regularised one has nothing."""
    weight, first, second = fade(square, limit)
    h *= weight
    slopes, force, bent = np.zeros(12), np.zeros(12), np.zeros((4, 4, 3, 3))
    for c in range(3):
        b, d = corners[(c + 1) % 3], corners[(c + 2) % 3]
        turned = cross(normal, (d[0] - b[0], d[1] - b[1], d[2] - b[2]))
        for i in range(3):
            slopes[3 * c + i] = 2.0 * turned[i]
    for i in range(3):
        for a in range(12):
            force[a] += pulls[i] * g[i, a]
    add_square_hessian(corners, normal, (0, 1, 2), first, bent)
    for a in range(12):
        for b in range(12):
            h[a, b] += exact * first * (force[a] * slopes[b] + slopes[a] * force[b])
            h[a, b] += exact * energy * second * slopes[a] * slopes[b]
            if max(a, b) < 9:
                h[a, b] += exact * energy * bent[a // 3, b // 3, a % 3, b % 3]


@kernel()
def add_hessian(  # type: ignore[no-untyped-def]
    x, stencil, blend, edges, sign, shape, stiffness, rest, limit, length, places, weight, offsets, values
):
    """Add weight (E,) times the Hessians to block rows, as ``scatter.add_mixed_elements`` does.

    Without its loops over any number of vertices and edges, and its array of Hessians.
    """
    g, w, h = np.zeros((3, 12)), np.empty((3, 9)), np.zeros((12, 12))
    blocks = values.reshape(-1, 9)
    for e in range(stencil.shape[0]):
        fetch_ahead(e, offsets, values, 21)
        if not triangle_hessian(
            x, e, blend, stencil, edges, sign, shape, stiffness, rest, limit, length, g, w, h
        ):
            continue
        factor, pair = weight[e], 0
        for a in range(3):
            for b in range(a, 3):
                at = offsets[e, pair]
                pair += 1
                if at >= 0:
                    k, swapped = Index(at >> 1), at & 1
                    first, second = Index(3 * (a + swapped * (b - a))), Index(3 * (b - swapped * (b - a)))
                    for i in range(3):
                        for j in range(3):
                            blocks[k, 3 * i + j] += factor * h[first + Index(i), second + Index(j)]
            for b in range(3):
                at = offsets[e, pair]
                pair += 1
                if at >= 0:
                    k, swapped, place = Index(at >> 1), at & 1, Index(places[e, b]) % Index(3)
                    first, way = place * Index(1 + 2 * swapped), Index(3 - 2 * swapped)
                    for i in range(3):
                        blocks[k, first + way * Index(i)] += factor * h[3 * a + i, 9 + b]
        for a in range(3):
            row_a, one = Index(places[e, a]) // Index(3), Index(places[e, a]) % Index(3)
            for b in range(a, 3):
                at = offsets[e, pair]
                pair += 1
                if at >= 0:
                    k, swapped, other = Index(at >> 1), at & 1, Index(places[e, b]) % Index(3)
                    value = factor * h[9 + a, 9 + b]
                    if swapped:
                        blocks[k, Index(3) * other + one] += value
                    else:
                        blocks[k, Index(3) * one + other] += value
                        if a != b and row_a == Index(places[e, b]) // Index(3):
                            blocks[k, Index(3) * other + one] += value
