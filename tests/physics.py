"""Scenes for tests of the physics: built, stepped with fixed Δt, and gathered in mesh order."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.points import Layout
from lyra_petsc.output.recorder import Recorder
from lyra_petsc.phases import Phases
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.newton.force_scales import residual_roundoff
from lyra_petsc.stepping.problem import Problem, build_problem
from lyra_petsc.stepping.simulation import SteppedScene
from lyra_petsc.stepping.stepper import Attempt, Stepper
from lyra_petsc.terms.term import Elastic

CLOTH = {"density": 0.2, "membrane": {"c11": 1200.0, "c22": 800.0, "c12": 300.0, "c33": 250.0}}
"""The orthotropic cloth of reference A6, without bending."""

TIGHT = {"force_tolerance": 1e-9, "step_tolerance": 1e-9}
"""Tolerances of tests; Newton's method ends far below, as its convergence is quadratic."""

REFERENCE = Path(__file__).parent / "reference"


def reference(name: str) -> dict[str, Any]:
    """A file of ``tests/reference``."""
    return json.loads((REFERENCE / f"{name}.json").read_text(encoding="utf-8"))


def scene_of(content: dict[str, Any]) -> Scene:
    """A checked scene; ``time`` and tight tolerances are filled in."""
    defaults = {"time": {"end": 1e3, "step": 0.01}, "material": dict(CLOTH), "solver": dict(TIGHT)}
    return Scene.model_validate(defaults | content)


def grid(width: float, height: float, nx: int, ny: int, pattern: str = "diagonal") -> dict[str, Any]:
    """A mesh block of one grid."""
    return {"grid": {"width": width, "height": height, "nx": nx, "ny": ny, "pattern": pattern}}


def direct_solver(comm: MPI.Comm) -> dict[str, str]:
    """Options of a direct solver that this PETSc has on this number of ranks."""
    if comm.size == 1:
        return {"pc_type": "lu"}
    if PETSc.Sys.hasExternalPackage("mumps"):
        return {"pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}
    return {"pc_type": "redundant"}


def obj_file(
    path: Path,
    vertices: Iterable[Sequence[float]],
    triangles: Iterable[Sequence[int]],
    uv: Iterable[Sequence[float]] = (),
) -> dict[str, Any]:
    """Write an .obj whose rest shape is the surface itself, or ``uv`` (V, 2) [m]; returns its mesh block."""
    rows = [f"v {float(x)!r} {float(y)!r} {float(z)!r}" for x, y, z in vertices]
    flat = [f"vt {float(u)!r} {float(v)!r}" for u, v in uv]
    corner = "{0}/{0}" if flat else "{0}"
    rows += flat + ["f " + " ".join(corner.format(i + 1) for i in each) for each in triangles]
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return {"file": str(path)}


def mirrored(
    path: Path,
    planes: str,
    n: int,
    height: Callable[[Array], Array],
    width: float = 1.0,
    fold: Callable[[Array], Array] = lambda x: x,
) -> tuple[dict[str, Any], Array]:
    """A surface of this height [m] over x, y in [0, 1] times a width [m], with its images in the planes x = 0
    and y = 0; its mesh block and vertices, both after ``fold`` of the vertices.
    """
    side = np.linspace(0.0, 1.0, n + 1)
    flat = np.array([(x, y) for y in side for x in side])
    first = [j * (n + 1) + i for j in range(n) for i in range(n)]
    faces = np.array([t for a in first for t in ((a, a + 1, a + n + 2), (a, a + n + 2, a + n + 1))])
    for axis in range(2):
        if "xy"[axis] in planes:
            image = flat * np.where(np.arange(2) == axis, -1.0, 1.0)
            faces = np.concatenate([faces, faces[:, ::-1] + len(flat)])
            flat, same = np.unique(np.round(np.concatenate([flat, image]), 12), axis=0, return_inverse=True)
            faces = same.ravel()[faces]
    vertices = fold(np.column_stack([width * flat, height(flat)]))
    return obj_file(path, vertices, faces), vertices


def symmetry_planes(axes: str) -> list[dict[str, Any]]:
    """Handles for the planes x = 0 and y = 0 of a `mirrored` surface."""
    boxes = {"x": [[0, -2, -1], [0, 2, 1]], "y": [[-2, 0, -1], [2, 0, 1]]}
    return [{"box": boxes[axis], "symmetry": axis} for axis in axes]


def equilateral(path: Path, radius: float = 1.0) -> dict[str, Any]:
    """One equilateral triangle about the origin in the xy plane, circumradius in metres."""
    angles = np.pi / 2 + 2 * np.pi / 3 * np.arange(3)
    corners = radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(3)])
    return obj_file(path, corners, [(0, 1, 2)])


def rotation(axis: Sequence[float], angle: float) -> Array:
    """Rotation matrix (Rodrigues) about an axis by an angle [rad]."""
    a = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    k = np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * k @ k)


def gathered(layout: Layout, owned: Array) -> Array:
    """Rows of the owned vertices (n_vertices or more, …) in mesh order, on every rank; collective."""
    return layout.gather(owned)


@contextmanager
def options(given: Mapping[str, Any]) -> Iterator[None]:
    """Set PETSc options; these, and all others set meanwhile, are removed again."""
    database = PETSc.Options()
    before = set(database.getAll())
    for name, value in given.items():
        database[name] = value
    try:
        yield
    finally:
        for name in set(database.getAll()) - before:
            database.delValue(name)


@contextmanager
def stepped(comm: MPI.Comm, scene: Scene | dict[str, Any], **petsc: Any) -> Iterator[SteppedScene]:
    """A stepped scene, with PETSc options; freed collectively unless the body fails."""
    with options(petsc):
        simulation = SteppedScene(comm, scene if isinstance(scene, Scene) else scene_of(scene))
        yield simulation
        simulation.destroy()


