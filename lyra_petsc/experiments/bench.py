"""Test bench: makes the meshes of a case, runs its simulations and counts steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import LyraError, SolverError
from lyra_petsc.parallel import all_ranks_arrive, on_root
from lyra_petsc.phases import Phases
from lyra_petsc.scene.messages import validated
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.simulation import SteppedScene, StepReport
from lyra_petsc.terms.bending.midedge import MidEdge

TIGHT = {"force_tolerance": 1e-10, "step_tolerance": 1e-10}
"""Default for scenes of cases: as Newton's method converges quadratically, it ends at round-off."""


@contextmanager
def own_petsc_options() -> Iterator[None]:
    """At the end of the block the PETSc options that were set in it are removed."""
    database = PETSc.Options()
    before = set(database.getAll())
    try:
        yield
    finally:
        for name in set(database.getAll()) - before:
            database.delValue(name)


@contextmanager
def open_simulation(
    comm: MPI.Comm, scene: Scene, phases: Phases | None = None, **arguments: Any
) -> Iterator[SteppedScene]:
    """A simulation; at the end of the block it and the PETSc options that it set are removed; collective.

    ``arguments`` are passed to `SteppedScene`.
    """
    simulation, alone = None, False
    with own_petsc_options():
        try:
            simulation = SteppedScene(comm, scene, phases, **arguments)
            yield simulation
        except BaseException as error:
            # an error on this rank only: destroying the simulation, which is collective, would deadlock
            collective = isinstance(error, LyraError) and getattr(error, "collective", True)
            alone = comm.size > 1 and not collective
            raise
        finally:
            if simulation is not None and not alone:
                simulation.destroy()


def failure_message(comm: MPI.Comm, error: LyraError) -> str:
    """The error that ended a case early, in one line; collective.

    Raises
    ------
    SolverError
        The error itself if it did not occur on every rank: the ranks could not continue together.
    """
    if isinstance(error, SolverError) and not error.collective and not all_ranks_arrive(comm):
        raise error
    return " ".join(str(error).split())


class Trial:
    """One simulation of a case, with access to its state in mesh order on every rank.

    Attributes
    ----------
    simulation : SteppedScene
    start : (V, 3) array
        Positions [m] in mesh order before the first step.
    """

    def __init__(self, bench: Bench, simulation: SteppedScene) -> None:
        self._bench = bench
        self.simulation = simulation
        self.start = self.x

    def step(self) -> StepReport:
        """Take one accepted step; collective."""
        self._bench.watch()
        report = self.simulation.step()
        self._bench.steps += 1
        return report

    def run(self) -> Trial:
        """Step to the end of the scene; collective."""
        while not self.simulation.finished:
            self.step()
        return self

    def run_to(self, time: float) -> Trial:
        """Step to a time [s], or beyond it if no step ends there; collective."""
        while self.simulation.time < time - 1e-9:
            self.step()
        return self

    def run_through(self, times: Sequence[float]) -> Iterator[SteppedScene]:
        """The simulation at each of these ascending times [s], at which steps end; collective."""
        for end in times:
            yield self.run_to(end).simulation

    def gather(self, owned: Array) -> Array:
        """Gather rows of owned vertices (n_vertices, …) in mesh order (V, …) on every rank; collective."""
        return self.simulation.problem.points.gather(owned)

    @property
    def x(self) -> Array:
        """Positions (V, 3) [m] in mesh order."""
        return self.gather(self.simulation.problem.equations.x)

    @property
    def v(self) -> Array:
        """Velocities (V, 3) [m/s] in mesh order."""
        return self.gather(self.simulation.problem.equations.v)

    @property
    def mass(self) -> Array:
        """Masses (V,) [kg] in mesh order."""
        return self.gather(self.simulation.problem.equations.mass)

    def set_state(self, x: Array | None = None, v: Array | None = None) -> None:
        """Replace positions [m] or velocities [m/s], (V, 3) in mesh order; collective."""
        problem = self.simulation.problem
        for target, values in ((problem.equations.x, x), (problem.equations.v, v)):
            if values is not None:
                target[: problem.points.n_vertices] = values[problem.points.mesh_vertices]
                problem.points.update_ghosts(target)
        for term in problem.equations.active.elastic if x is not None else ():
            if isinstance(term, MidEdge):
                own = term.edge_indices < 3 * problem.points.n_owned
                directors = term.reset_frames(problem.equations.x)
                problem.equations.x.reshape(-1)[term.edge_indices[own]] = directors[own]
                problem.points.update_ghosts(problem.equations.x)
                problem.equations.refreeze({term: term.frames})
        problem.equations.state.forget()
        self.simulation.energy_balance.measure()  # the next step compares its energies with these
        if self.simulation.guard is not None:
            self.simulation.guard.forget_end()

    def sum_over_ranks(self, owned: Array) -> float:
        """Sum over all ranks of this rank's values; collective."""
        return float(self._bench.comm.allreduce(float(np.sum(owned))))


def direct_solver_options(comm: MPI.Comm) -> dict[str, Any]:
    """PETSc options of a direct solver.

    On several ranks each rank factors the whole matrix: the cases are small, so that this is faster than a
    parallel factorisation, and it needs no further package.
    """
    return {"pc_type": "lu"} if comm.size == 1 else {"pc_type": "redundant", "redundant_pc_type": "lu"}


