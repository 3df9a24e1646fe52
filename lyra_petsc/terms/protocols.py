"""What only some terms have, each a small interface beside `Elastic`; the program looks for it by class.

``tests/terms/test_protocols.py`` checks every registered term that has one.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from lyra_petsc.arrays import Array, Ints, Mask, unwritable
from lyra_petsc.terms.term import Elastic

LARGEST_ROTATION = 1.0
"""Largest angle [rad] by which a Newton iteration may rotate a director relative to its triangles."""


AT_LIMIT = 1e-6
"""Relative distance from its limit, within the accuracy of an equilibrium, at which an element yields."""


KEPT_FRACTION = 0.2
"""Part of the distance to a limit, in contact of at most the gap, that a Newton iteration keeps."""


class Place(Enum):
    """Where numbers of a term's state belong to."""

    VERTEX = "vertices"
    EDGE = "edges"
    ELEMENT = "elements"


class TermState(NamedTuple):
    """Numbers of a term's state.

    Attributes
    ----------
    place : Place
    values : (n, m) or (n,)
        Of the owned vertices (n, 3), of the term's edges (n,) in the order of its unknowns, or of its
        elements (n, m).
    vertices : (n, k) or None
        Global numbers of the elements' vertices, of those that this rank counts; None: the values are those
        of the term's stencil.
    """

    place: Place
    values: Array
    vertices: Ints | None = None


@dataclass(frozen=True, eq=False)
class Located:
    """Frozen data of a term together with what follows from them and positions.

    Attributes
    ----------
    frozen : any
        As ``freeze`` returns them.
    compute : callable
        Returns the geometry at the positions.
    """

    frozen: Any
    compute: Callable[[], Any]

    @cached_property
    def geometry(self) -> Any:
        """The geometry, of read-only arrays, computed when it is first needed."""
        geometry = self.compute()
        unwritable(*((geometry,) if isinstance(geometry, np.ndarray) else geometry))
        return geometry


class HasGeometry(Elastic):
    """An energy of which energies, gradient and Hessian need the same geometry.

    Methods that take positions and ``frozen`` data also take, in place of these, what `at` returns for the
    same positions.
    """

    @abstractmethod
    def compute_geometry(self, x: Array, frozen: Any) -> Any:
        """An array, or several, that follow from positions x (n_local, 3) and the frozen data."""

    def at(self, x: Array, frozen: Any) -> Located:
        """The frozen data with the geometry at positions x (n_local, 3); unchanged if they have it."""
        if isinstance(frozen, Located):
            return frozen
        return Located(frozen, lambda: self.compute_geometry(x, frozen))


class Stateful(Elastic):
    """An energy that depends on the steps before, by a state that checkpoints hold."""

    @abstractmethod
    def initialise(self, x: Array) -> None:
        """Set the state at positions x (n_local, 3), at the start of a run."""

    @abstractmethod
    def accept(self, x: Array, frozen: Any) -> None:
        """Update the state after an accepted step to positions x (n_local, 3)."""

    @abstractmethod
    def state(self) -> Mapping[str, TermState]:
        """The state by name."""

    @abstractmethod
    def restore(self, values: Mapping[str, Array], x: Array) -> None:
        """Restore entries of a `state` at positions x (n_local, 3)."""


class Dissipates(Stateful):
    """An energy of which a part becomes heat when a step is accepted: friction within the fabric."""

    @abstractmethod
    def heat(self, x: Array, frozen: Any) -> float:
        """Energy [J] of the owned elements that becomes heat when the step to x is accepted."""


class Yields(Dissipates):
    """An energy whose elements have another stiffness where they yield further than where they unload."""

    @abstractmethod
    def at_limits(self, *, yields: bool) -> Self:
        """The same term, but all elements at their limits, to `AT_LIMIT`, yield, or else all unload."""


class Event(NamedTuple):
    """What happens to elements of a term at the end of a step.

    Attributes
    ----------
    subject : str
        Notes tell of each subject the first event, and of several in one step that of the largest size.
    size : float
    text : str
    """

    subject: str
    size: float
    text: str


class TellsEvents(Stateful):
    """An energy with events of which the user should know, such as that a spring breaks."""

    @abstractmethod
    def events(self, x: Array, frozen: Any) -> list[Event]:
        """The events among the owned elements when the step to x is accepted, called before `accept`."""


class LimitsStep(Elastic):
    """An energy that is infinite beyond a limit, which no step may pass.

    Its forces change so abruptly near the limit that steps in which it acts take all of Newton's iterations,
    by an integrator whose stage is the end of the step.
    """

    @abstractmethod
    def largest_step(self, x: Array, dx: Array, frozen: Any) -> float:
        """Largest fraction, up to 1, of the increment dx (n_local, 3) [m] of x that Newton's method, or its
        first guess, may apply.
        """

    @abstractmethod
    def overrun(self, x: Array, frozen: Any) -> tuple[float, str]:
        """How far this rank's worst element is beyond the limit at positions x (n_local, 3), and a text that
        says so; 0 and no text within the limit.
        """

    @abstractmethod
    def stiffness(self, x: Array, frozen: Any) -> Array:
        """Force over displacement [N/m] of each element at positions x (n_local, 3), (E,), without bound."""

    def coordinate_scale(self, size: float) -> float | Array:
        """Magnitude [m] of the coordinates whose differences each element's energy depends on, where the
        largest coordinate of the sheet is ``size`` [m].
        """
        return size


