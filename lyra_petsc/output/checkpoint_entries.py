"""The schema of a checkpoint: its numbers and texts, and the arrays that belong to them.

A check sum shows that a file is as it was written, not that a run has written it.
"""

from __future__ import annotations

from dataclasses import fields
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, Self, TypeAlias, get_type_hints

from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError, create_model, model_validator

from lyra_petsc.scene.schema import INTEGRATORS
from lyra_petsc.stepping.energy_balance import Budget
from lyra_petsc.stepping.energy_guard import GuardState

LARGEST = 1e50
"""Largest magnitude of a number [SI]; energies of larger positions overflow."""

Count = Annotated[int, Field(ge=0, le=2**31 - 1)]
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
NonNegative = Annotated[float, Field(ge=0.0)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Duration = Annotated[float, Field(ge=1.0 / LARGEST, le=LARGEST)]

ABSENT: Any = Field(default=None)
"""Of an entry that may be missing; where it is there, it is not null."""

OPTIONAL_ARRAYS = {"acceleration", "slope", "rate"}
"""Arrays that a checkpoint may or may not hold."""


class _Entries(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)


def _entries_of(kind: type) -> Any:
    """The schema of a dataclass of numbers and lists or mappings of numbers, all of them required."""
    bounded = {float: Number, int: Count, list[float]: list[Number], dict[str, float]: dict[str, Number]}
    hints = get_type_hints(kind)
    entries: dict[str, Any] = {
        each.name: (bounded.get(hints[each.name], Number | None), ...) for each in fields(kind)
    }
    return create_model(kind.__name__, __base__=_Entries, **entries)


if TYPE_CHECKING:
    BudgetEntries: TypeAlias = _Entries
    GuardEntries: TypeAlias = _Entries
else:
    BudgetEntries, GuardEntries = _entries_of(Budget), _entries_of(GuardState)


class Totals(_Entries):
    """Numbers of iterations and of rejected attempts."""

    newton_iterations: Count
    linear_iterations: Count
    rejected: Count


class IntegratorHistory(_Entries):
    """Lengths [s] of past steps, see ``saved_state`` of the integrators."""

    past_dt_0: Duration = ABSENT
    past_dt_1: Duration = ABSENT
    slope_dt: NonNegative = ABSENT


class ExtrapolationHistory(_Entries):
    """Times [s], or load factors, of past values, see `Extrapolation.saved_state`."""

    past_0: Number = ABSENT
    past_1: Number = ABSENT
    degree: Count

    @property
    def times(self) -> list[float]:
        """Times of the past values, the oldest first."""
        return [time for time in (self.past_0, self.past_1) if time is not None]


class EquilibriumHistory(_Entries):
    """See `Equilibrium.saved_state`."""

    scale: NonNegative
    in_vain: Count
    sufficed: NonNegative
    slid: Count
    slid_in: Number
    extrapolation: ExtrapolationHistory


class CheckpointEntries(_Entries):
    """Numbers and texts of a checkpoint, see `SteppedScene.saved_state`."""

    time: Annotated[float, Field(ge=0.0, le=LARGEST)]
    step: Count
    last_state: Count
    scheme: str
    budget: BudgetEntries
    totals: Totals
    stability: dict[str, JsonValue]
    repeated: dict[str, Count]
    least: Duration | None
    notes: list[str]
    told: list[str]
    factor: Duration
    good: Count
    patience: Annotated[int, Field(ge=1, le=2**31 - 1)]
    nominal: Duration
    estimated_error: NonNegative
    integrator: IntegratorHistory
    preset: str
    convex: bool
    tolerance: Fraction
    usual: NonNegative
    blend: Fraction
    too_little: NonNegative
    enough: NonNegative
    shift: NonNegative
    energy: GuardEntries | None
    late_starts: list[Duration]
    obstacles: dict[str, tuple[int, int]]
    extrapolation: ExtrapolationHistory = ABSENT
    equilibrium: EquilibriumHistory = ABSENT

    @model_validator(mode="after")
    def _check_together(self) -> Self:
        static = self.scheme == "static"
        if static is (self.equilibrium is None) or static is (self.energy is not None):
            raise ValueError("a motion has no equilibrium, and an equilibrium no balance of a motion")
        if not static and self.scheme not in INTEGRATORS:
            raise ValueError(f"scheme is {self.scheme}")
        if self.integrator.past_dt_0 is None and self.integrator.past_dt_1 is not None:
            raise ValueError("past_dt_1 is without past_dt_0")
        for past in self._extrapolations:
            if not all(earlier < later for earlier, later in pairwise([*past.times, self.time])):
                raise ValueError("past times do not ascend")
        if (
            len(set(self.late_starts)) < len(self.late_starts)
            or max(self.late_starts, default=0.0) > self.time
        ):
            raise ValueError("late_starts are not distinct times of the past")
        return self

    @property
    def _extrapolations(self) -> list[ExtrapolationHistory]:
        of_equilibria = self.equilibrium.extrapolation if self.equilibrium else None
        return [each for each in (self.extrapolation, of_equilibria) if each is not None]

    @property
    def arrays(self) -> set[str]:
        """Names of the arrays (n, 3) besides those of terms that belong to these entries."""
        lengths = (self.integrator.past_dt_0, self.integrator.past_dt_1)
        steps = [number for number, dt in enumerate(lengths) if dt is not None]
        return {
            "position",
            "velocity",
            *(["pull"] if self.equilibrium else []),
            *(f"start_{number}" for number in range(len(self.late_starts))),
            *(f"past_{kind}_{number}" for kind in ("position", "velocity") for number in steps),
            *(f"past_{number}" for past in self._extrapolations for number in range(len(past.times))),
        }


def check_entries(text: str) -> tuple[dict[str, Any], set[str]]:
    """The entries in the JSON ``text`` of a checkpoint, and `CheckpointEntries.arrays`.

    Raises
    ------
    ValueError
        In one line, if no run has written the text.
    """
    try:
        content = CheckpointEntries.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise ValueError(f"{place}: {first['msg']}" if place else str(first["msg"])) from None
    return content.model_dump(exclude_unset=True), content.arrays
