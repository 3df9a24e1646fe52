"""Runs the simulations of a case and counts steps; where answers are exact, with a direct solver."""

from __future__ import annotations

import time
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
from lyra_petsc.parallel import all_here, on_root
from lyra_petsc.phases import Phases
from lyra_petsc.scene.messages import validated
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.simulation import SteppedScene, StepReport
from lyra_petsc.terms.midedge import MidEdge

TIGHT = {"force_tolerance": 1e-10, "step_tolerance": 1e-10}
"""Default where a case's scene has no tolerance: Newton being quadratic, it ends at round-off."""


@contextmanager
def simulated(
    comm: MPI.Comm, scene: Scene, phases: Phases | None = None, **known: Any
) -> Iterator[SteppedScene]:
    """A simulation that is freed at the end of the block, with the PETSc options it set; collective.

    ``known`` are further arguments of `SteppedScene`.
    """
    before = set(PETSc.Options().getAll())
    simulation, alone = None, False
    try:
        simulation = SteppedScene(comm, scene, phases, **known)
        yield simulation
    except BaseException as error:
        # this rank may be alone with its error, and freeing would wait for the others
        together = isinstance(error, LyraError) and getattr(error, "collective", True)
        alone = comm.size > 1 and not together
        raise
    finally:
        if simulation is not None and not alone:
            simulation.destroy()
        database = PETSc.Options()
        for name in set(database.getAll()) - before:
            database.delValue(name)


def problem_of(comm: MPI.Comm, error: LyraError) -> str:
    """Why a case ended early, in one line; collective.

    Raises
    ------
    SolverError
        The error itself, if not every rank has met one: the others could not go on together with this one.
    """
    if isinstance(error, SolverError) and not error.collective and not all_here(comm):
        raise error
    return " ".join(str(error).split())


class Trial:
    """One simulation of a case, with its state in mesh order on every rank.

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
        """One accepted step; collective."""
        self._bench.watch()
        report = self.simulation.step()
        self._bench.steps += 1
        return report

    def run(self) -> Trial:
        """Steps to the end of the scene; collective."""
        while not self.simulation.finished:
            self.step()
        return self

    def through(self, times: Sequence[float]) -> Iterator[SteppedScene]:
        """Steps to each of these times [s], ascending, at which steps end; collective."""
        for end in times:
            while self.simulation.time < end - 1e-9:
                self.step()
            yield self.simulation

    def gather(self, owned: Array) -> Array:
        """Rows of the owned vertices (n_vertices, …) in mesh order (V, …), on every rank; collective."""
        return self.simulation.problem.points.gather(owned)

    @property
    def x(self) -> Array:
        """Positions (V, 3) [m] in mesh order."""
        return self.gather(self.simulation.problem.system.x)

    @property
    def v(self) -> Array:
        """Velocities (V, 3) [m/s] in mesh order."""
        return self.gather(self.simulation.problem.system.v)

    @property
    def mass(self) -> Array:
        """Masses (V,) [kg] in mesh order."""
        return self.gather(self.simulation.problem.system.mass)

    def set_state(self, x: Array | None = None, v: Array | None = None) -> None:
        """Replace positions [m] or velocities [m/s], (V, 3) in mesh order; collective."""
        problem = self.simulation.problem
        for target, values in ((problem.system.x, x), (problem.system.v, v)):
            if values is not None:
                target[: problem.points.n_vertices] = values[problem.points.mesh_vertices]
                problem.points.update_ghosts(target)
        for term in problem.system.active.elastic if x is not None else ():
            if isinstance(term, MidEdge):
                own = term.edge_indices < 3 * problem.points.n_owned
                directors = term.anew(problem.system.x)
                problem.system.x.reshape(-1)[term.edge_indices[own]] = directors[own]
                problem.points.update_ghosts(problem.system.x)
                problem.system.active.refreeze({term: term.frames})
        self.simulation.ledger.measure()  # from which steps reckon what they did to energy

    def total(self, owned: Array) -> float:
        """Sum over all ranks of this rank's values; collective."""
        return float(self._bench.comm.allreduce(float(np.sum(owned))))


def direct_options(comm: MPI.Comm) -> dict[str, Any]:
    """PETSc options of a direct solver.

    On several ranks each factors the whole matrix: cases are small, so that this is faster than a
    parallel factorisation, and it needs no other package.
    """
    return {"pc_type": "lu"} if comm.size == 1 else {"pc_type": "redundant", "redundant_pc_type": "lu"}


