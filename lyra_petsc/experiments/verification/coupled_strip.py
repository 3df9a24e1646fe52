"""A heavy clamped strip whose bending twists it: exact shape in space, numpy only.

A narrow strip is a rod that cannot bend in its own plane. On a mesh of single diagonals bending and twist
are coupled; with the lateral curvature relaxed, hinges give square cells the energy per area::

    ½ B (κ² + 2 κ τ + 5 τ²)

which for free twist is ½ · 0.8 B κ², but a strip that bends far cannot twist freely: it leaves its plane.
Frame d1 (along), d2 (across), d3 (normal), rotation rate ω = (τ, −κ, 0) in it, force F of the part beyond::

    M' = −λ d1 × F,   M · d1 = B (κ + 5 τ),   M · d2 = −B (κ + τ),   r' = λ d1,   F · d1 = ½ C (λ³ − λ)

M · d3 is what keeps the strip from bending in its plane. Source: Kirchhoff rods, e.g. S. S. Antman, Nonlinear
Problems of Elasticity, 2nd ed., chapter 8.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.experiments.verification.elastica import chebyshev, stretches

Array = NDArray[np.float64]

NODES = 64
UNKNOWNS = 7
"""Quaternion of the frame, and the moment in space."""


@cache
def heavy_coupled_strip(weight: float, stretch: float = 0.0) -> tuple[float, float, float]:
    """Tip (reach, sideways, drop) over L of a strip clamped horizontally along x, diagonals towards +y.

    Parameters
    ----------
    weight : float
        w L³ / B, B the nominal stiffness.
    stretch : float
        B / (C L²).

    Raises
    ------
    ArithmeticError
        If Newton's method does not converge.
    """
    s, derivative, integral = chebyshev(NODES)
    state = np.zeros((NODES + 1, UNKNOWNS))
    state[:, 0] = 1.0
    linear = np.einsum("ij,ab->iajb", derivative, np.eye(UNKNOWNS))
    steps = max(1, math.ceil(1.5 * math.log2(1.0 + weight)))
    for step in range(1, steps + 1):
        part = (1.0 + weight) ** (step / steps) - 1.0
        force = np.zeros((NODES + 1, 3))
        force[:, 2] = -part * (1.0 - s)
        state = _newton(state, force, stretch, linear)
    along = _frame(state)[0]
    length, _ = stretches((along * force).sum(axis=1), stretch)
    reach, sideways, up = integral @ (length[:, None] * along)
    return float(reach), float(sideways), float(-up)


def _newton(state: Array, force: Array, stretch: float, linear: Array) -> Array:
    n = len(state)
    clamped = np.array([1.0, 0.0, 0.0, 0.0])
    for _ in range(40):
        rates = _rates(state, force, stretch)
        residual = np.tensordot(linear, state) - rates
        jacobian = linear.copy()
        for column in range(UNKNOWNS):
            size = 1e-6 * (1.0 + np.abs(state[:, column]).max())
            moved = np.zeros_like(state)
            moved[:, column] = size
            slope = (_rates(state + moved, force, stretch) - _rates(state - moved, force, stretch)) / (
                2 * size
            )
            jacobian[np.arange(n), :, np.arange(n), column] -= slope
        jacobian[0, :4] = 0.0
        jacobian[0, range(4), 0, range(4)] = 1.0
        jacobian[-1, 4:] = 0.0
        jacobian[-1, range(4, UNKNOWNS), -1, range(4, UNKNOWNS)] = 1.0
        residual[0, :4] = state[0, :4] - clamped
        residual[-1, 4:] = state[-1, 4:]
        size_of_all = n * UNKNOWNS
        change = np.linalg.solve(jacobian.reshape(size_of_all, size_of_all), residual.reshape(-1))
        state = state - change.reshape(state.shape)
        if np.abs(change).max() < 1e-9 * (1.0 + np.abs(state).max()):
            return state
    raise ArithmeticError(f"no equilibrium found at load {np.abs(force).max():g}")


def _frame(state: Array) -> tuple[Array, Array]:
    """d1 and d2 (n, 3) of the quaternions."""
    w, x, y, z = state[:, :4].T
    one = np.stack([w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
    two = np.stack([2 * (x * y - w * z), w * w - x * x + y * y - z * z, 2 * (y * z + w * x)], axis=1)
    return one, two


def _rates(state: Array, force: Array, stretch: float) -> Array:
    """Derivatives of the state along the strip, lengths over L and moments over B/L."""
    one, two = _frame(state)
    moment = state[:, 4:]
    about_one, about_two = (moment * one).sum(axis=1), (moment * two).sum(axis=1)
    twist = 0.25 * (about_one + about_two)
    bend = -about_two - twist
    length, _ = stretches((one * force).sum(axis=1), stretch)
    w, x, y, z = state[:, :4].T
    # ½ q ω with ω = (twist, −bend, 0) in the frame
    turning = 0.5 * np.stack(
        [-x * twist + y * bend, w * twist + z * bend, -w * bend + z * twist, -x * bend - y * twist], axis=1
    )
    return np.concatenate([turning, -length[:, None] * np.cross(one, force)], axis=1)
