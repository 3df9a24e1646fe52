"""Time schemes, each with one implicit solve a step for the velocity of its stage.

Every scheme is a choice of what the stage's accelerations and positions are in its velocities v::

    v̇ = σ (v − v_h)        x = x_h + c v

with the history v_h, x_h and the numbers σ [1/s], c [s] of the step; and of what the stage says about
the end of the step. Arrays only, rows of the owned vertices.

Sources: backward Euler, the Lyra paper eq. 10-18; generalised-α, Chung & Hulbert, J. Appl. Mech. 60
(1993) 371-375; BDF2 with unequal steps, Hairer, Nørsett & Wanner, Solving ODEs I, sec. III.5.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Arrays = dict[str, Array]


@dataclass(frozen=True)
class Stage:
    """The implicit system of one step.

    Attributes
    ----------
    sigma : float
        dv̇/dv [1/s].
    reach : float
        dx/dv [s].
    after : float
        Time [s] from the start of the step to the stage.
    x, v : (n_owned, 3) or None
        Histories x_h [m] and v_h [m/s]; None: positions and velocities at the start of the step.
    """

    sigma: float
    reach: float
    after: float
    x: Array | None = None
    v: Array | None = None


class Follower(Protocol):
    """What depends on the accelerations at the start of a step."""

    @property
    def needs_acceleration(self) -> bool:
        """Whether it must be told them now."""

    def start_from(self, acceleration: Array) -> None:
        """Take them, (n_owned, 3) [m/s²]."""

    def disturbed(self) -> None:
        """Forces jump at the start of the coming step."""


class Forgetful:
    """What a scheme answers that remembers nothing between steps."""

    @property
    def needs_acceleration(self) -> bool:
        """Whether `start_from` must be called before `Scheme.stage`."""
        return False

    def start_from(self, acceleration: Array) -> None:
        """Take the accelerations (n_owned, 3) [m/s²] at the start of the step."""

    def disturbed(self) -> None:
        """Forces jump at the start of the coming step: forget accelerations."""

    def accepted(self, x: Array, v: Array, free: NDArray[np.bool_], dt: float) -> None:
        """Remember the step that led from x, v; ``free`` marks the coordinates nothing prescribed."""

    def memory(self) -> tuple[Arrays, dict[str, float]]:
        """Vertex arrays (n_owned, 3) and numbers to go on with after a restart."""
        return {}, {}

    def restore(self, arrays: Mapping[str, Array], numbers: Mapping[str, float]) -> None:
        """Go on with a memory."""


class Scheme(Forgetful, ABC):
    """One time scheme and what it remembers between steps.

    Attributes
    ----------
    name : str
        As in a scene's ``time.integrator``.
    order : int
        Of the positions at a fixed time in Δt.
    error_constant : float
        Local error of the positions over Δt² ẍ (order 1) or Δt³ x⃛ (order 2), equal steps.
    ts_type : str
        The TS that solves the stage: ``theta`` (½) for `Midpoint`, else ``beuler``, which is given the
        history in place of the last velocities.
    explicit : bool
        Velocity-dependent loads are taken at the start of the step.
    moves : bool
        It is a motion in time, with damping.
    centred : bool
        What is frozen during a step is frozen at the extrapolated stage, as second order needs.
    given : bool
        Prescribed coordinates take part in the stage with their exact position and velocity at its
        time; else with the velocity that the scheme gives them for their position at the end.
    """

    name: ClassVar[str]
    order: ClassVar[int] = 1
    error_constant: float = 0.5
    ts_type: ClassVar[str] = "beuler"
    explicit: ClassVar[bool] = False
    moves: ClassVar[bool] = True
    centred: ClassVar[bool] = False
    given: bool = False

    @abstractmethod
    def stage_after(self, dt: float) -> float:
        """Time [s] from the start of a step of length dt to its stage."""

    @abstractmethod
    def stage(self, x: Array, v: Array, dt: float) -> Stage:
        """The implicit system of a step of length dt [s] from positions x and velocities v."""

    @abstractmethod
    def end(self, x: Array, v: Array, stage_velocity: Array, dt: float) -> tuple[Array, Array]:
        """Positions and velocities at the end of the step."""


class BackwardEuler(Scheme):
    """x_{n+1} = x_n + Δt v_{n+1}: first order, damps every motion it does not resolve."""

    name = "beuler"

    def stage_after(self, dt: float) -> float:
        return dt

    def stage(self, x: Array, v: Array, dt: float) -> Stage:
        return Stage(1.0 / dt, dt, dt)

    def end(self, x: Array, v: Array, stage_velocity: Array, dt: float) -> tuple[Array, Array]:
        return x + dt * stage_velocity, stage_velocity


class SemiImplicit(BackwardEuler):
    """One Newton iteration of backward Euler from the start of the step, the paper's method."""

    name = "semi-implicit"
    explicit = True