class Bench:
    """Runs the simulations of a case; a context manager that removes what it wrote.

    Parameters
    ----------
    comm : MPI.Comm
    watch : callable, optional
        Called before every step on all ranks; may raise to end the work.
    exact : bool
        Fill a direct solver and tight tolerances in; without, scenes run as a user's do.
    trust_mesh : bool
        Give gmsh the scenes' scripts whatever they say.

    Attributes
    ----------
    steps : int
        Accepted steps so far.
    latest : (int, float)
        Accepted steps and wall seconds of the latest simulation, set-up included.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        watch: Callable[[], None] | None = None,
        *,
        exact: bool = True,
        trust_mesh: bool = False,
    ) -> None:
        self.comm = comm
        self._exact, self._trust_mesh = exact, trust_mesh
        self.watch = watch or (lambda: None)
        self.steps = 0
        self.latest = (0, 0.0)
        self._folder: TemporaryDirectory[str] | None = None
        self._files = 0

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *error: object) -> None:
        if self._folder is not None:
            self._folder.cleanup()

    def mesh(self, vertices: Array, triangles: Ints, rest: Array | None = None) -> dict[str, Any]:
        """The mesh block of a scene for a surface (V, 3) [m] of triangles (F, 3); collective.

        ``rest`` (V, 2) [m] is its flat rest shape; without, the surface is its own.
        """

        def write() -> str:
            lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
            corners = (triangles + 1).tolist()
            if rest is None:
                lines += [f"f {a} {b} {c}" for a, b, c in corners]
            else:
                lines += [f"vt {u!r} {v!r}" for u, v in rest.tolist()]
                lines += [f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in corners]
            return self._written(".obj", "\n".join(lines) + "\n")

        return {"file": on_root(self.comm, write)}

    def grouped(self, vertices: Array, triangles: Ints, curves: Mapping[str, Ints]) -> dict[str, Any]:
        """The mesh block of a scene for a surface with curve groups, name → edges (n, 2); collective."""

        def write() -> str:
            # gmsh's format 2.2; physical groups by number: curves from 2 on
            elements = [f"2 2 1 1 {a} {b} {c}" for a, b, c in (triangles + 1).tolist()]
            for number, edges in enumerate(curves.values(), 2):
                elements += [f"1 2 {number} {number} {a} {b}" for a, b in (edges + 1).tolist()]
            names = ['2 1 "sheet"', *(f'1 {k} "{name}"' for k, name in enumerate(curves, 2))]
            nodes = [f"{k} {x!r} {y!r} {z!r}" for k, (x, y, z) in enumerate(vertices.tolist(), 1)]
            lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat"]
            lines += ["$PhysicalNames", f"{len(names)}", *names, "$EndPhysicalNames"]
            lines += ["$Nodes", f"{len(nodes)}", *nodes, "$EndNodes"]
            numbered = [f"{k} {words}" for k, words in enumerate(elements, 1)]
            lines += ["$Elements", f"{len(numbered)}", *numbered, "$EndElements", ""]
            return self._written(".msh", "\n".join(lines))

        return {"file": on_root(self.comm, write)}

    def script(self, text: str) -> dict[str, Any]:
        """The mesh block of a scene whose mesh gmsh makes from a script; collective."""
        return {"file": on_root(self.comm, lambda: self._written(".geo", text))}

    def _written(self, suffix: str, text: str) -> str:
        """Path of a new file with this text, on rank 0."""
        if self._folder is None:
            self._folder = TemporaryDirectory(prefix="lyra-cases-")
        self._files += 1
        path = Path(self._folder.name) / f"{self._files}{suffix}"
        path.write_text(text, encoding="utf-8")
        return str(path)

    @contextmanager
    def simulation(self, content: Mapping[str, Any], *, land: Sequence[float] = ()) -> Iterator[Trial]:
        """Set a scene up; freed, with the options it set, when the block ends; collective.

        ``content`` is a scene as in a file; at times ``land`` steps end. Defaults that are filled in: no
        output times, and on an exact bench a direct linear solver and tight tolerances.
        """
        filled: dict[str, Any] = {"output": {"every": None}} | dict(content)
        if self._exact:
            filled = {"solver": TIGHT} | filled
            filled["petsc"] = direct_options(self.comm) | {"ksp_rtol": 1e-12} | filled.get("petsc", {})
        scene = validated(Scene, filled, file="scene of the case")
        if self._trust_mesh:
            scene = scene.trusting_meshes()
        began, steps = time.perf_counter(), self.steps
        with simulated(self.comm, scene, land=land) as simulation:
            yield Trial(self, simulation)
        self.latest = (self.steps - steps, time.perf_counter() - began)
