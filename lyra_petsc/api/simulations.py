"""A scene that a Python program steps through in a loop."""

from __future__ import annotations

import copy
import weakref
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from types import TracebackType
from typing import Any, Literal

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.api.controls import Controls, drive, finite_rows
from lyra_petsc.api.scenes import SceneLike, load
from lyra_petsc.arrays import Array, Ints, unwritable
from lyra_petsc.errors import InputError, python_argument_names, suggest
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.output.checkpoint import Checkpoint
from lyra_petsc.output.continuation import checkpoint_of, refuse_crossing_positions, take
from lyra_petsc.output.fields import FIELDS, check_field
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.parallel import on_root, restore_signal_handlers
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.outside_changes import ProgramForces, add_forces, set_state
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


@dataclass(frozen=True)
class SavedState:
    """A state that `Simulation.restore` returns to.

    Attributes
    ----------
    checkpoint : Checkpoint
        What a checkpoint of a run holds, on this rank.
    driven : dict
        How all that is driven goes on.
    forces : (n, 3) or None
        The forces [N] that the program has set.
    """

    checkpoint: Checkpoint
    driven: dict[str, Any]
    forces: Array | None


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
    drives : iterable of str
        What the program moves or changes in time: ``handles[0]``, ``obstacles.ball``, ``gravity``,
        ``wind.velocity``, ``loads[0].pressure``, …
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

    def __init__(
        self,
        scene: SceneLike,
        comm: MPI.Comm | None = None,
        *,
        drives: Iterable[str] = (),
        trust_mesh: bool = False,
    ) -> None:
        self.comm: MPI.Comm = MPI.COMM_WORLD if comm is None else comm
        names = (drives,) if isinstance(drives, str) else tuple(drives)
        loaded = on_root(self.comm, lambda: load(scene, trust_mesh=trust_mesh))
        self.scene: Scene = loaded
        refuse_mixed_options(loaded)
        self._names = names
        self._stepping: SteppedScene | None = self._start()
        problem = self._stepping.problem
        self.mesh: Mesh | None = problem.mesh
        self.vertices: NDArray[np.int64] = problem.points.mesh_vertices
        elements = problem.membrane.elements
        self.triangles: NDArray[np.int64] = elements.index[: elements.n_owned].astype(np.int64)
        unwritable(self.vertices, self.triangles)
        _OPEN.add(self)

    def _start(self, mesh: Mesh | None = None, owner: Ints | None = None) -> SteppedScene:
        """The scene at its start; rank 0 may know its mesh and the owners of its vertices."""
        self._forces: ProgramForces | None = None
        with python_argument_names():
            scene, driven = drive(self.scene, self._names)
        self._controls = Controls(driven)
        with np.errstate(over="ignore", invalid="ignore"):
            return SteppedScene(self.comm, scene, mesh=mesh, owner=owner)

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
        return _handed_out(self._running.problem.equations.x[: len(self.vertices)])

    @positions.setter
    def positions(self, values: Array) -> None:
        """Set the positions (n, 3) [m]; vertices that handles hold keep theirs."""
        self._set_state("positions", values, self.velocities)

    @property
    def velocities(self) -> Array:
        """Current velocities (n, 3) [m/s] of this rank's vertices, a copy."""
        return self.field("velocity")

    @velocities.setter
    def velocities(self, values: Array) -> None:
        """Set the velocities (n, 3) [m/s]; vertices that handles hold keep theirs."""
        self._set_state("velocities", self.positions, values)

    def _set_state(self, name: str, positions: Array, velocities: Array) -> None:
        x, v = (
            finite_rows(self.comm, name, values, len(self.vertices)) for values in (positions, velocities)
        )
        run = self._running
        if self.scene.contact is not None:
            whole = self.gather(x)
            on_root(self.comm, lambda: refuse_crossing_positions(run, np.asarray(whole)))
        with np.errstate(over="ignore", invalid="ignore"):
            set_state(run, x, v)
        self._note(name)

    def _note(self, name: str) -> None:
        """Note, also for states that are saved, that the program has changed something."""
        text = f"the program has set {name}: the scene alone does not repeat this run"
        self._running.run_notes.once(f"set {name}", text)

    @property
    def forces(self) -> Array:
        """Forces (n, 3) [N] on this rank's vertices that the program has set, a copy."""
        return _handed_out(np.zeros((len(self.vertices), 3)) if self._forces is None else self._forces.forces)

    @forces.setter
    def forces(self, values: Array) -> None:
        """Set forces (n, 3) [N] that act on this rank's vertices from now on, besides the scene's loads."""
        rows = finite_rows(self.comm, "forces", values, len(self.vertices))
        if self._forces is None:
            self._forces = add_forces(self._running, np.zeros_like(rows))
        self._forces.set(self._running, rows)
        self._note("forces")

    # -- what is driven ----------------------------------------------------------------------------

    def move(
        self,
        name: str,
        *,
        translate: Iterable[float] = (0.0, 0.0, 0.0),
        rotate: Mapping[str, Any] | None = None,
        scale: float | Iterable[float] = 1.0,
        at: float | None = None,
    ) -> None:
        """Move a driven handle or obstacle in a straight line to a place, where it then stays.

        Parameters
        ----------
        name : str
            As in ``drives``: ``handles[0]``, ``obstacles.ball``.
        translate, rotate, scale
            As in a keyframe of the scene: from the start, not from the present place.
        at : float, optional
            When it is there [s]; by default at the end of the next step.

        Raises
        ------
        InputError
        """
        place = {"translate": list(translate), "rotate": rotate, "scale": scale}
        self._controls.move(self._running, name, place, at)
        self._note(name)

    def set(self, name: str, value: Any, *, at: float | None = None) -> None:
        """Change a driven value of the scene now, or in a straight line until a time.

        Parameters
        ----------
        name : str
            As in ``drives``: ``gravity``, ``wind.velocity``, ``loads[0].pressure``.
        value : float or (3,)
        at : float, optional
            When it has this value [s]; by default now.
        """
        self._controls.set(self._running, name, value, at)
        self._note(name)

    @property
    def reactions(self) -> dict[str, Array]:
        """Force (3,) [N] of each handle on the sheet in the last step, by name as in ``drives``."""
        forces = self._running.energy_balance.handle_forces(len(self.scene.handles))
        return {f"handles[{number}]": _handed_out(force) for number, force in enumerate(forces)}

    # -- saved states ------------------------------------------------------------------------------

    def save(self) -> SavedState:
        """The present state in memory, for `restore`."""
        kept = copy.deepcopy(checkpoint_of(self._running))
        forces = None if self._forces is None else self._forces.forces.copy()
        return SavedState(kept, self._controls.saved_state(), forces)

    def restore(self, saved: SavedState) -> None:
        """Return to a state that this simulation has saved; it goes on as it went on from there."""
        if not isinstance(saved, SavedState):
            raise InputError("needs what save() returned", key="Simulation.restore")
        self.reset()
        run = self._running
        self._controls.restore(saved.driven)
        order = FileOrder(self.comm, self.vertices, run.problem.points.n_vertices_global)
        take(run, saved.checkpoint, order)
        if saved.forces is not None:
            self._forces = add_forces(run, saved.forces)

    def reset(self) -> None:
        """Return to the start of the scene, with nothing set by the program."""
        owner = self.gather(np.full(len(self.vertices), self.comm.rank))
        self._running.destroy()
        self._stepping = None
        self._stepping = self._start(self.mesh, owner)

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
        return _handed_out(FIELDS[name].compute(problem))

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
        loads = self._running.energy_balance.obstacle_forces(len(names))
        return {name: _handed_out(load) for name, load in zip(names, loads, strict=True)}

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
            message = f"a rank has {len(rows)} rows, not one for each {on} of its own"
            raise InputError(f"{message}; give arrays as .positions or .field() return them", key="gather")
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
            raise InputError("is closed: make another one, or leave it open until the end", key="Simulation")
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


def _handed_out(values: NDArray[Any]) -> Array:
    """A copy that cannot be written to: what is changed in it would have no effect."""
    result: Array = np.array(values)
    unwritable(result)
    return result
