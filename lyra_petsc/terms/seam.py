"""Seams: threads between each vertex of one side and its place on an edge of the other side.

    energy = ½ k s (|d| − L(t))²,   d = x_i − (1 − w) x_j − w x_k

with the vertex's arc length s [m] and the seam's stiffness k [N/m²]. The length L goes from the distance at
the start to zero while the seam closes. Threads also push: if they did not, a side would fly on as they slow
down, and be thrown back and forth between slack threads, the faster the shorter they are. Closed seams have
a quadratic energy.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.seams import AT_VERTEX, Ties, sewn_curves
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.seam_block import Seam
from lyra_petsc.terms.protocols import HoldsTogether, MovingTargets, WritesTable
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import UpcomingStep

RIGID = 1000.0
"""Stiffness of rigid seams times the edge length, over the membrane stiffness: the gap over the edge length
is the strain across the seam, in the sheet beside it, over this number."""

SOFT = 0.05
"""Stiffness of seams in the same measure up to which multigrid takes fewer iterations if it does not know
them."""


class ThreadLengths(NamedTuple):
    """Lengths of the threads in one step.

    Attributes
    ----------
    length : (E,)
        [m].
    """

    length: Array


def closed_part(seam: Seam, time: float) -> float:
    """How far a seam is closed at a time [s], from 0 to 1.

    It closes ever faster: if it slowed down, the sides would go on at their speed and pass each other.
    """
    if seam.close is None:
        return 1.0
    s = min(max((time - seam.close.start) / (seam.close.until - seam.close.start), 0.0), 1.0)
    return s * s


class SeamThreads(MovingTargets, HoldsTogether, WritesTable):
    """The threads of all seams.

    Parameters
    ----------
    elements : Elements
        Stencil (E, 3) as of `Ties`; data ``weight`` (E,), ``k`` (E,) [N/m], ``gap`` (E,) distance at the
        start [m], ``seam`` (E,) number of the seam, ``sign`` (E,) −1 where its first side is the tied one,
        ``soft`` (E,) 1 where the seam is soft against the sheet, else 0.
    seams : list of Seam
        Of the scene.
    """

    table = "seams.csv"
    table_columns = ("name", "gap", "fx", "fy", "fz", "opening", "shear")
    table_units = ("", "m", "N", "N", "N", "N", "N")

    def __init__(self, elements: Elements, seams: list[Seam]) -> None:
        super().__init__(elements)
        data = elements.data
        self._k, self._gap, self._seam = data["k"], data["gap"], data["seam"].astype(np.int64)
        self._factors = np.stack(
            [np.ones_like(data["weight"]), data["weight"] - 1.0, -data["weight"]], axis=1
        )
        self._seams, self._rigid = seams, np.array([seam.rigid for seam in seams])[self._seam]

    def freeze(self, step: UpcomingStep) -> ThreadLengths:
        # with lengths that change evenly in a step, threads have theirs at its end also where the stage of
        # the integrator is elsewhere
        dt = step.end - step.start
        part = (step.target_time - step.start) / dt if dt > 0.0 else 0.0
        ends = [[1.0 - closed_part(seam, at) for seam in self._seams] for at in (step.start, step.end)]
        start, end = np.array(ends)[:, self._seam]
        return ThreadLengths(((1.0 - part) * start + part * end) * self._gap)

    def _gaps(self, x: Array) -> Array:
        """d (E, 3) [m]."""
        return np.einsum("en,eni->ei", self._factors, x[self.stencil])

    def _pulls(self, d: Array, frozen: ThreadLengths) -> tuple[Array, Array]:
        """Tensions (E,) [N], and directions (E, 3) of d."""
        distance = np.linalg.norm(d, axis=1)
        direction = np.divide(d, distance[:, None], out=np.zeros_like(d), where=distance[:, None] > 0.0)
        return self._k * (distance - frozen.length), direction

    def energies(self, x: Array, frozen: ThreadLengths) -> Array:
        tension, _ = self._pulls(self._gaps(x), frozen)
        return (0.5 * tension**2 / self._k)[: self.n_owned]

    def add_gradient(self, x: Array, frozen: ThreadLengths, out: Array) -> None:
        tension, direction = self._pulls(self._gaps(x), frozen)
        forces = self._factors[:, :, None] * (tension[:, None] * direction)[:, None, :]
        np.add.at(out, self.stencil, forces)

    def hessians(
        self, x: Array, frozen: ThreadLengths, lo: int, hi: int, convexity: float, out: Array
    ) -> None:
        d = self._gaps(x)
        tension, direction = (values[lo:hi] for values in self._pulls(d, frozen))
        distance, k, length = np.linalg.norm(d[lo:hi], axis=1), self._k[lo:hi], frozen.length[lo:hi]
        # of a thread without length the energy is ½ k |d|²
        across = np.divide(tension, distance, out=np.where(length > 0.0, 0.0, k), where=distance > 0.0)
        # threads that push are unstable across
        across = np.where(across < 0.0, (1.0 - convexity) * across, across)
        along = k - across
        block = along[:, None, None] * direction[:, :, None] * direction[:, None, :]
        block += across[:, None, None] * np.eye(3)
        factors = self._factors[lo:hi]
        out[:] = np.einsum("ea,eb,eij->eabij", factors, factors, block)

    def targets(self, x: Array, frozen: ThreadLengths) -> tuple[Array, Array]:
        tension, _ = self._pulls(self._gaps(x), frozen)
        return frozen.length[: self.n_owned], -tension[: self.n_owned]

    def are_apart(self, x: Array, frozen: ThreadLengths) -> bool:
        edge = np.linalg.norm(x[self.stencil[:, 2]] - x[self.stencil[:, 1]], axis=1)
        apart = np.linalg.norm(self._gaps(x), axis=1) > AT_VERTEX * edge
        return bool((apart & self._rigid)[: self.n_owned].any())

    def ties(self) -> tuple[Ints, Array]:
        stiff = np.flatnonzero(self.elements.data["soft"][: self.n_owned] == 0.0)
        return self.stencil[stiff].astype(np.int64), self._factors[stiff]

    def force_scale(self, size: float) -> Array:
        return self._k * size

    def thread_forces(self, x: Array, frozen: ThreadLengths) -> Array:
        """Of each owned thread the number of its seam, the distance [m] of its ends, and the force [N] on the
        seam's first side: three components, and its magnitudes across the seam and along it, (n_owned, 7).
        """
        n, d = self.n_owned, self._gaps(x)
        tension, direction = self._pulls(d, frozen)
        edge = x[self.stencil[:n, 2]] - x[self.stencil[:n, 1]]
        edge /= np.linalg.norm(edge, axis=1)[:, None]
        # the tied side may be the second one
        force = self.elements.data["sign"][:n, None] * (tension[:, None] * direction)[:n]
        along = np.einsum("ei,ei->e", force, edge)
        across = np.linalg.norm(force - along[:, None] * edge, axis=1)
        distance = np.linalg.norm(d[:n], axis=1)
        return np.column_stack([self._seam[:n], distance, force, across, np.abs(along)])

    def table_rows(self, x: Array, frozen: ThreadLengths) -> list[tuple[float | str, ...]]:
        total = int(self.over_ranks(np.array([float(self.n_owned)]))[0])
        every = np.zeros((total, 7))
        every[self.elements.index[: self.n_owned]] = self.thread_forces(x, frozen)
        every = self.over_ranks(every.ravel()).reshape(-1, 7)
        rows: list[tuple[float | str, ...]] = []
        for number in np.unique(every[:, 0]).astype(int):  # the vertices of others are joined
            mine = every[every[:, 0] == number, 1:]
            sums = map(float, mine[:, 1:].sum(axis=0))
            rows.append((self._seams[number].label, float(mine[:, 0].max()), *sums))
        return rows


def stiffness_of(rest: RestShape, seam: Seam, ties: Ties) -> tuple[float, bool]:
    """Stiffness [N/m²] of a seam, and whether it is soft against the sheet."""
    beside = np.isin(rest.mesh.triangles, ties.stencil).sum(axis=1) > 1
    shells = [rest.shells[number] for number in np.unique(rest.shell_of[beside])]
    edge = float(np.sqrt(4.0 / np.sqrt(3.0) * rest.area[beside].mean()))
    of_sheet = max(max(shell.c11, shell.c22) for shell in shells) / edge
    k = RIGID * of_sheet if isinstance(seam.stiffness, str) else seam.stiffness
    return k, k <= SOFT * of_sheet


def _springs_shut(seam: Seam, gap: Array) -> bool:
    """Whether a rigid seam with distances (n,) [m] of its sides has no time to close."""
    return seam.rigid and seam.close is None and bool(gap.max() > 0.0)


def elements(rest: RestShape) -> Elements:
    """The ties of all seams (rank 0)."""
    stencils: list[Ints] = []
    data: dict[str, list[Array]] = {name: [] for name in ("weight", "k", "soft", "gap", "seam", "sign")}
    for number, sewn in enumerate(sewn_curves(rest.scene, rest.mesh)):
        ties = sewn.ties
        if not len(ties.stencil):
            continue
        n, (one, other) = len(ties.stencil), (curve.length for curve in sewn.sides)
        gap = np.linalg.norm(ties.gaps(rest.mesh.positions), axis=1)
        seam = rest.scene.seams[number]
        rest.notes.append(
            f"seam {seam.label}: {one:.4g} m and {other:.4g} m long ({100.0 * (other / one - 1.0):+.2f} %), "
            f"{n} ties, open by up to {gap.max().round(12):.3g} m"
            + (": it closes at once; close: {until: …} gives it time" if _springs_shut(seam, gap) else "")
        )
        stencils.append(ties.stencil)
        data["weight"].append(ties.weight)
        k, soft = stiffness_of(rest, seam, ties)
        data["k"].append(k * ties.share)
        data["soft"].append(np.full(n, float(soft)))
        data["gap"].append(gap)
        data["seam"].append(np.full(n, float(number)))
        data["sign"].append(np.full(n, -1.0 if sewn.tied == 0 else 1.0))
    none = np.empty(0)
    return Elements(
        np.concatenate([np.empty((0, 3), dtype=np.int64), *stencils]),
        {name: np.concatenate([none, *values]) for name, values in data.items()},
    )


def make(elements: Elements, scene: Scene, mass: Array) -> SeamThreads:
    """The term on one rank."""
    return SeamThreads(elements, scene.seams)
