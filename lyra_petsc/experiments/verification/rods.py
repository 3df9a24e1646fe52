"""Large deflections of cantilevers and buckled rods: accurate shapes by collocation (scipy).

A strip clamped horizontally at S = 0 carries its weight w [N/m²] and a tip load P [N/m], both dead and
downwards. θ is the angle below the horizontal and V = P + w (L − S) the vertical force per width in the
section at the material coordinate S, so that T = V sin θ is the tension and V cos θ the shear force::

    B θ'' + λ V cos θ = 0,   θ(0) = 0, θ'(L) = 0,   T = ½ C (λ³ − λ),   x' = λ cos θ, z' = −λ sin θ

with the stretch λ of a St. Venant-Kirchhoff strip without lateral contraction (λ = 1 if C is infinite).
Sources: Bisshopp and Drucker, Quart. Appl. Math. 3 (1945) 272-275 (tip load); heavy elastica: Romero et
al., ACM TOG 40(4):66 (2021), the cantilever test.

A narrow strip is a rod that cannot bend in its own plane. Hinges on a mesh of single diagonals couple bending
and twist; with relaxed lateral curvature the energy per area of square cells is::

    ½ B (κ² + 2 κ τ + 5 τ²)

With free twist this is ½ · 0.8 B κ², but a strip with large deflections cannot twist freely: it leaves its
plane. Its frame is d1 (along), d2 (across), d3 (normal), with the rotation rate ω = (τ, −κ, 0) in this frame
and the internal force F::

    M' = −λ d1 × F,   M · d1 = B (κ + 5 τ),   M · d2 = −B (κ + τ),   r' = λ d1,   F · d1 = ½ C (λ³ − λ)

M · d3 is the reaction to the constraint against bending in the plane. Source: Kirchhoff rods, e.g. S. S.
Antman, Nonlinear Problems of Elasticity, 2nd ed., chapter 8.

Buckling of columns and tall cantilevers: `column_shape`, `tall_cantilever`. Follower pressure: `pressed_tip`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from lyra_petsc.arrays import Array

POINTS, ACCURACY = 201, 1e-10
"""Points of a rod in the initial guess, and relative residual of its equations in the solution."""


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
        Angle of the tip below the horizontal.
    clamp_curvature : float
        θ' at the clamp, times L.
    """

    reach: float
    drop: float
    angle: float
    clamp_curvature: float


@cache
def cantilever(weight: float, tip_load: float = 0.0, stretch: float = 0.0) -> Cantilever:
    """The equilibrium that is continuously connected to the straight strip.

    Parameters
    ----------
    weight : float
        Γ = w L³ / B.
    tip_load : float
        α = P L² / B.
    stretch : float
        B / (C L²); 0 for an inextensible strip.

    Raises
    ------
    ArithmeticError
        If Newton's method does not converge.
    """

    # state: θ, θ', reach, drop
    def rates(s: Array, state: Array, part: float) -> Array:
        angle, bend, _, _ = state
        force = part * (tip_load + weight * (1.0 - s))
        length = stretches(force * np.sin(angle), stretch)
        along = length * np.cos(angle)
        return np.stack([bend, -force * along, along, length * np.sin(angle)])

    def ends(clamp: Array, tip: Array) -> Array:
        return np.array([clamp[0], tip[1], clamp[2], clamp[3]])

    state = _grown(rates, ends, [0.0, 0.0, 0.0, 0.0], along=2, load=max(weight, tip_load))
    angle, _, reach, drop = state[:, -1].tolist()
    return Cantilever(reach, drop, angle, float(state[1, 0]))


@cache
def overhang_weight(degrees: float) -> float:
    """Γ at which the chord from the clamp to the tip is ``degrees`` below the horizontal (secant method)."""
    from scipy.optimize import newton

    target = math.tan(math.radians(degrees))

    def off(weight: float) -> float:
        tip = cantilever(weight)
        return tip.drop / tip.reach - target

    # without a derivative this is the secant method
    return float(newton(off, 1.0, x1=8.0 * target, tol=1e-12))


