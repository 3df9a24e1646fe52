"""The interface of terms: pure functions on arrays, independent of PETSc, MPI and files.

Arrays over the block rows of a rank (owned first, then ghosts) have shape (n_local, 3): vertex positions,
and the unknowns of edges, three to a row (`lyra_petsc.mesh.points.Layout`). Gradients are added to all rows
of a stencil. Values added to ghost rows are never read, since each rank has every element that touches a row
it owns.

``freeze`` returns the data of a term that are constant during a step (targets of handles, frozen normals).
They are passed to every other method as ``frozen``, so that no result depends on the order of calls.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.scatter import add_elements, add_mixed_elements
from lyra_petsc.mesh.elements import Elements

if TYPE_CHECKING:
    from lyra_petsc.terms.handles.motion import Window
    from lyra_petsc.terms.registry import Registration

Offsets = NDArray[np.int32] | NDArray[np.int64]

CHUNK_VALUES = 32_768
"""Scalars of element Hessians computed before they are added to the matrix, few enough to stay in cache."""


class OffDiagonal(NamedTuple):
    """Pairs of rows (E, 2) for which only the off-diagonal block of the two rows is assembled."""

    stencil: NDArray[np.int32]


class MixedStencil(NamedTuple):
    """Elements that couple ``vertices`` (E, n), local rows, with edge unknowns.

    ``edges`` (E, m) are the unknowns' indices in flattened arrays over local rows. The blocks that couple
    vertices with vertices have offsets of their own.
    """

    vertices: NDArray[np.int32]
    edges: NDArray[np.int32]

    @property
    def stencil(self) -> NDArray[np.int32]:
        """Rows (E, n + m)."""
        rows = (self.edges // 3).astype(np.int32)
        return np.ascontiguousarray(np.concatenate([self.vertices, rows], axis=1))


Coupling = NDArray[np.int32] | OffDiagonal | MixedStencil
Couplings = Mapping[str, Coupling]
"""Rows (E, n) that the element Hessians couple, by the name of their offsets in a `BlockPattern`."""


@dataclass(frozen=True)
class UpcomingStep:
    """Data of a step that are known before it is computed.

    Attributes
    ----------
    start, end : float
        Time [s] of its start and end.
    target_time : float
        Time [s] at which moving targets are evaluated: that of the integrator's stage.
    x : (n_local, 3)
        Positions [m] from which a term computes geometry that is constant during the step.
    reference : callable
        Takes a start time [s] and local rows (n,); returns their positions (n, 3) [m] at that time, from
        which the motion of handles that start then is applied.
    """

    start: float
    end: float
    target_time: float
    x: Array
    reference: Callable[[float, Ints], Array]


class StepInterval(NamedTuple):
    """An interval of a step: 0 is its start, 1 its stage, 2 its end, and time is linear in between.

    With ``begin`` = ``end`` = 1 obstacles stay where they are at the stage.
    """

    begin: float
    end: float


class Pair(NamedTuple):
    """The two simplices (vertex, edge or triangle) that an element keeps apart.

    Attributes
    ----------
    parts : tuple of tuples of int
        Local rows of the vertices of each simplex of a sheet: two, or one in front of an obstacle.
    obstacle : str
        Name of the obstacle, empty between sheets.
    thickness : float
        Distance [m] of the mid-surfaces at which the gap is zero.
    """

    parts: tuple[tuple[int, ...], ...]
    obstacle: str
    thickness: float


class Term(ABC):
    """A sum over elements. Its registration describes its role in the rest of the program.

    Attributes
    ----------
    stencil : (E, n) int32
        Vertices of each element, local rows.
    edges : (E, m) int32 or None
        Indices of the edge unknowns of each element in flattened arrays over local rows.
    n_elements, n_owned : int
        Number E of elements, and the number of those that this rank counts in energies; these come first.
    """

    registration: Registration

    def __init__(self, elements: Elements) -> None:
        self.set_elements(elements)

    def set_elements(self, elements: Elements) -> None:
        """Replace the elements of this rank."""
        self.elements = elements.compress("damping")
        self.stencil = np.ascontiguousarray(elements.stencil, dtype=np.int32)
        self.edges = None if elements.edges is None else np.ascontiguousarray(elements.edges, dtype=np.int32)
        self.n_elements = len(self.stencil)
        self.n_owned = elements.n_owned

    @property
    def name(self) -> str:
        """Name of the term in the registry."""
        return self.registration.name

    @property
    def couplings(self) -> Couplings:
        """Rows and edge unknowns that the element Hessians couple."""
        if self.edges is None:
            return {self.name: self.stencil}
        return {f"{self.name} vertices": self.stencil, self.name: MixedStencil(self.stencil, self.edges)}

    def freeze(self, step: UpcomingStep) -> Any:
        """Data that are constant during the step; passed to all methods in the step as ``frozen``."""
        return None

    def _add_hessians(
        self,
        fill: Callable[[int, int, Array], None],
        weight: Array,
        offsets: Mapping[str, Offsets],
        values: Array,
        rows: Ints | slice = slice(None),
    ) -> None:
        """Add the Hessians of elements ``rows``, times ``weight`` of each, to block rows (n_blocks, 3, 3).

        ``fill(lo, hi, out)`` computes those of the lo-th to hi-th of them.
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