class Bench:
    """Test bench of a case: makes meshes and runs simulations; a context manager that removes its files.

    Parameters
    ----------
    comm : MPI.Comm
    watch : callable, optional
        Called before every step on all ranks; may raise to end the work.
    direct : bool
        Default to a direct linear solver and tight tolerances; otherwise scenes run as a user's do.
    trust_mesh : bool
        ``--trust-mesh``.

    Attributes
    ----------
    steps : int
        Accepted steps so far.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        watch: Callable[[], None] | None = None,
        *,
        direct: bool = True,
        trust_mesh: bool = False,
    ) -> None:
        self.comm = comm
        self._direct, self._trust_mesh = direct, trust_mesh
        self.watch = watch or (lambda: None)
        self.steps = 0
        self._folder: TemporaryDirectory[str] | None = None
        self._files = 0

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *error: object) -> None:
        if self._folder is not None:
            self._folder.cleanup()

    def mesh(self, vertices: Array, triangles: Ints, rest: Array | None = None) -> dict[str, Any]:
        """The mesh block of a scene for a surface (V, 3) [m] of triangles (F, 3); collective.

        ``rest`` (V, 2) [m] is its flat rest shape; without it the surface is its own rest shape.
        """

        def write() -> str:
            lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
            corners = (triangles + 1).tolist()
            if rest is None:
                lines += [f"f {a} {b} {c}" for a, b, c in corners]
            else:
                lines += [f"vt {u!r} {v!r}" for u, v in rest.tolist()]
                lines += [f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in corners]
            return self._write_file(".obj", "\n".join(lines) + "\n")

        return {"file": on_root(self.comm, write)}

    def grouped_mesh(self, vertices: Array, triangles: Ints, curves: Mapping[str, Ints]) -> dict[str, Any]:
        """The mesh block of a scene for a surface with curve groups, name → edges (n, 2); collective."""

        def write() -> str:
            # gmsh's format 2.2; physical group 1 is the sheet, curves are numbered from 2
            elements = [f"2 2 1 1 {a} {b} {c}" for a, b, c in (triangles + 1).tolist()]
            for number, edges in enumerate(curves.values(), 2):
                elements += [f"1 2 {number} {number} {a} {b}" for a, b in (edges + 1).tolist()]
            names = ['2 1 "sheet"', *(f'1 {k} "{name}"' for k, name in enumerate(curves, 2))]
            nodes = [f"{k} {x!r} {y!r} {z!r}" for k, (x, y, z) in enumerate(vertices.tolist(), 1)]
            lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat"]
            lines += ["$PhysicalNames", f"{len(names)}", *names, "$EndPhysicalNames"]
            lines += ["$Nodes", f"{len(nodes)}", *nodes, "$EndNodes"]
            numbered = [f"{k} {element}" for k, element in enumerate(elements, 1)]
            lines += ["$Elements", f"{len(numbered)}", *numbered, "$EndElements", ""]
            return self._write_file(".msh", "\n".join(lines))

        return {"file": on_root(self.comm, write)}

    def gmsh_mesh(self, text: str) -> dict[str, Any]:
        """The mesh block of a scene whose mesh gmsh generates from a script; collective."""
        return {"file": on_root(self.comm, lambda: self._write_file(".geo", text))}

    def _write_file(self, suffix: str, text: str) -> str:
        """Write a new temporary file on rank 0 and return its path."""
        if self._folder is None:
            self._folder = TemporaryDirectory(prefix="lyra-cases-")
        self._files += 1
        path = Path(self._folder.name) / f"{self._files}{suffix}"
        path.write_text(text, encoding="utf-8")
        return str(path)

    def run(self, content: Mapping[str, Any], folder: Path) -> Array:
        """Run a scene with its results in a folder, as the verb ``run``; collective.

        Returns positions (V, 3) [m] at the end, in mesh order.
        """
        from lyra_petsc.api.run_loop import ProgressCallbacks, simulate  # what keeps no run needs no files
        from lyra_petsc.output.run_folder import choose_folder

        class LastPositions(ProgressCallbacks):
            x: Array

            def done(self, simulation: SteppedScene, folder: Path) -> None:
                self.x = simulation.problem.points.gather(simulation.problem.equations.x)

        def stop() -> int:
            self.watch()
            return 0

        scene, last = validated(Scene, dict(content), file="scene of the case"), LastPositions()
        choice = choose_folder(self.comm, folder.name, folder, force=True)
        with own_petsc_options():
            simulate(self.comm, scene, choice, last, stop)
        return last.x

    @contextmanager
    def simulation(self, content: Mapping[str, Any], *, stops: Sequence[float] = ()) -> Iterator[Trial]:
        """Set up the simulation of a scene; destroyed at the end of the block; collective.

        ``content`` is a scene as in a file; steps end at the times ``stops`` [s]. By default there are no
        output times and, if ``direct``, the linear solver is direct and tolerances are tight.
        """
        filled: dict[str, Any] = {"output": {"every": None}} | dict(content)
        if self._direct:
            filled = {"solver": TIGHT} | filled
            filled["petsc"] = direct_solver_options(self.comm) | {"ksp_rtol": 1e-12} | filled.get("petsc", {})
        scene = validated(Scene, filled, file="scene of the case")
        if self._trust_mesh:
            scene = scene.trusting_meshes()
        with open_simulation(self.comm, scene, stops=stops) as simulation:
            yield Trial(self, simulation)
