"""What every integrator is: one implicit solve a step, for the velocity of its stage.

Every integrator is a choice of what the stage's accelerations and positions are in its velocities v::

    v̇ = σ (v − v_h)        x = x_h + c v

with the history v_h, x_h and the numbers σ [1/s], c [s] of the step; and of what the stage says about
the end of the step. Arrays only, rows of the owned vertices.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array

Arrays = dict[str, Array]


@dataclass(frozen=True)
class Stage:
    """The implicit system of one step.

    Attributes
    ----------
    sigma : float
        dv̇/dv [1/s].
    c : float
        dx/dv [s].
    offset : float
        Time [s] from the start of the step to the stage.
    x, v : (n_owned, 3) or None
        Histories x_h [m] and v_h [m/s]; None: positions and velocities at the start of the step.
    """

    sigma: float
    c: float
    offset: float
    x: Array | None = None
    v: Array | None = None


class NeedsAcceleration(Protocol):
    """What depends on the accelerations at the start of a step."""

    @property
    def needs_acceleration(self) -> bool:
        """Whether it must be told them now."""

    def set_acceleration(self, acceleration: Array) -> None:
        """Take them, (n_owned, 3) [m/s²]."""

    def restart(self) -> None:
        """Forces jump at the start of the coming step."""


class NoHistory:
    """Base of integrators that keep no history between steps."""

    @property
    def needs_acceleration(self) -> bool:
        """Whether `set_acceleration` must be called before `Integrator.stage`."""
        return False

    def set_acceleration(self, acceleration: Array) -> None:
        """Take the accelerations (n_owned, 3) [m/s²] at the start of the step."""

    def restart(self) -> None:
        """Forces jump at the start of the coming step: forget accelerations."""

    def record_step(self, x: Array, v: Array, free: NDArray[np.bool_], dt: float) -> None:
        """Remember the step that led from x, v; ``free`` marks the coordinates nothing prescribed."""

    def shift_past_positions(self, change: Array) -> None:
        """Add ``change`` (n_owned, 3) [m] to remembered positions, as their reference is another."""

    def shift_past_velocities(self, change: Array) -> None:
        """Velocities jump by ``change`` (n_owned, 3) [m/s] at the end of the step: change what is remembered
        as if they had been so before, too.
        """

    def saved_state(self) -> tuple[Arrays, dict[str, float]]:
        """Vertex arrays (n_owned, 3) and numbers to go on with after a restart."""
        return {}, {}

    def restore(self, arrays: Mapping[str, Array], numbers: Mapping[str, float]) -> None:
        """Restore a `saved_state`."""


class Integrator(NoHistory, ABC):
    """One integrator and what it remembers between steps.

    Attributes
    ----------
    name : str
        As in a scene's ``time.integrator``.
    order : int
        Of the positions at a fixed time in Δt.
    ts_type : str
        The TS that solves the stage: ``theta`` (½) for the midpoint rule, else ``beuler``, which is given the
        history in place of the last velocities.
    lagged_loads : bool
        Velocity-dependent loads are taken at the start of the step.
    iterates : bool
        Newton's method solves for the stage; else one linear solve does.
    dynamic : bool
        It is a motion in time, with damping.
    centred : bool
        What is frozen during a step is frozen at the extrapolated stage, as second order needs.
    gain_window : int
        Steps over which its gain of energy is averaged before it is judged: a scheme of several steps gives
        back in the next ones what it has taken in one.
    exact_work : bool
        Kinetic energy changes by just the work of the stage's forces, so that it is known what contact adds.
    surplus : float
        Energy [J] that it has added and not yet lost again, where that is known.
    handles_at_stage : bool
        Prescribed coordinates take part in the stage with their exact position and velocity at its
        time; else with the velocity that the integrator gives them for their position at the end.
    """

    name: ClassVar[str]
    order: ClassVar[int] = 1
    ts_type: ClassVar[str] = "beuler"
    lagged_loads: ClassVar[bool] = False
    iterates: ClassVar[bool] = True
    dynamic: ClassVar[bool] = True
    centred: ClassVar[bool] = False
    gain_window: ClassVar[int] = 1
    exact_work: ClassVar[bool] = False
    surplus: float = 0.0
    handles_at_stage: bool = False

    @property
    def starts_at_rest(self) -> bool:
        """Whether a solve starts where the sheet is, at rest."""
        return not (self.iterates and self.dynamic)

    @property
    @abstractmethod
    def error_constant(self) -> float:
        """Local error of the positions in the last step over Δt² ẍ (order 1) or Δt³ x⃛ (order 2)."""

    @abstractmethod
    def stage_offset(self, dt: float) -> float:
        """Time [s] from the start of a step of length dt to its stage."""

    @abstractmethod
    def stage(self, x: Array, v: Array, dt: float) -> Stage:
        """The implicit system of a step of length dt [s] from positions x and velocities v."""

    @abstractmethod
    def end(self, x: Array, v: Array, stage_velocity: Array, dt: float) -> tuple[Array, Array]:
        """Positions and velocities at the end of the step."""