class Midpoint(Scheme):
    """Implicit midpoint rule: second order, keeps energy, damps nothing."""

    name = "midpoint"
    order = 2
    error_constant = 1.0 / 12.0
    ts_type = "theta"
    centred = True
    given = True

    def stage_after(self, dt: float) -> float:
        return 0.5 * dt

    def stage(self, x: Array, v: Array, dt: float) -> Stage:
        return Stage(2.0 / dt, 0.5 * dt, 0.5 * dt)

    def end(self, x: Array, v: Array, stage_velocity: Array, dt: float) -> tuple[Array, Array]:
        return x + dt * stage_velocity, 2.0 * stage_velocity - v


class GeneralisedAlpha(Scheme):
    """Generalised-α: second order, high frequencies damped to ``radius`` a step.

    Parameters
    ----------
    radius : float
        Spectral radius at infinite frequency, 0 (gone in a step) to 1 (kept).
    """

    name = "alpha2"
    order = 2
    centred = True
    given = True

    def __init__(self, radius: float) -> None:
        self._am = (2.0 * radius - 1.0) / (radius + 1.0)
        self._af = radius / (radius + 1.0)
        self._gamma = 0.5 - self._am + self._af
        self._beta = 0.25 * (1.0 - self._am + self._af) ** 2
        # algorithmic accelerations lag by (γ − ½) Δt
        self.error_constant = abs(1.0 / 6.0 - self._beta + 0.5 * (self._gamma - 0.5))
        self._a: Array | None = None
        self._next: Array | None = None

    @property
    def needs_acceleration(self) -> bool:
        return self._a is None

    def start_from(self, acceleration: Array) -> None:
        self._a = acceleration

    def disturbed(self) -> None:
        self._a = None

    def stage_after(self, dt: float) -> float:
        return (1.0 - self._af) * dt

    def stage(self, x: Array, v: Array, dt: float) -> Stage:
        assert self._a is not None
        am, af, gamma, beta = self._am, self._af, self._gamma, self._beta
        sigma = (1.0 - am) / ((1.0 - af) * gamma * dt)
        reach = beta * dt / gamma
        v_h = v + (((1.0 - am) * (1.0 - gamma) / gamma - am) / sigma) * self._a
        x_h = x + ((1.0 - af) * dt - reach) * v + (1.0 - af) * dt * dt * (0.5 - beta / gamma) * self._a
        return Stage(sigma, reach, (1.0 - af) * dt, x_h, v_h)

    def end(self, x: Array, v: Array, stage_velocity: Array, dt: float) -> tuple[Array, Array]:
        assert self._a is not None
        gamma, beta = self._gamma, self._beta
        change = (stage_velocity - v) / ((1.0 - self._af) * dt)
        self._next = (change - (1.0 - gamma) * self._a) / gamma
        moved = x + dt * v + dt * dt * ((0.5 - beta) * self._a + beta * self._next)
        return moved, v + dt * ((1.0 - gamma) * self._a + gamma * self._next)

    def accepted(self, x: Array, v: Array, free: NDArray[np.bool_], dt: float) -> None:
        assert self._next is not None
        self._a = np.where(free, self._next, 0.0)

    def memory(self) -> tuple[Arrays, dict[str, float]]:
        return ({} if self._a is None else {"acceleration": self._a}), {}

    def restore(self, arrays: Mapping[str, Array], numbers: Mapping[str, float]) -> None:
        self._a = arrays.get("acceleration")


