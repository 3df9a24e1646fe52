"""What every term offers: pure functions on arrays. It knows neither PETSc, MPI nor files.

Arrays over the block rows of a rank (owned first, then ghosts) have shape (n_local, 3): vertex positions,
and the unknowns of edges, three to a row (`lyra_petsc.mesh.points.Layout`). Gradients are added to all rows
of a stencil; what lands on ghosts is never read, since each rank has every element that touches a row it
owns.

What stays as it is during a step (targets of handles, frozen normals) a term returns from ``freeze`` and is
given back with every call, so that no result depends on the order of calls.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.scatter import add_elements, add_mixed_elements
from lyra_petsc.mesh.elements import Elements

if TYPE_CHECKING:
    from lyra_petsc.terms.one_sided import Springs
    from lyra_petsc.terms.registry import Registration

Offsets = NDArray[np.int32] | NDArray[np.int64]

CHUNK_VALUES = 32_768
"""Scalars of element Hessians computed before they are added to the matrix: they stay in cache."""

LARGEST_TURN = 1.0
"""Angle [rad] by which a Newton iteration may turn a director against its triangles."""


class Across(NamedTuple):
    """Pairs of rows (E, 2) of which only the coupling of one with the other is stored."""

    stencil: NDArray[np.int32]


class WithEdges(NamedTuple):
    """Elements that couple rows of ``vertices`` (E, n) and ``edges`` (E, m), places of their unknowns.

    What couples the vertices with each other has offsets of its own.
    """

    vertices: NDArray[np.int32]
    edges: NDArray[np.int32]

    @property
    def stencil(self) -> NDArray[np.int32]:
        """Rows (E, n + m)."""
        rows = (self.edges // 3).astype(np.int32)
        return np.ascontiguousarray(np.concatenate([self.vertices, rows], axis=1))


Coupling = NDArray[np.int32] | Across | WithEdges
Couplings = Mapping[str, Coupling]
"""Rows (E, n) that the element Hessians couple, by the names of their offsets in a pattern."""


@dataclass(frozen=True)
class UpcomingStep:
    """What a term may know of a step before it is computed.

    Attributes
    ----------
    start, end : float
        [s]
    at : float
        Time [s] at which moving targets shall stand: that of the integrator's stage.
    x : (n_local, 3)
        Positions [m] whose geometry stays as it is during the step.
    reference : callable
        Of a start time [s] and local rows (n,), their positions (n, 3) [m] at that time: where handles that
        begin then start from.
    """

    start: float
    end: float
    at: float
    x: Array
    reference: Callable[[float, Ints], Array]


class Part(NamedTuple):
    """A part of a step, as fractions of the time up to its stage, and from 1 to 2 of that to its end; both 1:
    obstacles stand at the stage.
    """

    begin: float
    end: float


class Pair(NamedTuple):
    """Two parts that an element keeps apart.

    Attributes
    ----------
    parts : tuple of tuples of int
        Local rows of the vertices of each part of a sheet.
    obstacle : str
        The other part, where ``parts`` has one alone: the name of an obstacle.
    kept : float
        Distance [m] that counts as none.
    """

    parts: tuple[tuple[int, ...], ...]
    obstacle: str
    kept: float


class Term(ABC):
    """A sum over elements; what it is to the rest of the program stands in its registration.

    Attributes
    ----------
    stencil : (E, n) int32
        Vertices of each element, local rows.
    edges : (E, m) int32 or None
        Places of the edge unknowns of each element in the flat form of arrays over local rows.
    n_elements, n_owned : int
        E, and how many of them this rank counts (energies); those come first.
    """

    registration: Registration

    def __init__(self, elements: Elements) -> None:
        self.take(elements)

    def take(self, elements: Elements) -> None:
        """Work on these elements from here on."""
        self.elements = elements.once("damping")
        self.stencil = np.ascontiguousarray(elements.stencil, dtype=np.int32)
        self.edges = None if elements.edges is None else np.ascontiguousarray(elements.edges, dtype=np.int32)
        self.n_elements = len(self.stencil)
        self.n_owned = elements.n_owned

    @property
    def name(self) -> str:
        """As in the registry."""
        return self.registration.name

    @property
    def couplings(self) -> Couplings:
        """What the Hessians couple."""
        if self.edges is None:
            return {self.name: self.stencil}
        return {f"{self.name} vertices": self.stencil, self.name: WithEdges(self.stencil, self.edges)}

    @property
    def reference_rows(self) -> Ints:
        """Local rows (n,) whose positions at the start of handles ``freeze`` asks for."""
        return np.empty(0, dtype=np.int64)

    def freeze(self, step: UpcomingStep) -> Any:
        """What stays as it is during the step; every call in the step gets it as ``frozen``."""
        return None

    def _scatter(
        self,
        fill: Callable[[int, int, Array], None],
        weight: Array,
        offsets: Mapping[str, Offsets],
        values: Array,
        rows: Ints | slice = slice(None),
    ) -> None:
        """Add weight × Hessians of elements ``rows``, each with its own, to block rows; ``fill`` computes the
        lo-th to hi-th.
        """
        at, stencil = offsets[self.name][rows], self.stencil[rows]
        n = stencil.shape[1]
        m = 0 if self.edges is None else self.edges.shape[1]
        shape = (n, n, 3, 3) if self.edges is None else (3 * n + m, 3 * n + m)
        chunk = max(1, CHUNK_VALUES // int(np.prod(shape)))
        buffer = np.empty((min(chunk, len(stencil)), *shape))
        for lo in range(0, len(stencil), chunk):
            hi = min(lo + chunk, len(stencil))
            blocks = buffer[: hi - lo]
            fill(lo, hi, blocks)
            if self.edges is None:
                add_elements(weight[lo:hi], blocks, at[lo:hi], values)
            else:
                corners = offsets[f"{self.name} vertices"][rows][lo:hi]
                add_mixed_elements(weight[lo:hi], blocks, n, corners, at[lo:hi], values)


class Dashpots(NamedTuple):
    """Pairs between whose nearest points distances are damped.

    Attributes
    ----------
    points, beta, normal : (m, 4), (m, 4), (m, 3)
        As `Elastic.touching_points` has them.
    stiffness : (m,)
        Second derivative b″ of the energy by the distance [N/m].
    vertex, obstacle : (m,)
        Vertex of a sheet that meets something, −1 of others; what it meets, −1 between sheets.
    pushed : (m,)
        By how much the obstacle's motion in the step brought it nearer [m].
    """

    points: Ints
    beta: Array
    normal: Array
    stiffness: Array
    vertex: Ints
    obstacle: Ints
    pushed: Array


class Rubbing(NamedTuple):
    """Pairs that slide, and what friction lacks; and those that stick where less holds what slides.

    Attributes
    ----------
    points, beta : (m, 4)
        As `Elastic.touching_points` has them.
    along : (m, 3)
        Unit vectors of the ways that they slid, or go on.
    ways : (m, 4, 3)
        Gradients of the lengths of these by the positions of the points.
    more : (m,)
        By how much friction [N] was too small in one step, or may be larger; below 0, too large.
    obstacle : (m,)
        What is touched, −1 between sheets.
    moved : (m, 3)
        How far the obstacle moved in the step, times Σ β_i of the sheet's points [m].
    """

    points: Ints
    beta: Array
    along: Array
    ways: Array
    more: Array
    obstacle: Ints
    moved: Array


class Elastic(Term):
    """An energy of the positions; its force is minus the gradient."""

    search_distance: float = 0.0
    """Distance [m] within which ``neighbours`` looks for elements; 0 where nothing is looked for."""

    stale: bool = False
    """Whether ``neighbours`` or ``known`` has others to name, though no point has moved far."""

    unseen: float = np.inf
    """Distance [m] by which points that ``neighbours`` did not name may come nearer to each other at most."""

    surface: NDArray[np.int32] | None = None
    """Triangles (F, 3), in local rows, among which ``neighbours`` looks; None where points do."""

    pushes: bool = False
    """Whether what moves works by its forces (`work`), as its motion alone may make the energy infinite."""

    surface_marks: Ints | None = None
    """Numbers (F, m) that go with each of them, if any: the last columns of what ``neighbours`` gets."""

    skin: float = 0.0
    """Part of it [m] by which points may come nearer to each other until ``neighbours`` is asked again."""

    @property
    def moving(self) -> bool:
        """Whether its energy depends on where something stands that moves, and does work on the sheet."""
        return self.registration.moving

    def connect(self, terms: Iterable[Term]) -> None:
        """Know the scene's terms, which it may act through; before anything else is asked."""

    @abstractmethod
    def energies(self, x: Array, frozen: Any) -> Array:
        """Energy [J] of each owned element, (n_owned,)."""

    @abstractmethod
    def add_gradient(self, x: Array, frozen: Any, out: Array) -> None:
        """Add the gradient [N] to ``out`` (n_local, 3)."""

    def hessians(self, x: Array, frozen: Any, lo: int, hi: int, blend: float, out: Array) -> None:
        """Hessians [N/m] of elements lo..hi into ``out``; what a term has that does not add them itself.

        ``blend`` 0 gives the exact one, 1 the regularised, positive-semidefinite one, and what lies between
        their mixture. ``out`` is (hi − lo, n, n, 3, 3), where elements couple edges (hi − lo, 3 n + m, 3 n +
        m): the coordinates of the vertices, then the unknowns of the edges.
        """
        raise NotImplementedError

    def add_hessian(
        self,
        x: Array,
        frozen: Any,
        blend: float,
        weight: Array,
        offsets: Mapping[str, Offsets],
        values: Array,
        predicted: tuple[Array, Array] | None = None,
    ) -> None:
        """Add weight (E,) × element Hessians [N/m] to block rows (n_blocks, 3, 3).

        ``offsets`` are a pattern's, by the names of ``couplings``. ``predicted`` are
        positions y and z (n_local, 3): an exact Hessian may take the stress of the strain at z, linearised at
        y.
        """
        self._scatter(
            lambda lo, hi, out: self.hessians(x, frozen, lo, hi, blend, out), weight, offsets, values
        )

    @abstractmethod
    def force_scale(self, size: float) -> Array:
        """Force [N] whose relative round-off each element's force carries, (E,).

        ``size`` [m] is the largest coordinate, to which it is proportional.
        """

    def stiffness(self, x: Array, frozen: Any) -> Array:
        """Force over displacement [N/m] of each element at positions x (n_local, 3), (E,)."""
        return self.force_scale(1.0)

    def sizes(self, size: float) -> float | Array:
        """Coordinates [m] that each element's energy is of differences of, where the sheet's are ``size``."""
        return size

    slips: bool = False
    """Whether its force turns within so short a way that one linear solve does not follow it."""

    partner: Elastic | None = None
    """The term whose ``frozen`` it is given, too, since it looks at the sheet through it."""

    # -- terms whose stencils change ---------------------------------------------------------------

    def neighbours(self, x: Array, way: Array, numbers: Ints, triangles: Ints) -> tuple[Ints, Ints] | None:
        """Elements (E, n) among points x (N, 3) [m] that are nearer to each other than ``search_distance``.

        And whole numbers (E, m) that go with each; ``take`` gets them as data ``what``. ``numbers`` (N,) are
        the points' global numbers, ``triangles`` (F, 3 + m) near ones of ``surface`` with its marks. Where
        ``unseen`` is given, also those that come so near on their straight ways (N, 3) [m]; None where these
        are so long that there are too many: it is asked again with shorter ones. Ranks that see the same
        points must name them in the same order within an element; the owner of the first counts it.
        """
        raise NotImplementedError

    def known(self) -> tuple[Ints, Ints | Array]:
        """The same by global numbers, of a term without a ``search_distance``, whenever it is ``stale``: of
        those whose first vertex this rank owns.
        """
        raise NotImplementedError

    def acting(self, x: Array, frozen: Any) -> NDArray[np.bool_]:
        """Which elements (E,) have a Hessian that is not 0 at positions x (n_local, 3)."""
        return np.ones(self.n_elements, dtype=np.bool_)

    def largest_step(self, x: Array, way: Array, frozen: Any) -> float:
        """Largest fraction, up to 1, of the way (n_local, 3) [m] from x that one Newton iteration may go."""
        return 1.0

    def springs(self, x: Array, way: Array, frozen: Any) -> Springs | None:
        """What touches, or may after a way (n_local, 3) [m] from x; it is `acting` until `release`. None of a
        term whose elements are only known where they act.
        """
        return None

    def release(self, length: Array | None) -> None:
        """Take what springs push by where they are of this length (m,) [m] as foreseen, for `aims`; None:
        they are not.
        """

    def aims(self, x: Array, way: Array, frozen: Any) -> Any:
        """What `push_apart` is to reach after a Newton iteration's way (n_local, 3) [m] from x."""
        return None

    def push_apart(self, x: Array, way: Array, frozen: Any, aims: Any, out: Array, count: Array) -> bool:
        """Whether points are nearer after the way (n_local, 3) [m] from x than they should be.

        Adds where they should go instead to ``out`` (n_local, 3) [m], of each element with a weight that is
        added to ``count`` (n_local, 1).
        """
        return False

    def lets_pass(self, x: Array, way: Array, frozen: Any, part: Part) -> bool:
        """Whether points may go the way (n_local, 3) [m] from x while obstacles go theirs in a part of the
        step.
        """
        return True

    def gaps(self, x: Array, frozen: Any) -> Array:
        """Distance less what is to be kept [m] of the parts of each owned element, (n_owned,).

        Empty where elements keep nothing apart.
        """
        return np.empty(0)

    def free_parts(self, x: Array, way: Array, frozen: Any, part: Part) -> Array:
        """Fraction, up to 1, of the way (n_local, 3) [m] from x that each owned element lets go, (n_owned,),
        while obstacles go theirs in a part of the step. Empty as for `gaps`.
        """
        return np.empty(0)

    def collides(self, x: Array, way: Array, frozen: Any, far: float) -> bool:
        """Whether any elements of this rank may meet in a step in which points go the way (n_local, 3) [m]
        from x, and obstacles theirs, coming nearer to each other by more than ``far`` [m].
        """
        return False

    def pair(self, element: int) -> Pair:
        """What an element keeps apart."""
        raise NotImplementedError

    def obstacle_forces(self, x: Array, frozen: Any, count: int) -> Array | None:
        """Force [N] on each of a scene's obstacles and its torque [N m] about the origin by this rank's
        elements, (count, 6); None of a term that knows none.
        """
        return None

    def targets(self, x: Array, frozen: Any) -> tuple[Array, Array]:
        """Of a term that moves and does not push, for this rank's elements: where its targets stand [m], and
        the energy's gradient by them [N], (n, 3) each.
        """
        raise NotImplementedError

    def work(self, x: Array, at: float, start: float, end: float) -> float:
        """Work [J] that what moves does on this rank's elements on its way from one time [s] to another.

        By the forces at positions x (n_local, 3) where it stands at time ``at``; of a term that ``pushes``.
        """
        raise NotImplementedError

    def touching_points(self, x: Array, frozen: Any) -> tuple[Ints, Array, Array, Array, Ints]:
        """What touches at positions x (n_local, 3), of the pairs that this rank counts: points (m, 4), below
        0 those of obstacles, their barycentric coordinates β (m, 4), unit normals (m, 3) towards the first,
        normal forces (m,) [N], and the vertex (m,) of a sheet that meets something, −1 of others.
        """
        nothing = np.empty((0, 4), dtype=np.int64), np.empty((0, 4)), np.empty((0, 3))
        return *nothing, np.empty(0), np.empty(0, dtype=np.int64)

    def dashpots(self, x: Array, frozen: Any) -> Dashpots:
        """Pairs whose repulsion stiffens at the end of the step, those that other ranks count, too."""
        points, beta, normal, force, vertex = Elastic.touching_points(self, x, frozen)
        return Dashpots(points, beta, normal, force, vertex, vertex, force)

    def carried(self, x: Array, way: Array, frozen: Any) -> Array:
        """Ways (n_local, 3) [m] from x on which what moves takes along what is in its way; else ``way``."""
        return way

    def begin(self, x: Array) -> None:
        """The run begins at positions x (n_local, 3); for terms that have a state."""

    # -- state and history -------------------------------------------------------------------------

    def accept(self, x: Array, frozen: Any) -> None:
        """The step to positions x (n_local, 3) is accepted; for terms that have a state."""

    def work_of_targets(self, ends: tuple[Array, Array], frozen: tuple[Any, Any]) -> float:
        """Work [J] of its targets' motion in a step between these positions (n_local, 3), by the mean over
        both ends; ``frozen`` with targets at its start and at its end.
        """
        first, last = frozen
        return 0.5 * sum(float((self.energies(x, last) - self.energies(x, first)).sum()) for x in ends)

    def on_the_way(self, x: Array, frozen: Any) -> None:
        """A part of a static load step led to positions x; for terms that take up there what touches."""

    def lagging(self, x: Array, frozen: Any) -> Mapping[str, Array]:
        """Sums [N] of friction at positions x (n_local, 3), of this rank's vertices, on each obstacle and of
        sheets (no name), (3,): by how much it is more than the normal forces there allow, or less where parts
        slide; friction; and what these allow.
        """
        return {}

    def touched(self) -> Any:
        """What it knows of what touches, which `touch_again` goes back to."""
        return None

    def touch_again(self, touched: Any) -> None:
        """Go back to it."""

    def heat(self, x: Array, frozen: Any) -> float:
        """What of the energy [J] of its owned elements is none when the step to x is accepted, but heat."""
        return 0.0

    def element_values(self) -> Array:
        """What a checkpoint must hold of elements that do not change, (E, m)."""
        raise NotImplementedError

    def restore_values(self, values: Array) -> None:
        """Go on with these (E, m)."""
        raise NotImplementedError

    def state(self) -> dict[str, Array]:
        """What a checkpoint must hold, by the registration's names: (n_vertices, 3) of owned vertices."""
        return {}

    def restore(self, state: Mapping[str, Array]) -> None:
        """Go on with a state."""

    @property
    def edge_places(self) -> Ints:
        """Places (n,) of the edges that ``edge_state`` is of, in the flat form of arrays over local rows."""
        return np.empty(0, dtype=np.int64)

    def edge_state(self) -> dict[str, Array]:
        """What a checkpoint must hold, by the registration's names: a number for each edge, (n,)."""
        return {}

    def restore_edges(self, state: Mapping[str, Array], x: Array) -> None:
        """Go on with a state of edges at positions x (n_local, 3)."""

    def take_pairs(self, x: Array, frozen: Any) -> None:
        """Take the elements that act at positions x (n_local, 3), where a run begins or goes on."""

    @property
    def n_rubbing(self) -> int:
        """How many pairs touch that may stick or slide in the next step, of a term that `slips`."""
        return 0

    def rubbing(
        self, stage: Array, x: Array, v: Array, frozen: Any, damping: Array, dt: float, *, sheets: bool
    ) -> Rubbing:
        """What slides in a step of length dt [s] over a stage at positions ``stage`` to x, with velocities v
        (n_local, 3), in which dashpots pushed vertices by ``damping`` (n_owned,) [N], too; of a term that
        `slips`.

        On obstacles, and with ``sheets`` on sheets.
        """
        raise NotImplementedError

    def moments(self, x: Array, frozen: Any) -> tuple[Ints, Array]:
        """Vertices (m, 4) of the counted pairs between sheets, and the moments (m, 3) [N m] that their forces
        have at positions x (n_local, 3); of a term that `slips`.
        """
        raise NotImplementedError

    def element_state(self) -> tuple[Ints, Array]:
        """What a checkpoint must hold of changing elements: vertices (E, n) of those that this rank counts,
        by their global numbers, and (E, m) numbers.
        """
        raise NotImplementedError

    def restore_elements(self, vertices: Ints, values: Array, own: range) -> None:
        """Go on with what `element_state` gave, of elements that touch owned vertices ``own``."""

    def largest_turn(self, way: Array) -> float:
        """Largest angle [rad] by which directors of owned edges turn on a way (n_owned, 3)."""
        return 0.0

    def forget(self) -> None:
        """Keep nothing that can be computed again from positions."""

    @property
    def edge_stiffness(self) -> Array:
        """Of their unknowns at rest, (n,) [N/m]."""
        return np.empty(0)

    def nearer(self, x: Array, frozen: Any, held: NDArray[np.bool_]) -> Any:
        """What ``frozen`` is to be from positions x on, where edges not ``held`` (n_local, 3) turned far from
        it; or None. Energy and unknowns stay as they are.
        """
        return None

    def frames_at_end(self, x: Array, frozen: Any) -> Any:
        """What ``frozen`` is to be from the end x of a step on, which ``accept`` then leaves as it is."""
        return frozen

    def followed(self, x: Array, way: Array, frozen: Any, along: Array | None = None) -> tuple[Ints, Array]:
        """Places of edges whose unknowns go far on the way (n_local, 3) [m] from x, and better ways, (n,).

        The same to first order. Of all edges, where vertices go ``along`` (n_local, 3) [m] instead.
        """
        return np.empty(0, dtype=np.int64), np.empty(0)

    def history(self, x: Array, frozen: Any) -> Mapping[str, float]:
        """This rank's part of each further column of history.csv that the registration names."""
        return {}