class Contacts(NamedTuple):
    """Pairs in contact at the end of a step that this rank counts.

    Attributes
    ----------
    points, sheet_beta, beta : (m, 4)
        Local rows of the vertices, their coefficients β, 0 for points of obstacles, and those of all points:
        the vector between the nearest points is Σ β_i p_i.
    normal : (m, 3)
        Unit normals towards the first simplex.
    force, stiffness : (m,)
        Normal force [N] and second derivative b″ of the energy with respect to the distance [N/m], > 0.
    obstacle : (m,)
        Number of the obstacle, −1 between sheets.
    velocity : (m, 3)
        Velocity [m/s] of the obstacle at the contact, times Σ β_i; 0 between sheets.
    pair : (m,)
        Numbers of the term's elements.
    """

    points: Ints
    sheet_beta: Array
    beta: Array
    normal: Array
    force: Array
    stiffness: Array
    obstacle: Ints
    velocity: Array
    pair: Ints


class EndFriction(NamedTuple):
    """Friction of the counted pairs in the equations of a step, and its limits at the end of the step.

    Attributes
    ----------
    points, beta : (m, 4)
        As in `Contacts`.
    tangents : (m, 2, 3)
        Unit vectors perpendicular to the normal and to each other.
    gradients : (m, 2, 4, 3)
        Gradients of the relative displacement along ``tangents`` with respect to the points' positions.
    normal_force : (m,)
        Normal force of the step [N], 0 for pairs that are no longer in contact.
    force, applied : (m, 2)
        Friction [N] along ``tangents`` in the equations of the step: that with which a pair of the end
        begins, and that of the pairs of the equations, which follow them and end.
    static, kinetic : (m,)
        Largest friction [N] of sticking pairs, and of sliding ones.
    slides, held : (m,)
        Whether the pair slides in the equations of the step, and whether it sticks in them.
    obstacle, velocity : (m,), (m, 3)
        As in `Contacts`.
    still : float
        Displacement [m] in a step up to which a sticking pair counts as at rest.
    """

    points: Ints
    beta: Array
    tangents: Array
    gradients: Array
    normal_force: Array
    force: Array
    applied: Array
    static: Array
    kinetic: Array
    slides: NDArray[np.bool_]
    held: NDArray[np.bool_]
    obstacle: Ints
    velocity: Array
    still: float


class StartingFriction(NamedTuple):
    """Friction of the counted pairs at the start of a step, in two tangential components.

    Attributes
    ----------
    points : (m, 4)
        Local rows of the vertices.
    gradients : (m, 2, 4, 3)
        Gradients of the relative displacement's components with respect to the points' positions.
    size : (m, 4)
        Largest norms of the gradients over all tangential directions.
    weight, limit : (m,)
        Normal forces, in proportion to which masses are divided, and largest friction [N].
    force : (m, 2)
        Friction of the elastic slip, opposite to it [N].
    moved : (m, 2)
        Relative displacement in the step by the motion of the obstacle alone [m].
    """

    points: Ints
    gradients: Array
    size: Array
    weight: Array
    limit: Array
    force: Array
    moved: Array


