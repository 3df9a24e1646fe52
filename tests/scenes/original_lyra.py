"""The original program's step, written anew with dense NumPy from its published description.

One linear solve a step at (x_n, v_n): A v = M v_n + Δt (f + f_handle), A = M + Δt (Δt + γ) K + Δt² k.
Membrane energy per area ½ k0 G00² + k1 G00 G11 + ½ k2 G11² + k3 G01² with all coefficients doubled;
K keeps tensile geometric stiffness only. Bending k_e l² θ² / (8 (A0 + A1)) with the Gauss-Newton K.
Facts: the Lyra paper and its sources.
"""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array

HANDLE = 1000.0  # N/m


def scatter(corners: Array, local: Array, blocks: Array, n: int) -> tuple[Array, Array]:
    """Force (V, 3) and stiffness (3V, 3V) from element gradients (E, 3k) and Hessians (E, 3k, 3k)."""
    unknowns = (3 * corners[:, :, None] + np.arange(3)).reshape(len(corners), -1)
    force, stiffness = np.zeros(3 * n), np.zeros((3 * n, 3 * n))
    np.subtract.at(force, unknowns, local)
    np.add.at(stiffness, (unknowns[:, :, None], unknowns[:, None, :]), blocks)
    return force.reshape(n, 3), stiffness


def outer(a: Array, b: Array) -> Array:
    """Outer products of the rows."""
    return a[:, :, None] * b[:, None, :]


def membrane(x: Array, triangles: Array, uv: Array, c: tuple[float, ...]) -> tuple[Array, Array]:
    """Force (V, 3) and stiffness (3V, 3V)."""
    k0, k1, k2, k3 = (2.0 * value for value in c)
    u, p = uv[triangles], x[triangles]
    rest = np.stack([u[:, 1] - u[:, 0], u[:, 2] - u[:, 0]], axis=2)
    area = (0.5 * np.abs(np.linalg.det(rest)))[:, None]
    inverse = np.linalg.inv(rest)
    gradients = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)  # (E, corner, 2)
    f = np.stack([p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]], axis=2) @ inverse
    g = 0.5 * (f.transpose(0, 2, 1) @ f - np.eye(2))
    # derivatives of G00, G11, G01 with respect to the nine coordinates
    d00 = outer(gradients[:, :, 0], f[:, :, 0]).reshape(-1, 9)
    d11 = outer(gradients[:, :, 1], f[:, :, 1]).reshape(-1, 9)
    d01 = outer(gradients[:, :, 0], f[:, :, 1]) + outer(gradients[:, :, 1], f[:, :, 0])
    d01 = 0.5 * d01.reshape(-1, 9)
    s00, s11 = k0 * g[:, 0, 0] + k1 * g[:, 1, 1], k1 * g[:, 0, 0] + k2 * g[:, 1, 1]
    s01 = 2.0 * k3 * g[:, 0, 1]
    local = area * (s00[:, None] * d00 + s11[:, None] * d11 + s01[:, None] * d01)
    blocks = k0 * outer(d00, d00) + k1 * (outer(d00, d11) + outer(d11, d00)) + k2 * outer(d11, d11)
    blocks = blocks + 2.0 * k3 * outer(d01, d01)
    for axis, stress in ((0, s00), (1, s11)):
        tensile = np.maximum(stress, 0.0)[:, None, None] * outer(gradients[:, :, axis], gradients[:, :, axis])
        blocks = blocks + np.einsum("eab,ij->eaibj", tensile, np.eye(3)).reshape(-1, 9, 9)
    return scatter(triangles, local, area[:, :, None] * blocks, len(x))


def dihedral(p: Array) -> Array:
    """Angles of hinges p (H, 4, 3): edge 0-1, opposite 2 and 3."""
    e = p[:, 1] - p[:, 0]
    n1, n2 = np.cross(e, p[:, 2] - p[:, 0]), np.cross(p[:, 3] - p[:, 0], e)
    sine = (np.cross(n1, n2) * e).sum(axis=1) / np.linalg.norm(e, axis=1)
    return np.arctan2(sine, (n1 * n2).sum(axis=1))


def bending(x: Array, hinges: Array, uv: Array, area: Array, k_e: float) -> tuple[Array, Array]:
    """Force (V, 3) and stiffness (3V, 3V); ``area`` (H,) is A0 + A1. θ is differentiated numerically."""
    length = np.linalg.norm(uv[hinges[:, 1]] - uv[hinges[:, 0]], axis=1)
    factor = k_e * length**2 / (8.0 * area)
    p = x[hinges]
    slope = np.empty((len(hinges), 12))
    for i in range(12):
        step = np.zeros(12)
        step[i] = 1e-6
        slope[:, i] = (dihedral(p + step.reshape(4, 3)) - dihedral(p - step.reshape(4, 3))) / 2e-6
    local = (2.0 * factor * dihedral(p))[:, None] * slope
    return scatter(hinges, local, 2.0 * factor[:, None, None] * outer(slope, slope), len(x))


def simulate(
    x: Array,
    uv: Array,
    triangles: Array,
    held: list[int],
    *,
    density: float,
    c: tuple[float, ...],
    k_e: float,
    gamma: float,
    gravity: tuple[float, float, float],
    dt: float,
    steps: int,
) -> Array:
    """Positions (V, 3) after the steps, from rest; ``held`` vertices on springs at their start."""
    n = len(x)
    sides = uv[triangles]
    areas = 0.5 * np.abs(np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]))
    mass = np.bincount(triangles.ravel(), np.repeat(areas * density / 3.0, 3), n)
    edges: dict[tuple[int, int], tuple[int, int]] = {}
    hinges, both = [], []
    for f, (a, b, d) in enumerate(triangles):
        for p, q, r in ((a, b, d), (b, d, a), (d, a, b)):
            if (q, p) in edges:
                other, opposite = edges[q, p]
                hinges.append([q, p, opposite, r])
                both.append(areas[f] + areas[other])
            edges[p, q] = (f, r)
    hinge_rows, hinge_areas = np.array(hinges), np.array(both)
    spring = np.zeros((n, 3))
    spring[held] = HANDLE
    start, v = x.copy(), np.zeros((n, 3))
    inertia = np.repeat(mass, 3)
    for _ in range(steps):
        f_membrane, k_membrane = membrane(x, triangles, uv, c)
        f_bending, k_bending = bending(x, hinge_rows, uv, hinge_areas, k_e)
        force = f_membrane + f_bending + mass[:, None] * np.array(gravity) + spring * (start - x)
        a = np.diag(inertia + dt**2 * spring.ravel()) + dt * (dt + gamma) * (k_membrane + k_bending)
        v = np.linalg.solve(a, inertia * v.ravel() + dt * force.ravel()).reshape(n, 3)
        x = x + dt * v
    return x
