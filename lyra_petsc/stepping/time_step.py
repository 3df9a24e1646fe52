"""A step of the integrator, and its stage at given velocities, as values."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.points import Layout
from lyra_petsc.stepping.applied_loads import StepLoads
from lyra_petsc.stepping.integrators.integrator import Stage
from lyra_petsc.stepping.prescribed import PrescribedUnknowns
from lyra_petsc.stepping.reference_positions import ReferencePositions
from lyra_petsc.terms.protocols import Located
from lyra_petsc.terms.step_end import StepEnd
from lyra_petsc.terms.term import Term, UpcomingStep

if TYPE_CHECKING:
    from lyra_petsc.stepping.forces import StageForces

_numbers = itertools.count()


@dataclass(frozen=True, eq=False)
class TimeStep:
    """A step as its equations see it: nothing in it changes.

    Attributes
    ----------
    start, end : float
        Times [s].
    stage : Stage
        The integrator's.
    x : (n_local, 3)
        Positions [m] at the start.
    x_h, v_h : (n_local, 3), (n_owned, 3)
        Histories [m] and [m/s] of the stage.
    prescribed : PrescribedUnknowns
    loads : StepLoads
    frozen : mapping of Term
        Data of each term that are constant in the step.
    size : float
        Largest coordinate [m] at its start.
    linear : bool
        Whether F is linear in the velocities, from the positions where the step starts (``semi-implicit``).
    lagged : bool
        Whether loads that depend on velocities are those at the start.
    in_contact : bool
        Whether contact is part of the equations: not where the stage is before the end or one linear solve
        finds it. Nothing may then touch at either end.
    of_edges : bool
        Whether only the edges' unknowns are solved for, at the end of the step.
    number : int
        Another one for each step.
    """

    start: float
    end: float
    stage: Stage
    x: Array
    x_h: Array
    v_h: Array
    prescribed: PrescribedUnknowns
    loads: StepLoads
    frozen: Mapping[Term, Any]
    size: float = 0.0
    linear: bool = False
    lagged: bool = False
    in_contact: bool = True
    of_edges: bool = False
    number: int = field(default_factory=lambda: next(_numbers), init=False)

    def changed(self, **changes: Any) -> TimeStep:
        """Another step with these entries; several times as fast as `dataclasses.replace`."""
        other = object.__new__(TimeStep)
        other.__dict__.update(self.__dict__, **changes, number=next(_numbers))
        return other

    @property
    def dt(self) -> float:
        """Length [s]."""
        return self.end - self.start

    @property
    def at_stage(self) -> float:
        """Time [s] of the stage."""
        return self.start + self.stage.offset

    def upcoming(self, time: float, x: Array, reference: ReferencePositions) -> UpcomingStep:
        """The step as terms receive it to freeze their data at positions x (n_local, 3) and a time [s]."""
        return UpcomingStep(self.start, self.end, time, x, reference.at, self.in_contact)

    def finished(self, layout: Layout, mass: Array, x: Array, v: Array, order: int) -> StepEnd:
        """The end of the step with positions and velocities x, v (n_local, 3), for contact."""
        held = self.prescribed
        return StepEnd(layout, mass, held.free, held.indices, x, v, self.start, self.end, order)

    @property
    def ends_at_stage(self) -> bool:
        """Whether the stage is the end of the step."""
        return self.stage.offset == self.dt


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The stage of a step at given velocities, and what follows from these, computed when it is first needed.

    Attributes
    ----------
    step : TimeStep
    x, v : (n_local, 3)
        Positions [m] and velocities [m/s], ghosts up to date.
    forces : StageForces
        The equations.
    known : (n_owned, 3) or None
        The internal forces, where an earlier evaluation has had them.
    known_geometry : mapping of Term or None
        The `geometry` of an earlier evaluation at the same positions.
    """

    step: TimeStep
    x: Array
    v: Array
    forces: StageForces
    known: Array | None = None
    known_geometry: Mapping[Any, Located] | None = None

    @cached_property
    def geometry(self) -> Mapping[Any, Located]:
        """Frozen data of the terms that have geometry, with it."""
        if self.known_geometry is not None:
            return self.known_geometry
        frozen = self.step.frozen
        return {term: term.at(self.x, frozen[term]) for term in self.forces.active.with_geometry}

    def geometry_with(self, frozen: Mapping[Term, Any]) -> Mapping[Any, Located] | None:
        """The `geometry`, if the directors' frames are the same in these frozen data."""
        own, terms = self.step.frozen, self.forces.active.with_edges
        return self.geometry if all(frozen[term].number == own[term].number for term in terms) else None

    @cached_property
    def frozen(self) -> Mapping[Term, Any]:
        """Data of each term that are constant in the step, with its geometry, active pairs or sums here;
        collective.
        """
        active, frozen = self.forces.active, self.step.frozen
        here = {term: term.at(self.x, frozen[term]) for term in (*active.barriers, *active.summing)}
        return active.refreeze(frozen, {**self.geometry, **here})

    @cached_property
    def internal(self) -> Array:
        """Forces (n_owned, 3) [N] of the sheet."""
        return self.forces.internal(self) if self.known is None else self.known

    @cached_property
    def damping(self) -> Array:
        """Forces (n_owned, 3) [N] of material damping."""
        return self.forces.damping(self)

    @cached_property
    def objective(self) -> tuple[float, float]:
        """Value of the function whose gradient F is, and the scale to which its round-off is relative, both
        [W]; collective.
        """
        return self.forces.objective(self)
