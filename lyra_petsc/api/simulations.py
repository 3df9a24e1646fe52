"""A scene that a Python program steps through in a loop."""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from types import TracebackType
from typing import Any, Literal

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.api.scenes import SceneLike, load
from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError, nearest
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.output.fields import FIELDS, check_field
from lyra_petsc.parallel import on_root, take_back_signals
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.simulation import SteppedScene

take_back_signals()  # the import of PETSc has replaced them


_OPEN: weakref.WeakSet[Simulation] = weakref.WeakSet()


@dataclass(frozen=True)
class Step:
    """One accepted step, and the state after it.

    Attributes
    ----------
    number : int
        Accepted steps so far.
    time, dt : float
        End and length of the step [s]; of the load factor in a static analysis.
    positions, velocities : (n, 3) float64
        [m], [m/s], of this rank's vertices, ``Simulation.vertices``.
    energies : dict of str to float
        [J]; see ``Simulation.energies``.
    newton_iterations, linear_iterations, rejected : int
        What it took, rejected attempts included.
    residual : float
        Norm of the force residual [N] that was left.
    wall_seconds : float
    """

    number: int
    time: float
    dt: float
    positions: Array
    velocities: Array
    energies: dict[str, float]
    newton_iterations: int
    linear_iterations: int
    rejected: int
    residual: float
    wall_seconds: float