class Pulling(Elastic):
    """An elastic term by which handles pull."""

    @abstractmethod
    def handle_forces(self, x: Array, frozen: Any, count: int) -> Array:
        """Force [N] of each of a scene's handles on this rank's elements, (count, 3)."""


class Viscous(Term):
    """A potential of the velocities, with the geometry frozen at the start of the step."""

    @abstractmethod
    def potentials(self, v: Array, frozen: Any) -> Array:
        """Potential [W] of each owned element, (n_owned,); its gradient is minus the force."""

    @abstractmethod
    def add_gradient(self, v: Array, frozen: Any, out: Array) -> None:
        """Add the gradient with respect to velocity [N] to ``out``."""

    @abstractmethod
    def add_hessian(self, v: Array, frozen: Any, offsets: Mapping[str, Offsets], values: Array) -> None:
        """Add Hessians [N s/m] with respect to velocity to block rows (n_blocks, 3, 3)."""


class Load(Term):
    """A force that does not change within a step."""

    follows: ClassVar[bool] = False
    """Whether it depends on the positions at the start of the step."""

    def connect(self, terms: Iterable[Term]) -> None:
        """Know the scene's terms, which it may act through; before anything else is asked."""

    @abstractmethod
    def add_force(self, x: Array, t0: float, t1: float, out: Array) -> None:
        """Add the force [N] of the step from t0 to t1 [s] that starts at positions x to ``out``."""

    def potential(self, x: Array) -> float:
        """Potential energy [J] of this rank's elements where the load has one, else 0."""
        return 0.0