class HoldsTogether(Elastic):
    """An energy so stiff that it holds parts together, once they are.

    While they are apart, an integrator that does not damp stiff motions would let them swing against each
    other for ever: that for contact takes the steps. Multigrid moves them together.
    """

    @abstractmethod
    def ties(self) -> tuple[Ints, Array]:
        """Local numbers (n, m) of the vertices in the owned springs that are not soft against the sheet, and
        factors (n, m) with which the sum of their positions is zero if the parts are together.
        """

    @abstractmethod
    def are_apart(self, x: Array, frozen: Any) -> bool:
        """Whether parts of any owned element are apart at positions x (n_local, 3)."""


class FollowsHandles(Elastic):
    """An energy of the distance from targets that move with handles."""

    @property
    @abstractmethod
    def reference_rows(self) -> Ints:
        """Local rows (n,) for which ``freeze`` calls `UpcomingStep.reference`."""


class MovingTargets(Elastic):
    """An energy stored in the sheet on which numbers that change in time do work: positions of targets, or an
    amount of gas.
    """

    @abstractmethod
    def targets(self, x: Array, frozen: Any) -> tuple[Array, Array]:
        """These numbers, such as positions [m] of the targets of the owned elements, and this rank's part of
        the energy's gradient by them, such as forces [N], of the same shape.
        """


def _alone(sums: Array) -> Array:
    """The sums of the only rank."""
    return sums


class SumsOverRanks(Elastic):
    """An energy with results that are sums over the elements of all ranks."""

    over_ranks: Callable[[Array], Array] = staticmethod(_alone)
    """Returns sums over ranks of an array's numbers; collective."""

    def set_communication(self, over_ranks: Callable[[Array], Array]) -> None:
        """Set `over_ranks`, before other methods are called; collective."""
        self.over_ranks = over_ranks


class GlobalSums(SumsOverRanks):
    """An energy that depends on sums over the elements of all ranks, such as an enclosed volume.

    Its Hessian is the sum of block rows and of w g gᵀ for each sum, with its gradient g, which is applied to
    vectors and never assembled. Without the sums at positions x, in ``frozen`` data that `at` returns,
    methods compute them, and are collective.
    """

    @abstractmethod
    def at(self, x: Array, frozen: Any) -> Any:
        """The frozen data with the sums at positions x (n_local, 3); unchanged if they have them."""

    @abstractmethod
    def dense_hessian(self, x: Array, frozen: Any) -> tuple[Array, Array]:
        """Weights w (k,), not negative, and vectors g (k, n_local, 3), right in owned rows."""


class WritesTable(SumsOverRanks):
    """A term with a table of its own in the folder of a run, whose first columns are step and time."""

    table: ClassVar[str]
    """Name of the file."""

    table_columns: ClassVar[tuple[str, ...]]
    """Columns after the first two; the first of these is a name."""

    table_units: ClassVar[tuple[str, ...]]
    """Their units, as ``check`` prints them with the values at the start; none for numbers without."""

    @abstractmethod
    def table_rows(self, x: Array, frozen: Any) -> list[tuple[float | str, ...]]:
        """Rows at positions x (n_local, 3), the same on all ranks; collective."""


class PullsHandles(FollowsHandles):
    """Springs between handles and the sheet."""

    @abstractmethod
    def handle_forces(self, x: Array, frozen: Any, count: int) -> Array:
        """Force [N] of each of the scene's ``count`` handles on this rank's elements, (count, 3)."""


class SharesFrozen(Elastic):
    """An energy whose ``frozen`` data, with their geometry, are those of another term, its ``partner``."""

    partner: Elastic


class HasDirectors(Stateful):
    """An energy of directors: unit vectors normal to edges, whose angles in frozen frames are unknowns."""

    @property
    @abstractmethod
    def edge_indices(self) -> Ints:
        """Indices (n,) of the unknowns of this term's edges in flattened arrays over local rows."""

    @abstractmethod
    def edge_stiffness(self, weight: Array | None = None) -> Array:
        """Stiffness [N/m] of the edges' unknowns at rest, (n,), of elements times ``weight`` (E,)."""

    @abstractmethod
    def largest_rotation(self, increment: Array) -> float:
        """Largest angle [rad] by which an increment (n_owned, 3) [m] rotates directors of owned edges."""

    @abstractmethod
    def edge_increments(
        self, x: Array, increment: Array, frozen: Any, displacement: Array | None = None
    ) -> tuple[Ints, Array]:
        """Corrected increments (n,) [m] of edge unknowns, and the indices (n,) of the latter.

        They keep directors in line with their triangles where an increment (n_local, 3) [m] from positions x
        rotates edges far, and equal its own to first order. Returned for edges that rotate by more than
        `LARGEST_ROTATION`; for all if the vertices move by ``displacement`` (n_local, 3) [m] instead.
        """

    @abstractmethod
    def updated_frames(self, x: Array, frozen: Any, held: Mask) -> Any:
        """New frozen frames for positions x, where edges have turned far from theirs; None if none has.

        Edges with prescribed unknowns, ``held`` (n_local, 3), keep theirs. Energy and unknowns stay the same.
        """

    @abstractmethod
    def frames_at_end(self, x: Array, frozen: Any) -> Any:
        """Frozen frames for positions x at the end of a step; ``accept`` then takes them unchanged."""
