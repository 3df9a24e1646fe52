"""Handles as exact constraints: the coordinates that they prescribe in a step, and their values."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import combinations, pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.capacity import available_memory
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.mesh.select import select_vertices
from lyra_petsc.scene.schema import Handle, Scene
from lyra_petsc.terms.handles.motion import Motion, Window, motion_of

if TYPE_CHECKING:
    from lyra_petsc.mesh.frame_motion import HandleFrames
    from lyra_petsc.terms.bending.midedge_clamp import ClampedEdges

Selection = dict[int, NDArray[np.int64]]
Reference = Callable[[float, NDArray[np.int64]], Array]
"""Takes a start time [s] and local rows (n,); returns their positions (n, 3) [m] at that time."""

SAME_PLACE = 1e-9
"""Distance over the sheet's size up to which two target positions of a vertex count as equal."""

BYTES_PER_HELD_VERTEX = 100
"""Memory [B] per vertex of a handle, during distribution and afterwards."""


def is_exact(handle: Handle) -> bool:
    """Whether a handle is an exact constraint; otherwise it is a spring, see ``terms.spring``."""
    return handle.stiffness is None


def select_exact(scene: Scene, mesh: Mesh) -> Selection:
    """Vertices of each exact handle of a scene, by its number, on the whole mesh (rank 0).

    Raises
    ------
    InputError
        If the handles hold more vertices than fit into memory.
    """
    selection: Selection = {}
    memory, held = available_memory(), 0
    for number, handle in enumerate(scene.handles):
        if not is_exact(handle):
            continue
        key = f"handles[{number}]"
        selection[number] = select_vertices(mesh, handle, key=key, file=scene.source)
        held += len(selection[number])
        if held * BYTES_PER_HELD_VERTEX > memory:
            raise InputError(
                f"the handles up to this one hold {held} vertices in all, more than fit into "
                f"{memory / 2**30:.3g} GiB of memory; let fewer handles hold the same vertices",
                file=scene.source,
                key=key,
            )
    return selection


def conflicts(scene: Scene, mesh: Mesh, held: Selection) -> list[str]:
    """A note for each pair of exact handles that prescribe different positions of the same vertices."""
    notes = []
    windows = {number: Window.of(scene.handles[number]) for number in held}
    slack = SAME_PLACE * float(np.ptp(mesh.positions, axis=0).max())
    by_keyframes = [number for number in held if scene.handles[number].frames is None]
    for first, second in combinations(by_keyframes, 2):
        start = max(windows[first].start, windows[second].start)
        end = min(windows[first].until, windows[second].until, scene.time.end)
        shared = sorted(set(scene.handles[first].axis_numbers) & set(scene.handles[second].axis_numbers))
        if not (shared and start < end):
            continue
        vertices = np.intersect1d(held[first], held[second])
        if not len(vertices):
            continue
        motions = [motion_of(scene, number) for number in (first, second)]
        knots = sorted({start, end, *(t for m in motions for t in m.times if start < t < end)})
        points = mesh.positions[vertices]
        for time in sorted({*knots, *(0.7 * a + 0.3 * b for a, b in pairwise(knots))}):
            one, other = (motion.moved(points, start, time)[:, shared] for motion in motions)
            differ = np.abs(other - one).max(axis=1) > slack
            if differ.any():
                notes.append(
                    f"handles[{first}] and handles[{second}] hold {int(differ.sum())} vertices (first: "
                    f"{vertices[differ][0]}) in different places, as at t = {time:g} s; handles[{second}], "
                    "the later in the scene, is followed"
                )
                break
    return notes