def _grown(
    rates: Callable[..., Array],
    ends: Callable[[Array, Array], Array],
    start: Sequence[float],
    *,
    along: int,
    load: float,
) -> Array:
    """The state (m, n) of a rod from clamp to tip, by continuation in its load and collocation.

    Parameters
    ----------
    rates : callable
        Derivatives (m, n) along the rod as a function of s, the state and the load factor.
    ends : callable
        Residuals (m,) of the boundary conditions at the clamp and at the tip.
    start : (m,)
        The state of the straight rod, the same for all s except for one entry.
    along : int
        This entry: the position along the rod.
    load : float
        Size of the load.

    Raises
    ------
    ArithmeticError
        If no equilibrium is found.
    """
    # load steps per doubling of the load
    s, steps = np.linspace(0.0, 1.0, POINTS), max(1, math.ceil(0.7 * math.log2(1.0 + load)))
    state = np.tile(np.asarray(start)[:, None], POINTS)
    state[along] = s
    for step in range(1, steps + 1):
        part = ((1.0 + load) ** (step / steps) - 1.0) / load if load > 0.0 else 1.0
        accuracy = ACCURACY if step == steps else 1e-4
        s, state, _ = _solved(partial(rates, part=part), ends, s, state, accuracy)
    return state


def _solved(
    rates: Callable[..., Array],
    ends: Callable[..., Array],
    s: Array,
    state: Array,
    accuracy: float = ACCURACY,
    parameters: Sequence[float] | Array | None = None,
) -> tuple[Array, Array, Array]:
    """Solve a boundary value problem; returns s, states and parameters."""
    from scipy.integrate import solve_bvp

    solution = solve_bvp(rates, ends, s, state, p=parameters, tol=accuracy, max_nodes=50_000)
    if not solution.success:
        raise ArithmeticError(f"no equilibrium found: {solution.message}")
    return solution.x, solution.y, solution.p


def stretches(tension: Array, compliance: float) -> Array:
    """The stretch λ with ½ (λ³ − λ) = tension × compliance, the largest root of the cubic (Cardano)."""
    angle = np.arccos(math.sqrt(27.0) * compliance * tension + 0.0j)
    return np.asarray(2.0 / math.sqrt(3.0) * np.cos(angle / 3.0).real)


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

    # state: quaternion of the frame, moment in space, position
    def ends(clamp: Array, tip: Array) -> Array:
        return np.concatenate([clamp[:4] - [1.0, 0.0, 0.0, 0.0], tip[4:7], clamp[7:]])

    start = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    state = _grown(partial(_rates, weight=weight, stretch=stretch), ends, start, along=7, load=weight)
    reach, sideways, up = state[7:, -1].tolist()
    return reach, sideways, -up


def _rates(s: Array, state: Array, part: float, weight: float, stretch: float) -> Array:
    """Derivatives (10, n) of the state along the strip, lengths over L and moments over B/L."""
    force = np.stack([0.0 * s, 0.0 * s, -part * weight * (1.0 - s)])
    (w, x, y, z), moment = state[:4], state[4:7]
    # d1 and d2 of the quaternion
    one = np.stack([w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)])
    two = np.stack([2 * (x * y - w * z), w * w - x * x + y * y - z * z, 2 * (y * z + w * x)])
    about_one, about_two = (moment * one).sum(axis=0), (moment * two).sum(axis=0)
    twist = 0.25 * (about_one + about_two)
    bend = -about_two - twist
    along = stretches((one * force).sum(axis=0), stretch) * one
    # ½ q ω with ω = (twist, −bend, 0) in the frame
    turning = [-x * twist + y * bend, w * twist + z * bend, -w * bend + z * twist, -x * bend - y * twist]
    return np.concatenate([0.5 * np.stack(turning), -np.cross(along, force, axis=0), along])


# -- buckling --------------------------------------------------------------------------------------------


def column_shape(*, shortening: float | None = None, load: float | None = None) -> tuple[float, float]:
    """P L²/B and height over length of a buckled inextensible column with pinned ends.

    Give either the shortening of the distance of the ends over the length, or P L²/B > π². With the sine k of
    half the angle at the ends: P L²/B = 4 K², distance of the ends 2 E/K − 1, height k/K. Each half of a
    clamped column is the same curve at half the size: four times the load, the same height.
    """
    from scipy.optimize import brentq
    from scipy.special import ellipe, ellipk

    def off(k: float) -> float:
        """Residual of the prescribed quantity for the modulus k."""
        if load is None:
            return 2.0 - 2.0 * ellipe(k * k) / ellipk(k * k) - shortening
        return 4.0 * ellipk(k * k) ** 2 - load

    k = brentq(off, 0.0, 1.0 - 1e-15, xtol=1e-15)
    whole = float(ellipk(k * k))
    return 4.0 * whole**2, k / whole