class Elastic(Term):
    """An energy of the positions; its force is minus the gradient."""

    search_distance: float = 0.0
    """Distance [m] within which ``neighbours`` searches for elements; 0: the term does not search."""

    stale: bool = False
    """Whether the elements are to be asked for anew, although no point has moved by half the ``skin``."""

    approach_limit: float = np.inf
    """Distance [m] by which two points that ``neighbours`` did not return may approach each other."""

    surface: NDArray[np.int32] | None = None
    """Triangles (F, 3), in local rows, that ``neighbours`` searches; None: it searches points."""

    @property
    def moving(self) -> bool:
        """Whether the energy depends on moving targets or obstacles, which thereby do work on the sheet."""
        return False

    pushes: bool = False
    """Whether the work of moving obstacles is computed from forces (`work`) and not from the energy, which
    their motion alone may make infinite."""

    surface_marks: Ints | None = None
    """Numbers (F, m) of the triangles of ``surface``, if any: further columns of what ``neighbours`` gets."""

    skin: float = 0.0
    """Part [m] of ``search_distance`` by which points may approach each other before the next search."""

    @property
    def detects_collisions(self) -> bool:
        """Whether the term keeps parts from passing through each other, however long a step is."""
        return bool(np.isfinite(self.approach_limit))

    def connect(self, terms: Iterable[Term]) -> None:
        """Look up the other terms of the scene that this one needs; called before all other methods."""

    @abstractmethod
    def energies(self, x: Array, frozen: Any) -> Array:
        """Energy [J] of each owned element, (n_owned,)."""

    @abstractmethod
    def add_gradient(self, x: Array, frozen: Any, out: Array) -> None:
        """Add the gradient [N] to ``out`` (n_local, 3)."""

    def hessians(self, x: Array, frozen: Any, lo: int, hi: int, blend: float, out: Array) -> None:
        """Write the Hessians [N/m] of elements lo..hi into ``out``; unused if ``add_hessian`` is overridden.

        ``blend`` 0 gives the exact Hessian, 1 the regularised, positive-semidefinite one, values between them
        the linear combination. ``out`` has shape (hi − lo, n, n, 3, 3); with edge unknowns
        (hi − lo, 3 n + m, 3 n + m), the coordinates of the vertices before the unknowns of the edges.
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

        ``offsets`` are those of a `BlockPattern`, by the names of ``couplings``. With ``predicted`` positions
        y and z (n_local, 3) an exact Hessian may use the stress of the strain at z linearised at y.
        """
        self._add_hessians(
            lambda lo, hi, out: self.hessians(x, frozen, lo, hi, blend, out), weight, offsets, values
        )

    @abstractmethod
    def force_scale(self, size: float) -> Array:
        """Force [N] to which the round-off error of each element's force is relative, (E,).

        It is proportional to ``size`` [m], the largest coordinate.
        """

    def stiffness(self, x: Array, frozen: Any) -> Array:
        """Force over displacement [N/m] of each element at positions x (n_local, 3), (E,)."""
        return self.force_scale(1.0)

    def coordinate_scale(self, size: float) -> float | Array:
        """Magnitude [m] of the coordinates whose differences each element's energy depends on, where the
        largest coordinate of the sheet is ``size`` [m].
        """
        return size

    slips: bool = False
    """Whether it is friction of contacts, whose force changes too abruptly for one linear solve per step."""

    # -- terms whose stencils change ---------------------------------------------------------------

    def neighbours(self, x: Array, dx: Array, numbers: Ints, triangles: Ints) -> tuple[Ints, Ints] | None:
        """Elements (E, n) among points x (N, 3) [m] that are nearer to each other than ``search_distance``,
        and whole numbers (E, m) of each, which `set_elements` gets as data ``what``.

        ``numbers`` (N,) are the points' global numbers, ``triangles`` (F, 3 + m) near triangles of
        ``surface`` with their marks. A term with an ``approach_limit`` also returns elements whose points
        come so near anywhere along straight displacements dx (N, 3) [m]; None if these are so long that there
        are too many: it is asked again with shorter ones. Ranks that see the same points must return them in
        the same order within an element; the owner of the first counts the element.
        """
        raise NotImplementedError

    def current_elements(self) -> tuple[Ints, Ints | Array]:
        """Elements and their numbers as from `neighbours`, but in global numbers, of a term without a
        ``search_distance``; asked whenever it is ``stale``. Only those whose first vertex this rank owns.
        """
        raise NotImplementedError

    def active_elements(self, x: Array, frozen: Any) -> NDArray[np.bool_]:
        """Which elements (E,) have a non-zero Hessian at positions x (n_local, 3)."""
        return np.ones(self.n_elements, dtype=np.bool_)

    def springs(self, x: Array, approach: float, frozen: Any) -> Any:
        """One-sided springs for the pairs that are in contact at x (n_local, 3), or may be after points have
        approached each other by ``approach`` [m], the same on all ranks. Their elements count as active until
        `release_springs`. None: the term has no such springs.
        """
        return None

    def release_springs(self, length: Array | None) -> None:
        """Drop the springs. Their forces at lengths (m,) [m], where given, are those that `target_distances`
        expects.
        """

    def target_distances(self, x: Array, dx: Array, frozen: Any) -> Any:
        """Distances of pairs that `add_corrections` restores after Newton's increment dx (n_local, 3)."""
        return None

    def add_corrections(
        self, x: Array, dx: Array, frozen: Any, targets: Any, out: Array, weight: Array
    ) -> bool:
        """Whether points are nearer after the increment dx (n_local, 3) [m] of x than their target distances.

        Adds corrections of the increment to ``out`` (n_local, 3) [m], each times a weight, and the weights to
        ``weight`` (n_local, 1).
        """
        return False

    def is_collision_free(self, x: Array, dx: Array, frozen: Any, interval: StepInterval) -> bool:
        """Whether nothing collides on the displacement dx (n_local, 3) [m] from x, while obstacles move as in
        an interval of the step.
        """
        return True

    def gaps(self, x: Array, frozen: Any) -> Array:
        """Distance less thickness [m] between the two simplices of each owned element, (n_owned,).

        Empty for a term that keeps nothing apart.
        """
        return np.empty(0)

    def collision_free_fractions(self, x: Array, dx: Array, frozen: Any, interval: StepInterval) -> Array:
        """Fraction, up to 1, of the displacement dx (n_local, 3) [m] from x on which the pair of each owned
        element does not collide, (n_owned,), while obstacles move as in an interval of the step.

        Empty for a term that keeps nothing apart.
        """
        return np.empty(0)

    def may_collide(self, x: Array, dx: Array, frozen: Any, threshold: float) -> bool:
        """Whether any pair of this rank may come into contact in a step with displacement dx (n_local, 3)
        [m] from x; only pairs that approach by more than ``threshold`` [m] count.
        """
        return False

    def pair(self, element: int) -> Pair:
        """The pair of simplices that an element keeps apart."""
        raise NotImplementedError

    def obstacle_forces(self, x: Array, frozen: Any, count: int) -> Array | None:
        """Force [N] of this rank's elements on each of a scene's obstacles, its torque [N m] about the
        origin, and the sums over contacts of the magnitudes of normal force and friction [N], (count, 8);
        None: the term does not act on obstacles.
        """
        return None

    def work(self, x: Array, at: float, start: float, end: float) -> float:
        """Work [J] of moving obstacles on this rank's elements between the times ``start`` and ``end`` [s].

        The forces are those at positions x (n_local, 3) with obstacles at time ``at``; of a term that
        ``pushes``.
        """
        raise NotImplementedError

    def normal_forces(self, x: Array, frozen: Any) -> Array:
        """Sum of the normal forces [N] at each local vertex, (n_local,), of this rank's counted pairs."""
        return np.zeros(len(x))

    def contacts(self, x: Array, v: Array, frozen: Any, last: tuple[float, float]) -> Contacts | None:
        """The pairs in contact at the end of the step, with positions x and velocities v (n_local, 3).

        The velocities of obstacles are means between the two times ``last`` [s]. None: the term keeps nothing
        apart.
        """
        return None

    def moved_with_obstacles(self, x: Array, dx: Array, frozen: Any) -> Array:
        """Displacements dx (n_local, 3) [m] from x, for vertices in the path of moving obstacles changed to
        those of the obstacles.
        """
        return dx

    def work_of_targets(self, ends: tuple[Array, Array], frozen: tuple[Any, Any]) -> float:
        """Work [J] of the targets' motion in a step: the change of energy at fixed positions, averaged over
        the positions ``ends`` (n_local, 3) at its start and end. ``frozen`` has the targets at both times.
        """
        first, last = frozen
        return 0.5 * sum(float((self.energies(x, last) - self.energies(x, first)).sum()) for x in ends)

    def accept_substep(self, x: Array, frozen: Any) -> None:
        """Accept a part of a static load step that ended at positions x; for terms that update contacts."""

    def friction_lag(self, x: Array, frozen: Any) -> Mapping[str, Array]:
        """How far friction is from the limit of the normal forces at positions x (n_local, 3).

        For each obstacle by its name, and between sheets (empty name), three sums [N] over this rank's
        vertices: error (friction beyond the limit, or below it where pairs slide), friction, limit.
        """
        return {}

    def slip_under_changed_forces(self, x: Array, dx: Array, frozen: Any) -> tuple[float, float]:
        """How far points slip while normal forces change, in a solve by dx (n_local, 3) [m] to x.

        Two sums over this rank's vertices: slip times the change of the normal force since friction was
        computed [J], and the larger of the normal forces before and after [N].
        """
        return 0.0, 0.0

    def contact_state(self) -> Any:
        """The contacts that the term has stored, for `restore_contacts`."""
        return None

    def restore_contacts(self, state: Any) -> None:
        """Go back to what `contact_state` returned."""

    def heat(self, x: Array, frozen: Any) -> float:
        """Energy [J] of the owned elements that becomes heat when the step to x is accepted."""
        return 0.0

    def initialise_pairs(self, x: Array, frozen: Any) -> None:
        """Store the pairs in contact at positions x (n_local, 3), where a run begins or is resumed."""

    @property
    def n_friction_pairs(self) -> int:
        """Number of pairs in contact that may stick or slide in the next step."""
        return 0

    def end_friction(
        self,
        x: Array,
        v: Array,
        frozen: Any,
        contacts: Contacts,
        normal_force: Array,
        last: tuple[float, float],
    ) -> EndFriction:
        """Friction at the end of a step to positions x, with velocities v (n_local, 3), in ``contacts`` whose
        normal forces in the step are ``normal_force`` (m,) [N]; of a term that `slips`.
        """
        raise NotImplementedError

    def set_end_friction(
        self, friction: EndFriction, force: Array, sticks: NDArray[np.bool_], work: Array
    ) -> None:
        """Set friction (m, 2) [N] of the step in the pairs of an `end_friction`, which of them stick, and the
        heat (m,) [J] of sliding; of a term that `slips`.
        """
        raise NotImplementedError

    def begin_step(self) -> None:
        """Prepare for an attempt at a step from the accepted state."""

    def changed_contacts(self, x: Array, start: Array, frozen: Any) -> tuple[float, float]:
        """Change of the normal forces of this rank's pairs since they were last taken, and their sum [N], at
        a Newton iterate x of a step from ``start``, (n_local, 3) each; of a term that `slips`.
        """
        return 0.0, 0.0

    def take_contacts(self) -> None:
        """Take the pairs that `changed_contacts` found for the step's equations."""

    def starting_friction(self, frozen: Any) -> StartingFriction:
        """Friction at the start of the step; of a term that `slips`."""
        raise NotImplementedError

    def set_starting_friction(self, friction: Array) -> None:
        """Set the friction (m, 2) [N] of the pairs of `starting_friction`; of a term that `slips`."""
        raise NotImplementedError

    @property
    def obstacle_places(self) -> Mapping[str, tuple[int, int]]:
        """Number of each obstacle in ``element_state``, and of its first point, by name."""
        return {}

    def restore_elements(
        self, vertices: Ints, values: Array, own: range, places: Mapping[str, tuple[int, int]]
    ) -> None:
        """Restore what ``element_state`` returned, for elements that touch the owned vertices ``own``.

        ``places`` were the ``obstacle_places``.
        """

    def history(self, x: Array, frozen: Any) -> Mapping[str, float]:
        """This rank's part of each additional column of history.csv that the registration names."""
        return {}


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
    """A force that is constant during a step."""

    is_follower: ClassVar[bool] = False
    """Whether the force depends on the positions."""

    def connect(self, terms: Iterable[Term]) -> None:
        """Look up the other terms of the scene that this one needs; called before all other methods."""

    @abstractmethod
    def add_force(self, x: Array, t0: float, t1: float, out: Array) -> None:
        """Add the force [N] during the step from t0 to t1 [s], which starts at positions x, to ``out``."""

    def add_force_on_vertices(self, x: Array, t0: float, t1: float, out: Array) -> None:
        """As `add_force`, without generalised forces on edges, which do not depend on the positions."""
        self.add_force(x, t0, t1, out)

    def potential(self, x: Array) -> float:
        """Potential energy [J] of this rank's elements; 0 for a load without a potential."""
        return 0.0


class WindowedLoad(Load):
    """Loads of the scene that act in windows of time.

    Parameters
    ----------
    elements : Elements
        With data ``load`` (E,), the number of the scene's load that acts on an element.
    windows : sequence of Window
        Windows of all loads of the scene.
    """

    def __init__(self, elements: Elements, windows: Sequence[Window]) -> None:
        super().__init__(elements)
        self._load = elements.data["load"].astype(np.int64)
        self._windows = windows

    def strength(self, t0: float, t1: float) -> Array:
        """Fraction (E,) of the load on each element that acts in the step from t0 to t1 [s]."""
        return np.array([window.strength(t0, t1) for window in self._windows])[self._load]