def has_edge_in(mesh: Mesh, vertices: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether both ends of an edge of each triangle, (n_triangles,), are among ``vertices``."""
    two: NDArray[np.bool_] = np.isin(mesh.triangles, vertices).sum(axis=1) > 1
    return two


def clamps_without_edges(scene: Scene, mesh: Mesh, held: Selection) -> list[str]:
    """A note for each exact handle with ``clamp`` that does not hold both ends of any edge."""
    return [
        f"handles[{number}]: clamp keeps the slope of edges whose two ends are held, and there are none"
        for number, vertices in held.items()
        if scene.handles[number].clamp and not has_edge_in(mesh, vertices).any()
    ]


class ExactHandles:
    """The exact handles of a scene on one rank.

    Where two handles prescribe the same coordinate at the same time, the later one in the scene counts.

    Parameters
    ----------
    scene : Scene
    owned : mapping of handle number → (n,) int
        Owned vertices of each exact handle, local numbering.
    edges : ClampedEdges or None
        Edges whose unknowns are also prescribed.
    frames : mapping of handle number → HandleFrames
        Motions of handles by frames from files.

    Attributes
    ----------
    edges : ClampedEdges or None
    """

    def __init__(
        self,
        scene: Scene,
        owned: Selection,
        edges: ClampedEdges | None = None,
        frames: Mapping[int, HandleFrames] | None = None,
    ) -> None:
        self._vertices, self.edges = owned, edges
        self._axes = {
            number: np.array(scene.handles[number].axis_numbers, dtype=np.int64) for number in owned
        }
        self._indices = {number: np.ix_(vertices, self._axes[number]) for number, vertices in owned.items()}
        self._motions: dict[int, Motion | HandleFrames] = {n: motion_of(scene, n) for n in owned}
        self._motions |= frames or {}
        self._windows = {number: Window.of(scene.handles[number]) for number in owned}
        self._windows |= edges.windows if edges is not None else {}

    def __bool__(self) -> bool:
        return bool(self._windows)

    def active(self, t0: float, t1: float) -> tuple[int, ...]:
        """Numbers of the handles that act throughout the step from t0 to t1 [s]."""
        return tuple(number for number, window in self._windows.items() if window.holds(t0, t1))

    def mask(self, t0: float, t1: float, n_owned: int) -> NDArray[np.bool_]:
        """Prescribed unknowns (n_owned, 3) of the step from t0 to t1 [s]."""
        mask = np.zeros((n_owned, 3), dtype=bool)
        for number in self.active(t0, t1):
            if number in self._indices:
                mask[self._indices[number]] = True
            if self.edges is not None:
                mask.ravel()[self.edges.indices(number)] = True
        return mask

    def shares(self, t0: float, t1: float, reaction: Array) -> Iterator[tuple[int, Array, Array]]:
        """Share of each active handle in the reaction (n_owned, 3) [N] on prescribed unknowns.

        Yields the handle's number, the forces on its vertices (n, 3) and on the edge unknowns that it
        prescribes (m,). Of two handles that prescribe the same unknown the later one gets the whole force.
        """
        remaining = reaction.copy()
        for number in reversed(self.active(t0, t1)):
            forces = np.zeros((len(self.vertices(number)), 3))
            if number in self._indices:
                forces[:, self._axes[number]] = remaining[self._indices[number]]
                remaining[self._indices[number]] = 0.0
            edges = self.edges.indices(number) if self.edges is not None else np.empty(0, dtype=np.int64)
            edge_forces = remaining.ravel()[edges]
            remaining.ravel()[edges] = 0.0
            yield number, forces, edge_forces

    def targets(self, t0: float, t1: float, at: float, reference: Reference, out: Array) -> None:
        """Write the unknowns [m] prescribed at time ``at`` of the step t0 to t1 into ``out`` (n_owned, 3).

        ``out`` contains the present ones, which determine the number of full turns of directors.
        """
        for number in self.active(t0, t1):
            if self.edges is not None:
                self.edges.targets(number, at, reference, out.ravel())
            if number not in self._indices:
                continue
            start = self._windows[number].start
            goal = self._motions[number].moved(reference(start, self._vertices[number]), start, at)
            out[self._indices[number]] = goal[:, self._axes[number]]

    def velocities(self, t0: float, t1: float, at: float, reference: Reference, out: Array) -> None:
        """Write the prescribed velocities ẋ*(at) [m/s] of the step t0 to t1 into ``out`` (n_owned, 3)."""
        for number in self.active(t0, t1):
            if self.edges is not None:
                self.edges.rates(number, at, reference, out.ravel())
            if number not in self._indices:
                continue
            start = self._windows[number].start
            rate = self._motions[number].velocity(reference(start, self._vertices[number]), start, at)
            out[self._indices[number]] = rate[:, self._axes[number]]

    @property
    def reference_rows(self) -> NDArray[np.int64]:
        """Local rows (n,) whose reference positions are needed."""
        edges = [self.edges.reference_rows] if self.edges is not None else []
        return np.concatenate([np.empty(0, dtype=np.int64), *self._vertices.values(), *edges])

    @property
    def numbers(self) -> list[int]:
        """Numbers of the exact handles in the scene."""
        return list(self._vertices)

    @property
    def with_slopes(self) -> list[int]:
        """Numbers of the exact handles that also prescribe directors of edges."""
        windows = {} if self.edges is None else self.edges.windows
        return [number for number in self._vertices if number in windows]

    def vertices(self, number: int) -> NDArray[np.int64]:
        """Owned vertices of a handle, local numbering."""
        return self._vertices.get(number, np.empty(0, dtype=np.int64))
