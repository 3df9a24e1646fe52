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
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.kernels.scatter import add_elements, add_mixed_elements
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.time_curve import TimeCurve
from lyra_petsc.terms.handles.motion import Window

if TYPE_CHECKING:
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
    in_contact : bool
        Whether contact is part of the equations of the step.
    """

    start: float
    end: float
    target_time: float
    x: Array
    reference: Callable[[float, Ints], Array]
    in_contact: bool = True


class Assembly(NamedTuple):
    """Block rows to which the Hessians of a term's elements are added, and which Hessians.

    Attributes
    ----------
    weight : (E,)
        Factor of each element's Hessian.
    offsets : mapping of str to array
        Those of a `BlockPattern`, by the names of ``couplings``.
    values : (n_blocks, 3, 3)
        The block rows.
    convexity : float
        Weight of the regularised, positive-semidefinite Hessian, beside the exact one.
    predicted : two arrays (n_local, 3), or None
        Positions y and z: an exact Hessian may use the stress of the strain at z linearised at y.
    """

    weight: Array
    offsets: Mapping[str, Offsets]
    values: Array
    convexity: float = 0.0
    predicted: tuple[Array, Array] | None = None


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
        into: Assembly,
        rows: Ints | slice = slice(None),
    ) -> None:
        """Add the Hessians of elements ``rows``; ``fill(lo, hi, out)`` writes those of the lo-th to hi-th."""
        at, weight, stencil = into.offsets[self.name][rows], into.weight[rows], self.stencil[rows]
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
                add_elements(weight[lo:hi], blocks, at[lo:hi], into.values)
            else:
                corners = into.offsets[f"{self.name} vertices"][rows][lo:hi]
                add_mixed_elements(weight[lo:hi], blocks, n, corners, at[lo:hi], into.values)


class Elastic(Term):
    """An energy of the positions; its force is minus the gradient."""

    def connect(self, terms: Iterable[Term]) -> None:
        """Look up the other terms of the scene that this one needs; called before all other methods."""

    @abstractmethod
    def energies(self, x: Array, frozen: Any) -> Array:
        """Energy [J] of each owned element, (n_owned,)."""

    @abstractmethod
    def add_gradient(self, x: Array, frozen: Any, out: Array) -> None:
        """Add the gradient [N] to ``out`` (n_local, 3)."""

    def hessians(self, x: Array, frozen: Any, lo: int, hi: int, convexity: float, out: Array) -> None:
        """Write the Hessians [N/m] of elements lo..hi into ``out``; unused if ``add_hessian`` is overridden.

        ``convexity`` 0 gives the exact Hessian, 1 the regularised, positive-semidefinite one, values between
        them the linear combination. ``out`` has shape (hi − lo, n, n, 3, 3); with edge unknowns
        (hi − lo, 3 n + m, 3 n + m), the coordinates of the vertices before the unknowns of the edges.
        """
        raise NotImplementedError

    def add_hessian(self, x: Array, frozen: Any, into: Assembly) -> None:
        """Add the element Hessians [N/m] to block rows."""
        self._add_hessians(lambda lo, hi, out: self.hessians(x, frozen, lo, hi, into.convexity, out), into)

    @abstractmethod
    def force_scale(self, size: float) -> Array:
        """Force [N] to which the round-off error of each element's force is relative, (E,).

        It is proportional to ``size`` [m], the largest coordinate.
        """

    def history(self, x: Array, frozen: Any) -> Mapping[str, float]:
        """This rank's part of each additional column of history.csv that the registration names."""
        return {}


class Viscous(Term):
    """A potential of the velocities, with the geometry frozen at the start of the step."""

    varies = False
    """Whether it changes in time at fixed positions and velocities."""

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

    varies = False
    """Whether the force changes in time at fixed positions, apart from where it begins and ends."""

    def connect(self, terms: Iterable[Term]) -> None:
        """Look up the other terms of the scene that this one needs; called before all other methods."""

    @abstractmethod
    def add_force(self, step: UpcomingStep, out: Array) -> None:
        """Add the force [N] during a step, that at its ``target_time`` with the shape ``x``, to ``out``."""

    def add_force_on_vertices(self, step: UpcomingStep, out: Array) -> None:
        """As `add_force`, without generalised forces on edges, which do not depend on the positions."""
        self.add_force(step, out)

    def potential(self, x: Array) -> float:
        """Potential energy [J] of this rank's elements; 0 for a load without a potential."""
        return 0.0


class WindowedLoad(Load):
    """Loads of the scene that act in windows of time.

    Parameters
    ----------
    elements : Elements
        With data ``load`` (E,), the number of the scene's load that acts on an element.
    scene : Scene
        In a static analysis plain values of its loads grow with the load factor.
    keys : str
        Those of its loads that act by this term.
    """

    def __init__(self, elements: Elements, scene: Scene, *keys: str) -> None:
        super().__init__(elements)
        acting = {
            number: (Window(load.start, load.until), TimeCurve.of(load.get(key), grows=scene.time.static))
            for number, load in enumerate(scene.loads)
            for key in load.present(*keys)
        }
        self._row = np.searchsorted(list(acting), elements.data["load"])
        self._acting = list(acting.values())
        self.varies = any(curve.varies for _, curve in self._acting)

    def values(self, step: UpcomingStep) -> Array:
        """Value (E,) or (E, 3) of the load on each element in a step, 0 outside of its window."""
        rows = [
            window.strength(step.start, step.end) * curve.at(step.target_time)
            for window, curve in self._acting
        ]
        return np.array(rows)[self._row]
