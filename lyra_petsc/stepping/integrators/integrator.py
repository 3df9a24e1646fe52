"""Base class of the integrators: one implicit solve per step, for the velocities of its stage.

An integrator defines accelerations and positions of the stage as functions of its velocities v::

    v̇ = σ (v − v_h)        x = x_h + c v

with the history x_h, v_h and the numbers σ [1/s], c [s] of the step, and the state at the end of the step as
a function of the stage. All arrays have a row for each owned block row.
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
    """An object that needs the accelerations at the start of some steps."""

    @property
    def needs_acceleration(self) -> bool:
        """Whether `set_acceleration` must be called before the step."""

    def set_acceleration(self, acceleration: Array) -> None:
        """Set the accelerations (n_owned, 3) [m/s²] at the start of the step."""

    def restart(self) -> None:
        """Prepare for a jump of the forces at the start of the next step."""


class NoHistory:
    """Base of integrators that keep no history between steps."""

    @property
    def needs_acceleration(self) -> bool:
        """Whether `set_acceleration` must be called before `Integrator.stage`."""
        return False

    def set_acceleration(self, acceleration: Array) -> None:
        """Set the accelerations (n_owned, 3) [m/s²] at the start of the step."""

    def restart(self) -> None:
        """Discard the history, as forces jump at the start of the next step."""

    def record_step(self, x: Array, v: Array, free: NDArray[np.bool_], dt: float) -> None:
        """Add the accepted step from x, v to the history; ``free`` marks the unknowns not prescribed."""

    def shift_past_positions(self, change: Array) -> None:
        """Add ``change`` (n_owned, 3) [m] to the past positions, after a change of their reference."""

    def shift_past_velocities(self, change: Array) -> None:
        """Add ``change`` (n_owned, 3) [m/s] to the past velocities, and adapt the past positions.

        It is for a jump of the velocities at the end of the step, so that the history has no jump.
        """

    def saved_state(self) -> tuple[Arrays, dict[str, float]]:
        """Arrays (n_owned, 3) and numbers of the history, for checkpoints and `restore`."""
        return {}, {}

    def restore(self, arrays: Mapping[str, Array], numbers: Mapping[str, float]) -> None:
        """Restore a `saved_state`."""


class Integrator(NoHistory, ABC):
    """An integrator and its history.

    Attributes
    ----------
    name : str
        Its name in a scene's ``time.integrator``.
    order : int
        Order of accuracy of the positions.
    ts_type : str
        The TS that solves the stage: ``theta`` (½) for the midpoint rule, else ``beuler`` with the history in
        place of the last velocities.
    lagged_loads : bool
        Whether velocity-dependent loads are those at the start of the step.
    iterates : bool
        Whether Newton's method solves for the stage, not a single linear solve.
    dynamic : bool
        Whether it is a motion in time; False for static analyses.
    centred : bool
        Whether data are frozen at the extrapolated stage, as second order requires.
    gain_window : int
        Number of steps over which the energy guard averages gains: multistep methods alternate between gains
        and losses.
    damps_stiff : bool
        Whether the motion of stiff parts is damped, so that these come to rest.
    moves_uniformly : bool
        Whether the velocity of the stage is the displacement of the step over Δt.
    handles_at_stage : bool
        Whether prescribed unknowns have their exact positions and velocities at the time of the stage. If
        not, they have the velocity with which the integrator reaches their position at the end of the step.
    """

    name: ClassVar[str]
    order: ClassVar[int] = 1
    ts_type: ClassVar[str] = "beuler"
    lagged_loads: ClassVar[bool] = False
    iterates: ClassVar[bool] = True
    dynamic: ClassVar[bool] = True
    centred: ClassVar[bool] = False
    gain_window: ClassVar[int] = 1
    damps_stiff: ClassVar[bool] = True
    moves_uniformly: ClassVar[bool] = False
    handles_at_stage: bool = False

    @property
    def starts_at_rest(self) -> bool:
        """Whether a solve starts from the positions at the start of the step, at rest."""
        return not (self.iterates and self.dynamic)

    def for_contact(self) -> Integrator:
        """The integrator for steps in which something touches: one whose stage is at the end of the step, and
        which solves it by Newton's method.
        """
        return self

    @property
    @abstractmethod
    def error_constant(self) -> float:
        """Local error of the positions in a step over Δt² ẍ (order 1) or Δt³ x⃛ (order 2)."""

    @abstractmethod
    def stage_offset(self, dt: float) -> float:
        """Time [s] from the start of a step of length dt to its stage."""

    @abstractmethod
    def stage(self, x: Array, v: Array, dt: float) -> Stage:
        """The implicit system of a step of length dt [s] from positions x and velocities v."""

    @abstractmethod
    def end(self, x: Array, v: Array, stage_velocity: Array, dt: float) -> tuple[Array, Array]:
        """Positions and velocities at the end of the step."""
