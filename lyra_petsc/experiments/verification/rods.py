"""Cantilevers that bend without limit: exact shapes by Chebyshev collocation, numpy only.

A strip clamped horizontally at S = 0 carries its weight w [N/m²] and a tip load P [N/m], both dead and
downwards. θ is the angle below the horizontal, V = P + w (L − S) the vertical force per width carried by
the section at the material coordinate S, so that T = V sin θ is the tension and V cos θ the shear::

    B θ'' + λ V cos θ = 0,   θ(0) = 0, θ'(L) = 0,   T = ½ C (λ³ − λ),   x' = λ cos θ, z' = −λ sin θ

with the stretch λ of a St. Venant-Kirchhoff strip without lateral contraction (λ = 1 where C is infinite).
Sources: Bisshopp and Drucker, Quart. Appl. Math. 3 (1945) 272-275 (tip load); heavy elastica: Romero et
al., ACM TOG 40(4):66 (2021), the cantilever test.

A narrow strip is a rod that cannot bend in its own plane. On a mesh of single diagonals bending and twist
are coupled; with the lateral curvature relaxed, hinges give square cells the energy per area::

    ½ B (κ² + 2 κ τ + 5 τ²)

which for free twist is ½ · 0.8 B κ², but a strip that bends far cannot twist freely: it leaves its plane.
Frame d1 (along), d2 (across), d3 (normal), rotation rate ω = (τ, −κ, 0) in it, force F of the part beyond::

    M' = −λ d1 × F,   M · d1 = B (κ + 5 τ),   M · d2 = −B (κ + τ),   r' = λ d1,   F · d1 = ½ C (λ³ − λ)

M · d3 is what keeps the strip from bending in its plane. Source: Kirchhoff rods, e.g. S. S. Antman, Nonlinear
Problems of Elasticity, 2nd ed., chapter 8.

Columns and tall cantilevers buckle: `column_shape`, `tall_cantilever`. Pressure follows: `pressed_tip`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from lyra_petsc.arrays import Array

NODES = 160
"""Collocation points: 1e-11 for weights up to 1e4 B/L³, whose boundary layer is 0.01 L wide."""


PACE = 0.7
"""Steps of the load in a doubling of it."""


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
    s, _, integral = chebyshev(NODES)

    def bent(state: Array, part: float) -> tuple[Array, Array]:
        """Force and stretch along the strip under this part of the load."""
        force = part * (tip_load + weight * (1.0 - s))
        return force, stretches(force * np.sin(state[:, 0]), stretch)

    def rates(state: Array, part: float) -> Array:
        force, length = bent(state, part)
        return np.stack([state[:, 1], -length * force * np.cos(state[:, 0])], axis=1)

    # θ and θ'
    state = _grown(rates, np.zeros(2), 1, NODES, load=max(weight, tip_load))
    theta, length = state[:, 0], bent(state, 1.0)[1]
    return Cantilever(
        reach=float(integral @ (length * np.cos(theta))),
        drop=float(integral @ (length * np.sin(theta))),
        angle=float(theta[-1]),
        clamp_curvature=float(state[0, 1]),
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


def _grown(
    rates: Callable[[Array, float], Array], start: Array, held: int, nodes: int, *, load: float
) -> Array:
    """The state (nodes + 1, m) of a rod that has grown with its load, by Newton's method.

    Parameters
    ----------
    rates : callable
        Derivatives (nodes + 1, m) along the rod, of a state and the part of the load.
    start : (m,)
        Unknowns everywhere in the straight rod.
    held : int
        So many of them keep their values at the clamp; the others are zero at the free end.
    load : float
        Its size.

    Raises
    ------
    ArithmeticError
        If Newton's method does not converge.
    """
    n, m = nodes + 1, len(start)
    linear = np.einsum("ij,ab->iajb", chebyshev(nodes)[1], np.eye(m))
    linear[0, :held] = linear[-1, held:] = 0.0
    for a in range(m):
        linear[0 if a < held else -1, a, 0 if a < held else -1, a] = 1.0
    inside = np.ones((n, m))
    inside[0, :held] = inside[-1, held:] = 0.0
    ends = np.zeros((n, m))
    ends[0, :held] = start[:held]
    state, steps = np.tile(start, (n, 1)), max(1, math.ceil(PACE * math.log2(1.0 + load)))
    for step in range(1, steps + 1):
        part = ((1.0 + load) ** (step / steps) - 1.0) / load if load > 0.0 else 1.0
        for _ in range(40):
            residual = np.tensordot(linear, state) - ends - inside * rates(state, part)
            jacobian = linear.copy()
            for a in range(m):
                moved = np.zeros_like(state)
                moved[:, a] = size = 1e-6 * (1.0 + np.abs(state[:, a]).max())
                slope = (rates(state + moved, part) - rates(state - moved, part)) / (2.0 * size)
                jacobian[np.arange(n), :, np.arange(n), a] -= inside * slope
            change = np.linalg.solve(jacobian.reshape(n * m, n * m), residual.reshape(-1))
            state = state - change.reshape(n, m)
            if np.abs(change).max() < 1e-9 * (1.0 + np.abs(state).max()):
                break
        else:
            raise ArithmeticError(f"no equilibrium found at load {part * load:g}")
    return state


def stretches(tension: Array, compliance: float) -> Array:
    """Stretch λ of ½ (λ³ − λ) = tension × compliance."""
    length = np.ones_like(tension)
    for _ in range(50):
        change = (0.5 * (length**3 - length) - compliance * tension) / (1.5 * length**2 - 0.5)
        length = length - change
        if np.abs(change).max() < 1e-15:
            break
    return length


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


COUPLED_NODES = 64


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
    s, _, integral = chebyshev(COUPLED_NODES)
    force = np.zeros((COUPLED_NODES + 1, 3))
    force[:, 2] = -weight * (1.0 - s)
    # quaternion of the frame, and the moment in space
    start = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    rates = partial(_rates, force=force, stretch=stretch)
    state = _grown(rates, start, 4, COUPLED_NODES, load=weight)
    along = _frame(state)[0]
    length = stretches((along * force).sum(axis=1), stretch)
    reach, sideways, up = integral @ (length[:, None] * along)
    return float(reach), float(sideways), float(-up)


def _frame(state: Array) -> tuple[Array, Array]:
    """d1 and d2 (n, 3) of the quaternions."""
    w, x, y, z = state[:, :4].T
    one = np.stack([w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
    two = np.stack([2 * (x * y - w * z), w * w - x * x + y * y - z * z, 2 * (y * z + w * x)], axis=1)
    return one, two


def _rates(state: Array, part: float, force: Array, stretch: float) -> Array:
    """Derivatives of the state along the strip, lengths over L and moments over B/L."""
    force = part * force
    one, two = _frame(state)
    moment = state[:, 4:]
    about_one, about_two = (moment * one).sum(axis=1), (moment * two).sum(axis=1)
    twist = 0.25 * (about_one + about_two)
    bend = -about_two - twist
    length = stretches((one * force).sum(axis=1), stretch)
    w, x, y, z = state[:, :4].T
    # ½ q ω with ω = (twist, −bend, 0) in the frame
    turning = 0.5 * np.stack(
        [-x * twist + y * bend, w * twist + z * bend, -w * bend + z * twist, -x * bend - y * twist], axis=1
    )
    return np.concatenate([turning, -length[:, None] * np.cross(one, force)], axis=1)


# -- buckling --------------------------------------------------------------------------------------------


def elliptic(k: float) -> tuple[float, float]:
    """Complete elliptic integrals K and E of modulus 0 ≤ k < 1, by the arithmetic-geometric mean."""
    a, b, total, power = 1.0, math.sqrt(1.0 - k * k), 0.5 * k * k, 0.5
    while a - b > 1e-15 * a:
        c = 0.5 * (a - b)
        a, b = 0.5 * (a + b), math.sqrt(a * b)
        power *= 2.0
        total += power * c * c
    whole = 0.5 * math.pi / a
    return whole, whole * (1.0 - total)


def column_shape(*, shortening: float | None = None, load: float | None = None) -> tuple[float, float]:
    """P L²/B and height over length of a buckled inextensible column with pinned ends.

    One is given: the way of the ends towards each other over the length, or P L²/B > π². With k the sine of
    half the angle at the ends, P L²/B = 4 K², distance of the ends 2 E/K − 1 and height k/K. Clamped, each
    half of the column is the same curve at half the size: four times the load, the same height.
    """
    low, high = 0.0, 1.0 - 1e-15
    for _ in range(200):
        k = 0.5 * (low + high)
        whole, second = elliptic(k)
        if load is None:
            assert shortening is not None
            less = 2.0 - 2.0 * second / whole < shortening
        else:
            less = 4.0 * whole**2 < load
        low, high = (k, high) if less else (low, k)
    return 4.0 * whole**2, k / whole


def tall_cantilever(stiffer: float, warping: float = 0.0) -> tuple[float, float]:
    """P L²/√(EI GJ) at which a cantilever tips over, and the turn of its tip over the deflection over L.

    With u = θ' the rate of turn, s from the clamp over the length and μ = EΓ/(GJ L²) of the warping that
    the clamp suppresses::

        u − μ u'' = κ² ∫ₛ¹ (1 − t)² θ dt,   EI w'' = P L³ (1 − s) θ,   θ(0) = w(0) = w'(0) = 0
        with μ: u(0) = u'(1) = 0

    Without μ κ = 4.0126 (Prandtl and Michell 1899); of a tall strip μ counts as the depth over the length.

    Parameters
    ----------
    stiffer, warping : float
        EI/GJ and μ.
    """
    s, derivative, integral = chebyshev(COUPLED_NODES)
    lever, n = 1.0 - s, len(s)
    from_clamp, to_end = np.zeros((n, n)), np.zeros((n, n))
    from_clamp[1:, 1:] = np.linalg.inv(derivative[1:, 1:])
    to_end[:-1, :-1] = -np.linalg.inv(derivative[:-1, :-1])
    twisting = np.eye(n) - warping * derivative @ derivative
    torque = to_end @ np.diag(lever**2) @ from_clamp
    if warping > 0.0:
        twisting[0], twisting[-1] = np.eye(n)[0], derivative[-1]
        torque[[0, -1]] = 0.0
    values, vectors = np.linalg.eig(np.linalg.solve(twisting, torque))
    lowest = int(np.argmax(values.real))
    factor, turn = 1.0 / math.sqrt(values[lowest].real), from_clamp @ vectors[:, lowest].real
    deflection = factor / math.sqrt(stiffer) * float(integral @ (lever**2 * turn))
    return factor, abs(float(turn[-1]) / deflection)


def pressed_tip(load: float, steps: int = 1000) -> tuple[float, float]:
    """Where the tip (x, z) of an inextensible cantilever of length 1 along x is under a pressure of ``load``
    B/L³ that follows it and lifts it at first.

    With θ, κ, N and Q the angle, the curvature and the tension and shear over B/L², from the tip on, where
    the last three are 0: θ' = κ, κ' = −Q, N' = Q κ, Q' = −N κ − load; by Runge and Kutta.
    """

    def rates(y: Array) -> Array:
        angle, curvature, tension, shear = y[:4]
        turned = [curvature, -shear, shear * curvature, -tension * curvature - load]
        return np.array([*turned, math.cos(angle), math.sin(angle)])

    y, h = np.zeros(6), -1.0 / steps
    for _ in range(steps):
        a = rates(y)
        b = rates(y + 0.5 * h * a)
        c = rates(y + 0.5 * h * b)
        y = y + h / 6.0 * (a + 2.0 * (b + c) + rates(y + h * c))
    cos, sin = math.cos(y[0]), math.sin(y[0])
    return float(-cos * y[4] - sin * y[5]), float(sin * y[4] - cos * y[5])
