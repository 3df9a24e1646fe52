"""Cantilevers that bend without limit: exact shapes by Chebyshev collocation, numpy only.

A strip clamped horizontally at S = 0 carries its weight w [N/m²] and a tip load P [N/m], both dead and
downwards. θ is the angle below the horizontal, V = P + w (L − S) the vertical force per width carried by
the section at the material coordinate S, so that T = V sin θ is the tension and V cos θ the shear::

    B θ'' + λ V cos θ = 0,   θ(0) = 0, θ'(L) = 0,   T = ½ C (λ³ − λ),   x' = λ cos θ, z' = −λ sin θ

with the stretch λ of a St. Venant-Kirchhoff strip without lateral contraction (λ = 1 where C is infinite).
Sources: Bisshopp and Drucker, Quart. Appl. Math. 3 (1945) 272-275 (tip load); heavy elastica: Romero et
al., ACM TOG 40(4):66 (2021), the cantilever test.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NODES = 160
"""Collocation points: 1e-11 for weights up to 1e4 B/L³, whose boundary layer is 0.01 L wide."""


@dataclass(frozen=True)
class Cantilever:
    """Tip of a loaded cantilever of length 1.

    Attributes
    ----------
    reach : float
        Horizontal distance of the tip from the clamp, over L.
    drop : float
        Vertical distance, over L.
    angle : float [rad]
        Of the tip below the horizontal.
    clamp_curvature : float
        θ' at the clamp, times L.
    """

    reach: float
    drop: float
    angle: float
    clamp_curvature: float


@cache
def cantilever(weight: float, tip_load: float = 0.0, stretch: float = 0.0) -> Cantilever:
    """The shape that grows out of the straight strip.

    Parameters
    ----------
    weight : float
        Γ = w L³ / B.
    tip_load : float
        α = P L² / B.
    stretch : float
        B / (C L²); 0 is an inextensible strip.

    Raises
    ------
    ArithmeticError
        If Newton's method does not converge.
    """
    s, derivative, integral = chebyshev(NODES)
    theta = np.zeros(len(s))
    second = derivative @ derivative
    load = max(weight, tip_load)
    steps = max(1, math.ceil(2.0 * math.log2(1.0 + load)))
    for step in range(1, steps + 1):
        part = ((1.0 + load) ** (step / steps) - 1.0) / load if load > 0.0 else 1.0
        force = part * (tip_load + weight * (1.0 - s))
        theta = _newton(theta, force, stretch, second, derivative)
    length = stretches(force * np.sin(theta), stretch)[0]
    return Cantilever(
        reach=float(integral @ (length * np.cos(theta))),
        drop=float(integral @ (length * np.sin(theta))),
        angle=float(theta[-1]),
        clamp_curvature=float(derivative[0] @ theta),
    )


@cache
def overhang_weight(degrees: float) -> float:
    """Γ at which the chord from the clamp to the tip is ``degrees`` below the horizontal (secant method)."""
    target = math.tan(math.radians(degrees))
    before, now = 1.0, 8.0 * target
    error_before = _slope(before) - target
    for _ in range(50):
        error = _slope(now) - target
        if abs(error) < 1e-11:
            return now
        before, now, error_before = now, now - error * (now - before) / (error - error_before), error
    raise ArithmeticError(f"no overhang found for {degrees} degrees")


def _slope(weight: float) -> float:
    tip = cantilever(weight)
    return tip.drop / tip.reach


def _newton(theta: Array, force: Array, stretch: float, second: Array, derivative: Array) -> Array:
    for _ in range(40):
        tension = force * np.sin(theta)
        length, by_tension = stretches(tension, stretch)
        shear = force * np.cos(theta)
        residual = second @ theta + length * shear
        jacobian = second + np.diag(by_tension * shear * shear - length * tension)
        residual[0], jacobian[0] = theta[0], 0.0
        jacobian[0, 0] = 1.0
        residual[-1], jacobian[-1] = derivative[-1] @ theta, derivative[-1]
        change = np.linalg.solve(jacobian, residual)
        theta = theta - change
        # what round-off leaves of a second derivative on so many nodes
        if np.abs(change).max() < 1e-10:
            return theta
    raise ArithmeticError(f"no equilibrium found at load {force.max():g}")


def stretches(tension: Array, compliance: float) -> tuple[Array, Array]:
    """Stretch λ of ½ (λ³ − λ) = tension × compliance and its derivative by the tension."""
    length = np.ones_like(tension)
    if compliance == 0.0:
        return length, np.zeros_like(tension)
    for _ in range(50):
        change = (0.5 * (length**3 - length) - compliance * tension) / (1.5 * length**2 - 0.5)
        length = length - change
        if np.abs(change).max() < 1e-15:
            break
    return length, compliance / (1.5 * length**2 - 0.5)


def chebyshev(n: int) -> tuple[Array, Array, Array]:
    """Chebyshev points on [0, 1] ascending (n + 1,), differentiation matrix, Clenshaw-Curtis weights."""
    k = np.arange(n + 1)
    t = -np.cos(np.pi * k / n)
    c = np.where((k == 0) | (k == n), 2.0, 1.0) * (-1.0) ** k
    # differences as products of sines: no cancellation between close points
    apart = -2.0 * np.sin(np.pi * (k[:, None] + k) / (2 * n)) * np.sin(np.pi * (k - k[:, None]) / (2 * n))
    np.fill_diagonal(apart, 1.0)
    derivative = (c[:, None] / c) / apart
    np.fill_diagonal(derivative, 0.0)
    np.fill_diagonal(derivative, -derivative.sum(axis=1))
    even = np.arange(2, n + 1, 2)
    moments = np.zeros(n + 1)
    moments[0] = 2.0
    moments[even] = 2.0 / (1.0 - even**2.0)
    ends = np.where((k == 0) | (k == n), 0.5, 1.0)
    cosines = np.cos(np.pi * np.outer(k, k) / n)
    weights = ends * (cosines * (ends * moments)).sum(axis=1) * 2.0 / n
    return 0.5 * (1.0 + t), 2.0 * derivative, 0.5 * weights
