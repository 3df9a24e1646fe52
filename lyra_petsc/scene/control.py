"""Scene blocks that steer the run: time, output, solver."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, field_validator, model_validator
from typing_extensions import Self

from lyra_petsc.nearest import nearest
from lyra_petsc.scene.block import Block
from lyra_petsc.scene.rules import absent, given, when
from lyra_petsc.scene.values import Count, Flag, Fraction, JsonSchema, Positive, StepLength, problem, shown

INTEGRATORS = ("beuler", "semi-implicit", "midpoint", "alpha2", "bdf2")
ANALYSES = ("dynamic", "static")
TOLERANCE = 1e-3
SPECTRAL_RADIUS = 0.5
LOAD_STEP = 0.25
FIELD_UNITS = {
    "velocity": "m/s",
    "green_strain": "1",
    "stress": "N/m",
    "membrane_energy": "J/m²",
    "bending_energy": "J/m²",
    "curvature": "1/m",
    "rank": "1",
}
FIELDS = tuple(FIELD_UNITS)


_FIELDS = {"type": "array", "items": {"enum": list(FIELDS)}}


def _word_of(value: Any, known: tuple[str, ...]) -> Any:
    if value not in known:
        raise problem(f"must be one of {', '.join(known)}, not {shown(value)}")
    return value


class Time(Block):
    """Time stepping, or the way to an equilibrium.

    Attributes
    ----------
    analysis : str
        ``dynamic``: a motion in time; ``static``: the equilibrium under the loads, which grow with a
        load factor from 0 to 1 that takes the place of time.
    end : float [s]
        Time at which the run ends; 1 in a static analysis.
    step : float [s] or "auto"
        Nominal and largest Δt; ``auto``: as the tolerance asks. In a static analysis the first
        increment of the load factor.
    tolerance : float or None
        With ``step: auto``: error in the positions that the steps may add up to by the end, as a fraction
        of the diagonal of the rest shape's bounding box.
    integrator : str or None
        ``beuler`` (first order, full Newton), ``semi-implicit`` (one linear solve a step), ``midpoint``,
        ``alpha2`` (generalised-α), ``bdf2`` (second order); none in a static analysis. By default ``beuler``.
    spectral_radius : float or None
        Spectral radius of ``alpha2`` at high frequencies: 0 damps them in a step, 1 keeps them.
    """

    rules = (
        when(
            given(analysis={"const": "static"}),
            {
                **absent("integrator", "tolerance", "spectral_radius"),
                "allOf": [
                    when(given("end"), given(end={"const": 1})),
                    when(given("step"), given(step={"type": "number", "maximum": 1})),
                ],
            },
            given("end", "step"),
        ),
        when(given("tolerance"), given(step={"const": "auto"}, tolerance={"exclusiveMaximum": 1})),
        when(given("spectral_radius"), given(integrator={"const": "alpha2"})),
    )
    sometimes_filled = frozenset({"end", "step"})

    analysis: Literal["dynamic", "static"] = "dynamic"
    end: Positive
    step: StepLength
    tolerance: Positive | None = None
    integrator: Literal["beuler", "semi-implicit", "midpoint", "alpha2", "bdf2"] | None = None
    spectral_radius: Fraction | None = None

    @property
    def scheme(self) -> str:
        """Name of the time scheme: the integrator, or ``static``."""
        return self.integrator or "static"

    @property
    def adaptive(self) -> bool:
        """Whether the step length follows a tolerance."""
        return self.step == "auto"

    @classmethod
    def complete(cls, data: dict[str, Any]) -> dict[str, Any]:
        """Defaults that depend on the analysis and on the integrator."""
        if data.get("analysis") == "static":
            return {"end": 1.0, "step": LOAD_STEP, **data}
        data = {"integrator": "beuler", **data}
        if data.get("step") == "auto":
            data.setdefault("tolerance", TOLERANCE)
        if data["integrator"] == "alpha2":
            data.setdefault("spectral_radius", SPECTRAL_RADIUS)
        return data

    @field_validator("analysis", mode="before")
    @classmethod
    def _known_analysis(cls, value: Any) -> Any:
        return _word_of(value, ANALYSES)

    @field_validator("integrator", mode="before")
    @classmethod
    def _known_integrator(cls, value: Any) -> Any:
        return value if value is None else _word_of(value, INTEGRATORS)

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if self.analysis == "static":
            for name in self.given("integrator", "tolerance", "spectral_radius"):
                raise problem("has no meaning in a static analysis; leave it out", name)
            if self.end != 1.0:
                raise problem("is 1 in a static analysis (the full load); leave it out", "end")
            if self.step == "auto" or self.step > 1.0:
                raise problem(
                    f"is the first increment of the load factor, at most 1, not {shown(self.step)}", "step"
                )
            return self
        if self.tolerance is not None and not self.adaptive:
            raise problem("is for step: auto; with a fixed step leave it out", "tolerance")
        if self.tolerance is not None and self.tolerance >= 1.0:
            raise problem(f"is a fraction of the sheet's size, below 1, not {self.tolerance:g}", "tolerance")
        if self.spectral_radius is not None and self.integrator != "alpha2":
            raise problem(
                f"is for integrator: alpha2; {self.integrator} has none, leave it out", "spectral_radius"
            )
        return self


class Checkpoint(Block):
    """How often a checkpoint is written at least.

    Attributes
    ----------
    seconds : float [s]
        Wall time.
    steps : int or None
        Accepted steps; without: only by wall time.
    """

    seconds: Positive = 60.0
    steps: Count | None = None


class Output(Block):
    """What is written.

    Attributes
    ----------
    every : float [s] or None
        Simulated time between states; empty: every step.
    fields : list of str
        What a state holds beside the positions.
    checkpoint : Checkpoint
        How often a checkpoint is written at least.
    reactions : bool
        Write the forces at the handles to reactions.csv.
    vtkhdf : bool
        Announce the states also in states.vtkhdf, which newer ParaView reads faster than the XDMF.
    """

    null_is_a_value: ClassVar[frozenset[str]] = frozenset({"every"})

    every: Positive | None = 0.04
    fields: Annotated[list[str], JsonSchema(_FIELDS)] = Field(default_factory=list)
    checkpoint: Checkpoint = Field(default_factory=Checkpoint)
    reactions: Flag = False
    vtkhdf: Flag = False

    @field_validator("fields", mode="before")
    @classmethod
    def _known_fields(cls, value: Any) -> Any:
        if not isinstance(value, (list, tuple)):
            raise problem(f"must be a list, not {shown(value)}; known: {', '.join(FIELDS)}")
        for name in value:
            if name not in FIELDS:
                word = name if isinstance(name, str) else shown(name)
                raise problem(f"unknown field {word!r}, {nearest(word, FIELDS)}")
        return list(dict.fromkeys(value))


class Solver(Block):
    """When a step counts as converged, and how Newton treats its Hessian.

    Attributes
    ----------
    force_tolerance : float
        Force residual over the forces at work.
    step_tolerance : float
        How far a coordinate is expected to move yet, over element size.
    max_iterations : int
        Newton iterations a step may take.
    hessian : str
        ``exact``, ``regularised`` (always positive definite), or ``adaptive``: as exact as it can be.
    """

    force_tolerance: Positive = 1e-6
    step_tolerance: Positive = 1e-6
    max_iterations: Count = 50
    hessian: Literal["adaptive", "regularised", "exact"] = "adaptive"