class Simulation:
    """A scene in memory, stepped through by iteration; writes no files. Every method is collective.

    ::

        with lyra_petsc.Simulation("flag.yaml") as flag:
            for step in flag:
                print(step.time, step.energies["kinetic"])

    Under mpirun every rank has the vertices it owns; in one process that is all of them, in the
    order of the mesh file only after ``gather``.

    Parameters
    ----------
    scene : Scene, path or mapping
    comm : MPI.Comm, optional
        COMM_WORLD unless given.
    trust_mesh : bool
        Give gmsh this scene's scripts (.geo) whatever they say.

    Attributes
    ----------
    scene : Scene
    mesh : Mesh or None
        The whole mesh in file order, on rank 0: ``positions`` at the start, ``rest``, ``triangles``,
        ``groups``.
    vertices : (n,) int64
        Number in the mesh file of each of this rank's vertices.
    triangles : (m,) int64
        Number in the mesh file of each of this rank's triangles.

    Raises
    ------
    InputError
        On all ranks, if the scene cannot be simulated.
    """

    def __init__(self, scene: SceneLike, comm: MPI.Comm | None = None, *, trust_mesh: bool = False) -> None:
        self.comm: MPI.Comm = MPI.COMM_WORLD if comm is None else comm
        loaded = on_root(self.comm, lambda: load(scene, trust_mesh=trust_mesh))
        self.scene: Scene = loaded
        refuse_mixed_options(loaded)
        with np.errstate(over="ignore", invalid="ignore"):
            stepping = SteppedScene(self.comm, loaded)
        self._stepping: SteppedScene | None = stepping
        problem = stepping.problem
        self.mesh: Mesh | None = problem.mesh
        self.vertices: NDArray[np.int64] = problem.points.mesh_vertices
        elements = problem.membrane.elements
        self.triangles: NDArray[np.int64] = elements.index[: elements.n_owned].astype(np.int64)
        _OPEN.add(self)

    # -- stepping ------------------------------------------------------------------------------------

    def __iter__(self) -> Iterator[Step]:
        """The steps from here to the end of the scene."""
        while not self.finished:
            yield self.step()

    def step(self) -> Step:
        """One step, repeated with a smaller Δt where it fails.

        Raises
        ------
        SolverError
            If even the smallest Δt fails; the state is that before the step.
        """
        # numbers that overflow make a step fail, and the message says so
        with np.errstate(over="ignore", invalid="ignore"):
            report = self._running.step()
        return Step(
            report.step,
            report.time,
            report.dt,
            self.positions,
            self.velocities,
            self.energies,
            report.newton_iterations,
            report.linear_iterations,
            report.rejected,
            report.residual,
            report.wall_seconds,
        )

    @property
    def finished(self) -> bool:
        """Whether the end of the scene is reached."""
        return self._running.finished

    @property
    def time(self) -> float:
        """[s], or the load factor of a static analysis."""
        return self._running.time

    @property
    def step_number(self) -> int:
        """Accepted steps so far."""
        return self._running.step_number

    # -- state ---------------------------------------------------------------------------------------

    @property
    def positions(self) -> Array:
        """(n, 3) current positions [m] of this rank's vertices, a copy."""
        return self._running.problem.system.x[: len(self.vertices)].copy()

    @property
    def velocities(self) -> Array:
        """(n, 3) current velocities [m/s] of this rank's vertices, a copy."""
        return np.array(self._running.problem.system.output_velocity()[: len(self.vertices)])

    def field(self, name: str) -> Array:
        """A field that ``output.fields`` of a scene may name, on this rank's vertices or triangles.

        Raises
        ------
        InputError
            If there is none of that name, or its term is not in the scene.
        """
        if name not in FIELDS:
            raise InputError(f"unknown field {name!r}, {nearest(name, FIELDS)}", key="field")
        problem = self._running.problem
        check_field(FIELDS[name], problem)
        return np.array(FIELDS[name].compute(problem))

    @property
    def energies(self) -> dict[str, float]:
        """Of the whole sheet [J]: kinetic, membrane, bending, potential; and the cumulative works
        external_work (handles and loads other than gravity) and dissipation (damping of the material and of
        impacts); and the energies of terms that have a column of their own in history.csv.
        """
        energies = asdict(self._running.budget)
        more: dict[str, float] = energies.pop("more")
        return energies | more

    @property
    def notes(self) -> list[str]:
        """What one should know: mesh repairs, a linear solver that was changed, …"""
        return [*self._running.notes, *filter(None, [self._running.note_of_repeats])]

    def gather(self, rows: NDArray[Any], on: Literal["vertex", "triangle"] = "vertex") -> NDArray[Any] | None:
        """Rows of the ranks' vertices, or triangles, in the order of the mesh file: on rank 0, else None.

        Parameters
        ----------
        rows : (n, ...) or (m, ...) array
            A row for each of this rank's ``vertices``, as in ``positions``, or ``triangles``.
        on : str
            Which of these.
        """
        numbers = self.vertices if on == "vertex" else self.triangles
        if not self.comm.allreduce(len(rows) == len(numbers), MPI.LAND):
            raise ValueError(f"a rank has {len(rows)} rows, not one for each {on} of its own")
        pieces = self.comm.gather((numbers, rows), root=0)
        if pieces is None:
            return None
        order = np.concatenate([piece[0] for piece in pieces])
        stacked = np.concatenate([piece[1] for piece in pieces])
        whole: NDArray[Any] = np.empty_like(stacked)
        whole[order] = stacked
        return whole

    # -- end -----------------------------------------------------------------------------------------

    @property
    def _running(self) -> SteppedScene:
        if self._stepping is None:
            raise ValueError("this simulation is closed")
        return self._stepping

    def close(self) -> None:
        """Free what PETSc and MPI hold, and take back the scene's PETSc options; collective."""
        if self._stepping is not None:
            self._stepping.destroy()
            self._stepping = None
        _OPEN.discard(self)

    def __enter__(self) -> Simulation:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None or self.comm.size == 1:  # on several ranks others may not come here
            self.close()

    def __del__(self) -> None:
        # on several ranks it is not known whether all of them drop it at the same time
        if getattr(self, "_stepping", None) is not None and self.comm.size == 1 and not MPI.Is_finalized():
            self.close()


def refuse_mixed_options(scene: Scene) -> None:
    """PETSc has one set of options: two simulations at a time cannot have different ones.

    Raises
    ------
    InputError
    """
    if any(other.scene.petsc != scene.petsc for other in _OPEN):
        raise InputError(
            "another Simulation that is open has other PETSc options; close() it first",
            file=scene.source,
            key="petsc",
        )
