"""Scene blocks that steer the run: time, output, solver, PETSc options."""

from __future__ import annotations

import re
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, PlainValidator, field_validator

from lyra_petsc.nearest import nearest
from lyra_petsc.scene.block import Block
from lyra_petsc.scene.values import Count, Flag, Positive, number, problem, shown

INTEGRATORS = ("beuler", "semi-implicit")
LATER_INTEGRATORS = ("midpoint", "alpha2", "bdf2")
WHAT_IS_THERE = f"there is: end and step in seconds, integrator {' or '.join(INTEGRATORS)}"
FIELDS = (
    "velocity",
    "green_strain",
    "stress",
    "membrane_energy",
    "bending_energy",
    "curvature",
    "rank",
)


class Time(Block):
    """Time stepping.

    Attributes
    ----------
    end : float [s]
    step : float [s]
        Nominal and largest Δt.
    integrator : str
        ``beuler`` (full Newton) or ``semi-implicit`` (one linear solve a step).
    """

    not_yet: ClassVar[dict[str, str]] = {
        "analysis": f"static analysis is not there yet; {WHAT_IS_THERE}",
        "tolerance": f"adaptive steps are not there yet; {WHAT_IS_THERE}",
    }

    end: Positive
    step: Positive
    integrator: Literal["beuler", "semi-implicit"] = "beuler"

    @classmethod
    def complete(cls, data: dict[str, Any]) -> dict[str, Any]:
        """Refuse ``step: auto`` in words: a number is what it takes."""
        if data.get("step") == "auto":
            raise problem(f"adaptive steps are not there yet; {WHAT_IS_THERE}", "step")
        return data

    @field_validator("integrator", mode="before")
    @classmethod
    def _there(cls, value: Any) -> Any:
        if value in LATER_INTEGRATORS:
            raise problem(f"{value} is not there yet; {WHAT_IS_THERE}")
        if value not in INTEGRATORS:
            raise problem(f"must be one of {', '.join(INTEGRATORS)}, not {shown(value)}")
        return value


class Checkpoint(Block):
    """How often a checkpoint is written at least.

    Attributes
    ----------
    seconds : float [s]
        Wall time.
    """

    seconds: Positive = 60.0


class Output(Block):
    """What is written.

    Attributes
    ----------
    every : float [s] or None
        Simulated time between states; None: every step.
    fields : list of str
        Beside the positions.
    checkpoint : Checkpoint
    reactions : bool
        Forces at the handles.
    """

    null_is_a_value: ClassVar[frozenset[str]] = frozenset({"every"})

    every: Positive | None = 0.04
    fields: list[str] = Field(default_factory=list)
    checkpoint: Checkpoint = Field(default_factory=Checkpoint)
    reactions: Flag = False

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
        Last increment over element size.
    max_iterations : int
        Newton iterations a step may take.
    hessian : str
        ``exact``, ``regularised`` (always positive definite), or ``adaptive``: as exact as it can be.
    """

    force_tolerance: Positive = 1e-6
    step_tolerance: Positive = 1e-6
    max_iterations: Count = 50
    hessian: Literal["adaptive", "regularised", "exact"] = "adaptive"


def _petsc_value(value: Any) -> Any:
    if value is None or isinstance(value, (str, bool)):
        return value
    if isinstance(value, int):
        return value
    if isinstance(value, float):
        return number(value)
    raise problem(f"must be text, a number, true or false, not {shown(value)}")


PetscValue = Annotated[str | int | float | bool | None, PlainValidator(_petsc_value)]


def petsc_options(value: Any) -> Any:
    """Check the option names of a ``petsc`` block."""
    if not isinstance(value, dict):
        raise problem(f"must be a block of options like {{ksp_type: cg}}, not {shown(value)}")
    for key in value:
        if not isinstance(key, str) or not re.fullmatch(r"[A-Za-z_]\w*", key, re.ASCII):
            word = key if isinstance(key, str) else shown(key)
            dash = " without the dash" if word.startswith("-") else ""
            raise problem(f"is not an option name; write it as in ksp_type: cg{dash}", word)
    return value