def tall_cantilever(stiffer: float, warping: float = 0.0) -> tuple[float, float]:
    """Buckling load P L²/√(EI GJ) of a tall cantilever, and rotation of its tip over deflection/L.

    With the twist u = θ', the distance s from the clamp over the length, and μ = EΓ/(GJ L²) for the warping
    that the clamp suppresses::

        u − μ u'' = κ² ∫ₛ¹ (1 − t)² θ dt,   EI w'' = P L³ (1 − s) θ,   θ(0) = w(0) = w'(0) = 0
        with μ: u(0) = u'(1) = 0

    For μ = 0: κ = 4.0126 (Prandtl and Michell 1899). The effect of √μ is of the order of depth over length.

    Parameters
    ----------
    stiffer, warping : float
        EI/GJ and μ.
    """

    # θ and ∫ₛ¹ (1 − t)² θ dt, with μ also u and √μ u'; the parameter is κ², the rotation of the tip is 1
    layer = math.sqrt(warping)

    def rates(s: Array, state: Array, square: Array) -> Array:
        turn, torque, *warped = state
        rate = warped[0] if warped else square * torque
        more = [warped[1] / layer, (rate - square * torque) / layer] if warped else []
        return np.stack([rate, -((1.0 - s) ** 2) * turn, *more])

    def ends(clamp: Array, tip: Array, square: Array) -> Array:
        more = [clamp[2], tip[3]] if warping else []
        return np.array([clamp[0], tip[1], tip[0] - 1.0, *more])

    s = np.linspace(0.0, 1.0, POINTS)
    guess = np.stack([s * (2.0 - s), 0.1 * (1.0 - s), 2.0 - 2.0 * s, -2.0 * layer + 0.0 * s])
    _, state, (square,) = _solved(rates, ends, s, guess[: 4 if warping else 2], 1e-8, [16.0])
    factor = math.sqrt(square)
    deflection = factor / math.sqrt(stiffer) * float(state[1, 0])
    return factor, 1.0 / abs(deflection)


def pressed_tip(load: float) -> tuple[float, float]:
    """Tip (x, z) of an inextensible cantilever of length 1 along x under a follower pressure ``load`` B/L³.

    The pressure lifts the strip at first. With angle θ, curvature κ, tension N and shear force Q over B/L²,
    integrated from the tip, where κ, N and Q vanish: θ' = κ, κ' = −Q, N' = Q κ, Q' = −N κ − load.
    """
    from scipy.integrate import solve_ivp

    def rates(s: float, y: Array) -> list[float]:
        angle, curvature, tension, shear = y[:4]
        turned = [curvature, -shear, shear * curvature, -tension * curvature - load]
        return [*turned, math.cos(angle), math.sin(angle)]

    y = solve_ivp(rates, (1.0, 0.0), np.zeros(6), method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    cos, sin = math.cos(y[0]), math.sin(y[0])
    return float(-cos * y[4] - sin * y[5]), float(sin * y[4] - cos * y[5])


def loop_height(bending_length: float) -> float:
    """Height of the elastica of a hanging heart loop over the length of its strip, which is in this unit.

    Half of the strip has length 1 and B = 1: θ'' = Γ (1 − s) cos θ + H sin θ with the horizontal force H,
    from the clamp, where θ = 90°, to the lowest point, where it is −180°.
    """
    last, s = (0.5 / bending_length) ** 3, np.linspace(0.0, 1.0, POINTS)
    angle = math.pi * (0.5 - 1.5 * s)
    steps = np.stack([np.cos(angle), np.sin(angle)]) / (POINTS - 1)
    state, pull = np.vstack([angle, 0.0 * s - 1.5 * math.pi, np.cumsum(steps, axis=1)]), np.array([-8.8])
    for weight in np.linspace(0.0, last, 1 + math.ceil(last / 5.0)):

        def rates(s: Array, state: Array, pull: Array, weight: float = weight) -> Array:
            cos, sin = np.cos(state[0]), np.sin(state[0])
            return np.stack([state[1], weight * (1.0 - s) * cos + pull * sin, cos, sin])

        def ends(clamp: Array, tip: Array, pull: Array) -> Array:
            return np.array([clamp[0] - 0.5 * math.pi, clamp[2], clamp[3], tip[0] + math.pi, tip[2]])

        s, state, pull = _solved(rates, ends, s, state, 1e-8, pull)
    return -0.5 * float(state[3, -1])
