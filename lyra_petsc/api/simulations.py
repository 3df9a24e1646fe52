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
from lyra_petsc.errors import InputError, suggest
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.output.fields import FIELDS, check_field
from lyra_petsc.parallel import on_root, restore_signal_handlers
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.simulation import SteppedScene

restore_signal_handlers()  # PETSc's import has replaced the signal handlers


_OPEN: weakref.WeakSet[Simulation] = weakref.WeakSet()


@dataclass(frozen=True)
class Step:
    """One accepted step, and the state after it.

    Attributes
    ----------
    number : int
        Accepted steps so far.
    time, dt : float
        End and length of the step [s]; in a static analysis load factor and its increment.
    positions, velocities : (n, 3) float64
        Positions [m] and velocities [m/s] of this rank's vertices, ``Simulation.vertices``.
    energies : dict of str to float
        Energies [J]; see ``Simulation.energies``.
    newton_iterations, linear_iterations, rejected : int
        Numbers of iterations, including those of rejected attempts, and of rejected attempts.
    residual : float
        Norm of the final force residual [N].
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

    Under mpirun every rank has the vertices it owns; a single process has all of them. ``gather`` returns
    arrays in the order of the mesh file.

    Parameters
    ----------
    scene : Scene, path or mapping
    comm : MPI.Comm, optional
        Default COMM_WORLD.
    trust_mesh : bool
        Let this scene's scripts (.geo) read any file, and run where there is no seccomp.

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
        """Take the remaining steps up to the end of the scene."""
        while not self.finished:
            yield self.step()

    def step(self) -> Step:
        """Take one step, which is repeated with a smaller Δt if it fails.

        Raises
        ------
        SolverError
            If even the smallest Δt fails; the state is that before the step.
        """
        # overflow makes a step fail, with a message of its own
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
        """Current time [s], or the load factor of a static analysis."""
        return self._running.time

    @property
    def step_number(self) -> int:
        """Accepted steps so far."""
        return self._running.step_number

    # -- state ---------------------------------------------------------------------------------------

    @property
    def positions(self) -> Array:
        """Current positions (n, 3) [m] of this rank's vertices, a copy."""
        return self._running.problem.equations.x[: len(self.vertices)].copy()

    @property
    def velocities(self) -> Array:
        """Current velocities (n, 3) [m/s] of this rank's vertices, a copy."""
        return self.field("velocity")

    def field(self, name: str) -> Array:
        """A field of those that a scene's ``output.fields`` may name, on this rank's vertices or triangles.

        Raises
        ------
        InputError
            If there is no field of that name, or the scene lacks its term.
        """
        if name not in FIELDS:
            raise InputError(f"unknown field {name!r}, {suggest(name, FIELDS)}", key="field")
        problem = self._running.problem
        check_field(FIELDS[name], problem)
        return np.array(FIELDS[name].compute(problem))

    @property
    def energies(self) -> dict[str, float]:
        """Energies [J] of the whole sheet.

        kinetic, membrane, bending, potential; the cumulative works external_work (handles and loads other
        than gravity) and dissipation (damping of the material and of impacts); and the energies of terms with
        a column in history.csv.
        """
        energies = asdict(self._running.budget)
        more: dict[str, float] = energies.pop("more")
        return energies | more

    @property
    def obstacle_forces(self) -> dict[str, Array]:
        """Force [N] and torque [N m] about the origin of the sheets on each obstacle, and the sums over
        contacts of the magnitudes of normal force and friction [N], (8,), by its name.
        """
        names = list(self.scene.obstacles or {})
        return dict(zip(names, self._running.energy_balance.obstacle_forces(len(names)), strict=True))

    @property
    def notes(self) -> list[str]:
        """Messages for the user, about mesh repairs, a changed linear solver, …"""
        return [*self._running.notes, *filter(None, [self._running.note_of_repeats])]

    def gather(self, rows: NDArray[Any], on: Literal["vertex", "triangle"] = "vertex") -> NDArray[Any] | None:
        """Gather rows of all ranks in the order of the mesh file on rank 0; None on other ranks.

        Parameters
        ----------
        rows : (n, ...) or (m, ...) array
            A row for each of this rank's ``vertices``, as in ``positions``, or of its ``triangles``.
        on : str
            Whether rows are on vertices or triangles.
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
        """Free all PETSc and MPI objects, and remove the scene's PETSc options; collective."""
        if self._stepping is not None:
            self._stepping.destroy()
            self._stepping = None
        _OPEN.discard(self)

    def __enter__(self) -> Simulation:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None or self.comm.size == 1:  # collective: other ranks may not have the error
            self.close()

    def __del__(self) -> None:
        # collective: several ranks need not delete it at the same time
        if getattr(self, "_stepping", None) is not None and self.comm.size == 1 and not MPI.Is_finalized():
            self.close()


def refuse_mixed_options(scene: Scene) -> None:
    """Refuse a scene whose PETSc options differ from those of an open simulation: PETSc has one database.

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