@contextmanager
def finished(comm: MPI.Comm, scene: Scene | dict[str, Any], **petsc: Any) -> Iterator[SteppedScene]:
    """A stepped scene after all of its steps."""
    with stepped(comm, scene, **petsc) as simulation:
        while not simulation.finished:
            simulation.step()
        yield simulation


def shape(simulation: SteppedScene) -> Array:
    """Positions (V, 3) [m] in mesh order, on every rank."""
    return gathered(simulation.problem.points, simulation.problem.equations.x)


class Simulation:
    """A scene's model and stepper with a direct solver; a context manager, collective.

    What it sets in the options database is removed again.

    Parameters
    ----------
    content : dict
        A scene's content, see ``scene_of``.
    comm : MPI.Comm
    options : dict
        PETSc options beside or instead of the direct solver's.
    """

    def __init__(
        self, content: dict[str, Any], comm: MPI.Comm = MPI.COMM_WORLD, options: dict[str, str] | None = None
    ) -> None:
        self._options = (direct_solver(comm) if options is None else options) | {"ksp_rtol": "1e-12"}
        database = PETSc.Options()
        for name, value in self._options.items():
            database.setValue(name, value)
        self.scene = scene_of(content)
        self.comm = comm
        self.problem: Problem = build_problem(comm, self.scene, Phases())
        self.equations = self.problem.equations
        whole = self.problem.whole
        self.stepper = Stepper(
            self.scene,
            self.equations,
            self.problem.surface,
            whole.spacing,
            residual_roundoff(self.equations.forces, whole.largest_coordinate),
        )
        self.stepper.start(0.0, 0)
        self.time = 0.0

    def __enter__(self) -> Simulation:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if error is None:  # freeing is collective: a rank that fails must not wait for the others
            self.stepper.destroy()
            self.problem.discretisation.destroy()
        database = PETSc.Options()
        for name in [*self._options, *self.stepper.our_options]:
            database.delValue(name)

    # -- state -----------------------------------------------------------------------------------------

    def gather(self, owned: Array) -> Array:
        """Rows of the owned vertices in mesh order, on every rank."""
        return gathered(self.problem.points, owned)

    @property
    def x(self) -> Array:
        """Positions (V, 3) [m] in mesh order, on every rank."""
        return self.gather(self.equations.x)

    @property
    def v(self) -> Array:
        """Velocities (V, 3) [m/s] in mesh order, on every rank."""
        return self.gather(self.equations.v)

    @property
    def mass(self) -> Array:
        """Masses (V,) [kg] in mesh order, on every rank."""
        return self.gather(self.equations.mass)

    def set_state(self, x: Array | None = None, v: Array | None = None) -> None:
        """Replace positions or velocities, (V, 3) in mesh order."""
        layout, state = self.problem.points, self.equations.state
        rows = slice(0, layout.n_vertices)
        if x is not None:
            state.x[rows] = x[layout.mesh_vertices]
        if v is not None:
            state.v[rows] = v[layout.mesh_vertices]
        state.update_ghosts()

    def energy(self, name: str) -> float:
        """Energy [J] of an elastic term, over all ranks."""
        term = self.problem.terms[name]
        assert isinstance(term, Elastic)
        return float(
            self.comm.allreduce(
                float(term.energies(self.equations.x, self.equations.step.frozen[term]).sum())
            )
        )

    # -- steps -----------------------------------------------------------------------------------------

    def step(self, dt: float) -> Attempt:
        """Compute one step, which must converge."""
        self.equations.reference.record_starts(self.time, self.equations.x)
        end = self.time + dt
        attempt = self.stepper.attempt(self.time, end)
        assert attempt.converged, f"step to {end} s: {attempt}"
        self.time = end
        return attempt

    def run(self, dt: float, steps: int) -> Array:
        """Compute a number of steps; returns the positions (V, 3)."""
        for _ in range(steps):
            self.step(dt)
        return self.x


def end_on_one_rank(comm: MPI.Comm, scene: Scene, folder: Path, steps: int) -> Array | None:
    """Positions at the end of a run (V, 3) in mesh order, on rank 0; None on the others; collective.

    So many steps are taken on all ranks; the run goes on from its checkpoint in ``folder`` on rank 0 alone.
    """
    return end_on_changing_ranks(comm, scene, folder, [(comm.size, steps), (1, None)])


def end_on_changing_ranks(
    comm: MPI.Comm, scene: Scene, folder: Path, parts: Sequence[tuple[int, int | None]]
) -> Array | None:
    """Positions at the end of a run (V, 3) in mesh order, on rank 0; None on the others; collective.

    The run consists of ``parts``: on so many ranks it goes on from its checkpoint in ``folder`` to the step
    of this number, or to its end.
    """
    x, before = None, 0
    for ranks, steps in parts:
        few = comm.Split(0 if comm.rank < ranks else 1)
        if comm.rank < ranks:
            simulation = SteppedScene(few, scene)
            recorder = Recorder(simulation)
            if before == 0:
                if comm.rank == 0:
                    folder.mkdir()
                few.Barrier()
                recorder.begin(folder)
            else:
                recorder.resume(folder)
            assert simulation.step_number == before
            while not simulation.finished and simulation.step_number != steps:
                recorder.record(simulation.step())
            recorder.write_checkpoint()
            recorder.flush()
            recorder.close()
            x = shape(simulation)
            simulation.destroy()
        few.Free()
        comm.Barrier()
        before = steps or 0
    return x if comm.rank == 0 else None