class Bdf2(Scheme):
    """Backward differentiation: second order, stiff motions damped.

    Over two past states; over three where the steps are equal, then with 48 % of the third-order formula,
    which keeps the second-order one's damping (L-stable) and halves its error: BDF2OPT, Vatsa, Carpenter &
    Lockard, AIAA 2010-122. The first step is one of generalised-α with spectral radius 0.
    """

    name = "bdf2"
    order = 2
    error_constant = 2.0 / 9.0
    centred = True

    SHARE = 0.48
    """Of the third-order formula; up to 0.5 is A-stable."""

    SAME = 1e-6
    """Steps that differ by less than this fraction are equal."""

    def __init__(self) -> None:
        self._starter = GeneralisedAlpha(0.0)
        self._past: list[tuple[Array, Array, float]] = []

    @property
    def given(self) -> bool:  # type: ignore[override]
        return not self._past

    @property
    def needs_acceleration(self) -> bool:
        return not self._past and self._starter.needs_acceleration

    def start_from(self, acceleration: Array) -> None:
        self._starter.start_from(acceleration)

    def disturbed(self) -> None:
        self._starter.disturbed()

    def stage_after(self, dt: float) -> float:
        return dt

    def weights(self, dt: float) -> tuple[float, list[float]]:
        """σ [1/s], and the weights of the present and the past states in the history (their sum is 1)."""
        r = dt / self._past[0][2]
        if len(self._past) > 1 and all(abs(dt / step - 1.0) < self.SAME for _, _, step in self._past):
            second, third = (1.5, -2.0, 0.5, 0.0), (11.0 / 6.0, -3.0, 1.5, -1.0 / 3.0)
            lead, *rest = (
                self.SHARE * c + (1.0 - self.SHARE) * b for b, c in zip(second, third, strict=True)
            )
            return lead / dt, [-c / lead for c in rest]
        lead = (1.0 + 2.0 * r) / (1.0 + r)
        return lead / dt, [(1.0 + r) ** 2 / (1.0 + 2.0 * r), -r * r / (1.0 + 2.0 * r)]

    def _history(self, x: Array, v: Array, dt: float) -> tuple[float, Array, Array]:
        sigma, (now, *before) = self.weights(dt)
        x_h, v_h = now * x, now * v
        for weight, (past_x, past_v, _) in zip(before, self._past, strict=False):
            x_h += weight * past_x
            v_h += weight * past_v
        return sigma, x_h, v_h

    def stage(self, x: Array, v: Array, dt: float) -> Stage:
        if not self._past:
            return self._starter.stage(x, v, dt)
        sigma, x_h, v_h = self._history(x, v, dt)
        return Stage(sigma, 1.0 / sigma, dt, x_h, v_h)

    def end(self, x: Array, v: Array, stage_velocity: Array, dt: float) -> tuple[Array, Array]:
        if not self._past:
            return self._starter.end(x, v, stage_velocity, dt)
        sigma, x_h, _ = self._history(x, v, dt)
        return x_h + stage_velocity / sigma, stage_velocity

    def accepted(self, x: Array, v: Array, free: NDArray[np.bool_], dt: float) -> None:
        self._past = [(x, v, dt), *self._past[:1]]

    def memory(self) -> tuple[Arrays, dict[str, float]]:
        arrays: Arrays = {}
        numbers: dict[str, float] = {}
        for i, (x, v, dt) in enumerate(self._past):
            arrays |= {f"past_position_{i}": x, f"past_velocity_{i}": v}
            numbers[f"past_dt_{i}"] = dt
        return arrays, numbers

    def restore(self, arrays: Mapping[str, Array], numbers: Mapping[str, float]) -> None:
        self._starter = GeneralisedAlpha(0.0)
        self._past = [
            (arrays[f"past_position_{i}"], arrays[f"past_velocity_{i}"], float(numbers[f"past_dt_{i}"]))
            for i in range(2)
            if f"past_position_{i}" in arrays
        ]


class Static(Scheme):
    """Not a motion: the proximal step of `stepping.equilibrium`, backward Euler from rest.

    Attributes
    ----------
    pseudo : float
        Pseudo time step [s]: the larger, the closer to equilibrium a solve gets.
    """

    name = "static"
    explicit = True
    moves = False

    def __init__(self) -> None:
        self.pseudo = 1.0

    def stage_after(self, dt: float) -> float:
        return dt

    def stage(self, x: Array, v: Array, dt: float) -> Stage:
        return Stage(1.0 / self.pseudo, self.pseudo, dt)

    def end(self, x: Array, v: Array, stage_velocity: Array, dt: float) -> tuple[Array, Array]:
        return x + self.pseudo * stage_velocity, np.zeros_like(v)


def scheme_of(integrator: str, radius: float | None) -> Scheme:
    """The scheme of a scene's ``time.integrator``; ``radius`` is for ``alpha2``."""
    if integrator == "alpha2":
        assert radius is not None
        return GeneralisedAlpha(radius)
    kinds: list[type[Scheme]] = [BackwardEuler, SemiImplicit, Midpoint, Bdf2, Static]
    return {kind.name: kind for kind in kinds}[integrator]()
