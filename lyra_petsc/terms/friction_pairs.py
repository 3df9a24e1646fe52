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
from lyra_petsc.kernels.element import kernel


@kernel()
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
def hessians(x, stencil, beta, normal, start, slip, stiffness, limit, lo, blend, out):  # type: ignore[no-untyped-def]
    """Hessians [N/m] of pairs lo, lo + 1, … into out (n, 4, 4, 3, 3): all positive semidefinite.

    ``blend`` 0 is exact; 1 takes a spring of the stiffness μ N / |u| for what slides, whose energy is nowhere
    less.
    """
    u = np.empty(3)
    for n in range(len(out)):
        e = lo + n
        m = way(x, e, stencil, beta, normal, start, slip, u)
        sticks = stiffness[e] * m <= limit[e]
        factor = stiffness[e] if sticks else limit[e] / m
        less = 0.0 if sticks else (1.0 - blend) * factor / (m * m)
        out[n] = 0.0
        for a in range(4):
            for b in range(a, 4):
                both = beta[e, a] * beta[e, b]
                if both == 0.0:
                    continue
                for k in range(3):
                    for j in range(3):
                        same = 1.0 if k == j else 0.0
                        block = factor * (same - normal[e, k] * normal[e, j]) - less * u[k] * u[j]
                        out[n, a, b, k, j] = out[n, b, a, k, j] = both * block


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
def find(keys, among, place):  # type: ignore[no-untyped-def]
    """Which row of ``among`` (M, n) each row of keys (N, n) is, −1 where none is; both are ascending."""
    b = 0
    for a in range(len(keys)):
        place[a] = -1
        while b < len(among):
            order = 0
            for k in range(keys.shape[1]):
                if keys[a, k] != among[b, k]:
                    order = 1 if keys[a, k] > among[b, k] else -1
                    break
            if order == 0:
                place[a] = b
            if order <= 0:
                break
            b += 1
