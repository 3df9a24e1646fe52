"""Contact in motion on any number of ranks: momentum, resting loads, and no crossings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from physics import CLOTH, gathered, grid, obj_file, scene_of

from lyra_petsc.contact.barrier import ContactBarrier
from lyra_petsc.contact.crossings import mutual_crossings, self_crossings
from lyra_petsc.contact.overlaps import behind_planes, inside_ball, outside_ball
from lyra_petsc.errors import SolverError
from lyra_petsc.mesh.obstacles import Container, Solid
from lyra_petsc.stepping.energy_guard import LARGEST_SUM
from lyra_petsc.stepping.simulation import SteppedScene

Array = NDArray[np.float64]
Watch = Callable[[SteppedScene], None]

pytestmark = pytest.mark.parallel(3)

LOWER = grid(0.6, 0.4, 5, 4, "alternating")
UPPER = grid(0.55, 0.4, 4, 4) | {"transform": {"translate": [0.03, 0.01, 0.06]}}
N_LOWER = 30
CONTACT = {"gap": 0.02}
MATERIAL = CLOTH | {"bending": 1e-4}
TIGHT = {"force_tolerance": 1e-10, "step_tolerance": 1e-10}
GRAVITY = {"gravity": [0.0, 0.0, -9.81]}
INTEGRATORS = ["beuler", "semi-implicit", "midpoint", "bdf2", "alpha2"]


class Watched:
    """A scene whose states are all checked for crossings, on rank 0."""

    def __init__(self, comm: MPI.Comm, scene: dict[str, Any], **petsc: Any) -> None:
        self._options = petsc
        database = PETSc.Options()
        for name, value in petsc.items():
            database[name] = value
        content = {"material": MATERIAL, "contact": CONTACT, "solver": TIGHT} | scene
        self.comm, self.simulation = comm, SteppedScene(comm, scene_of(content))
        term = self.simulation.problem.terms["contact"]
        assert isinstance(term, ContactBarrier)
        self.term = term
        self.equations = self.simulation.problem.equations
        layout = self.equations.points
        pieces = comm.allgather(layout.global_number[term.search.surface])
        originals = np.concatenate(comm.allgather(layout.mesh_vertices))
        every = np.unique(np.sort(originals[np.concatenate(pieces)], axis=1), axis=0)
        self.triangles = every.astype(np.int64)
        self.look()

    def __enter__(self) -> Watched:
        return self

    def __exit__(self, kind: type | None, *rest: object) -> None:
        database = PETSc.Options()
        for name in [*self._options, *self.simulation.stepper.our_options]:
            database.delValue(name)
        if kind is None:
            self.simulation.destroy()

    @property
    def x(self) -> Array:
        """Positions (V, 3) in mesh order."""
        return gathered(self.equations.points, self.equations.x)

    @property
    def v(self) -> Array:
        return gathered(self.equations.points, self.equations.v)

    def throw(self, v: Callable[[Array], Array]) -> None:
        """Set velocities as a function of the positions."""
        n = self.equations.points.n_owned
        x = self.equations.x[:n].copy()
        vertices = np.arange(n)[:, None] < self.equations.points.n_vertices
        self.equations.state.set(x, np.where(vertices, v(x), 0.0))
        self.simulation.energy_balance.measure()
        self.simulation.stepper.start(0.0, 0)

    def look(self) -> None:
        """Check that nothing crosses; collective."""
        x = self.x
        found = [len(self_crossings(x, self.triangles))]
        for obstacle in self.term.obstacles.bodies:
            found.append(self._in(x, obstacle))
        assert not any(found), f"t = {self.simulation.time}: {found} cross"

    def _in(self, x: Array, obstacle: Solid | Container) -> int:
        at = obstacle.positions(self.simulation.time)
        if isinstance(obstacle, Container) and obstacle.kind == "planes":
            normals = obstacle.normals_at(self.simulation.time)
            return len(behind_planes(x, self.triangles, at, normals).vertices)
        if isinstance(obstacle, Container):
            return len(outside_ball(x, self.triangles, at, obstacle.radius).vertices)
        if obstacle.radius > 0.0:
            inside = inside_ball(x, self.triangles, at, obstacle.radius)
            return len(inside.vertices) + len(inside.edges) + len(inside.triangles)
        return len(mutual_crossings(x, self.triangles, at, obstacle.triangles))

    def run(self, watch: Watch = lambda simulation: None, steps: int | None = None) -> Watched:
        """Run to the end, or for a number of steps."""
        while not self.simulation.finished and steps != 0:
            self.simulation.step()
            self.look()
            watch(self.simulation)
            steps = None if steps is None else steps - 1
        return self

    def forces(self, x: Array | None = None) -> tuple[Array, float]:
        """Sum of the contact forces on the sheets [N], and the largest of them, at the last stage."""
        equations = self.equations
        x = equations.evaluated.x if x is None else x
        force = np.zeros((equations.points.n_local, 3))
        self.term.add_gradient(x, equations.step.frozen[self.term], force)
        own = -force[: equations.points.n_owned]
        largest = self.comm.allreduce(float(np.abs(own).max(initial=0.0)), MPI.MAX)
        return np.asarray(equations.points.global_sum(*own.sum(axis=0))), largest

    @property
    def momentum(self) -> Array:
        n = self.equations.points.n_owned
        return np.asarray(self.equations.points.global_sum(*(self.equations.mass @ self.equations.v[:n])))


def toward_each_other(speed: float) -> Callable[[Array], Array]:
    def v(x: Array) -> Array:
        up = np.where(x[:, 2] > 0.03, -speed, speed)
        return np.column_stack([np.zeros_like(up), np.zeros_like(up), up])

    return v


def two_sheets(**more: Any) -> dict[str, Any]:
    return {"mesh": [LOWER, UPPER], "time": {"end": 0.04, "step": 0.002}} | more


def tight_linear(integrator: str) -> dict[str, Any]:
    return {"ksp_rtol": 1e-12} if integrator == "semi-implicit" else {}


@pytest.mark.parallel(2)
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_sheets_thrown_at_each_other(comm: MPI.Comm, integrator: str) -> None:
    time = {"end": 0.018, "step": 0.002, "integrator": integrator}
    with Watched(comm, two_sheets(time=time), **tight_linear(integrator)) as run:
        run.throw(toward_each_other(2.0))
        before, most = run.momentum, 0.0
        scale = 2.0 * comm.allreduce(float(run.equations.mass.sum()))

        def watch(simulation: SteppedScene) -> None:
            nonlocal most
            total, largest = run.forces()
            assert np.abs(total).max() <= 1e-12 * largest
            most = max(most, largest)
            assert np.abs(run.momentum - before).max() < 1e-8 * scale

        run.run(watch)
        assert most > 0.1
        v = run.v[:, 2]
        assert v[N_LOWER:].mean() > v[:N_LOWER].mean(), "they fly apart again"


def height_under(point: Array, triangles: Array) -> float:
    """Largest z at which the vertical line through a point hits triangles (n, 3, 3), or -inf."""
    a, u, v = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    area, w = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0], point - a
    s = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / area
    t = (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0]) / area
    inside = (s >= 0.0) & (t >= 0.0) & (s + t <= 1.0)
    return float((a[:, 2] + s * u[:, 2] + t * v[:, 2])[inside].max(initial=-np.inf))


@pytest.mark.parametrize("speed", [10.0, pytest.param(100.0, marks=pytest.mark.parallel(1))])
def test_sheets_thrown_fast_with_large_steps(comm: MPI.Comm, speed: float) -> None:
    """The lower sheet is so wide and stiff that there is no way around it."""
    stiff = {"density": 0.2, "membrane": {"c11": 1e6, "c22": 1e6, "c12": 3e5, "c33": 3.5e5}}
    wide = grid(1.6, 1.6, 5, 5) | {"transform": {"translate": [-0.5, -0.6, 0.0]}}
    scene = two_sheets(mesh=[wide, UPPER], material=stiff, time={"end": 0.02, "step": 0.01})
    with Watched(comm, scene) as run:
        run.throw(toward_each_other(speed))
        run.run()
        x, lower = run.x, run.triangles[(run.triangles < 36).all(axis=1)]
        under = np.array([height_under(point, x[lower]) for point in x[36:]])
        assert np.isfinite(under).sum() > 10
        assert (x[36:, 2] > under).all()


@pytest.mark.parametrize("integrator", ["midpoint", "alpha2"])
def test_a_flat_sheet_hits_a_floor_with_100_m_per_s(comm: MPI.Comm, integrator: str) -> None:
    """All vertices at once; integrators whose stage is before the end fail, BDF2 does not."""
    scene = {
        "mesh": grid(0.4, 0.4, 4, 4) | {"transform": {"translate": [0.0, 0.0, 0.05]}},
        "material": CLOTH | {"bending": 1e-5, "damping": 0.01},
        "initial": {"velocity": [3.0, 0.0, -100.0]},
        "contact": {"gap": 0.0125},
        "obstacles": {"floor": {"plane": {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}}},
        "time": {"end": 0.02, "step": 0.005, "integrator": integrator},
    }
    with Watched(comm, scene) as run:
        before = run.simulation.budget.total
        run.run()
        assert (run.x[:, 2] > 0.0).all()
        assert run.simulation.budget.total <= before
        assert (
            "bdf2 takes the steps in which something touches, nears a limit or closes" in run.simulation.notes
        )


@pytest.mark.parallel(2)
@pytest.mark.parametrize("integrator", ["midpoint", "bdf2", "alpha2"])
def test_impacts_create_no_energy(comm: MPI.Comm, integrator: str) -> None:
    """Two sheets that are hit by a third one, without other forces or damping."""
    third = grid(0.3, 0.3, 3, 3) | {"transform": {"translate": [0.1, 0.05, 0.1]}}
    time = {"end": 0.08, "step": 0.002, "integrator": integrator}
    scene = {"mesh": [LOWER, UPPER, third], "material": MATERIAL | {"damping": 0.0}, "time": time}
    with Watched(comm, scene) as run:
        run.throw(lambda x: np.where(x[:, 2:] > 0.08, [0.3, 0.0, -4.0], 0.0))
        first, most = run.simulation.budget.total, 0.0

        def watch(simulation: SteppedScene) -> None:
            nonlocal most
            most = max(most, run.forces()[1])
            assert simulation.budget.total <= (1.0 + LARGEST_SUM) * first

        run.run(watch)
        assert most > 0.1


@pytest.mark.parallel
def test_forces_balance_at_boundaries_between_ranks(comm: MPI.Comm) -> None:
    """Triangles extend beyond the bounding box of a rank's own vertices."""
    upper = grid(0.2, 0.2, 4, 4) | {"transform": {"translate": [0.23, 0.21, 0.015]}}
    scene = {"mesh": [grid(0.9, 0.9, 2, 2), upper], "contact": {"gap": 0.02}}

    def at_first(on: MPI.Comm) -> tuple[int, Array]:
        with Watched(on, scene) as run:
            run.equations.reference.record_starts(0.0, run.equations.x)
            run.equations.begin_step(0.0, 0.01)
            x = run.equations.x
            total, largest = run.forces(x)
            assert largest > 0.1
            assert np.abs(total).max() <= 1e-12 * largest
            force = np.zeros((run.equations.points.n_local, 3))
            run.term.add_gradient(x, run.equations.step.frozen[run.term], force)
            own = force[: run.equations.points.n_owned]
            return on.allreduce(run.term.n_owned), gathered(run.equations.points, own)

    alone = comm.Split(comm.rank)
    count, force = at_first(alone)
    alone.Free()
    pairs, found = at_first(comm)
    assert pairs == count
    np.testing.assert_allclose(found, force, atol=1e-12 * np.abs(force).max())


SHEET = grid(0.4, 0.4, 4, 4, "alternating") | {"transform": {"translate": [-0.2, -0.2, 0.03]}}
OBSTACLES: dict[str, dict[str, Any]] = {
    "plane": {"plane": {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}},
    "tilted plane": {"plane": {"point": [0.0, 0.0, -0.06], "normal": [0.2, 0.1, 1.0]}},
    "sphere": {"sphere": {"center": [0.02, 0.01, -0.1], "radius": 0.1}},
    "capsule": {"capsule": {"from": [-0.3, 0.01, -0.05], "to": [0.3, 0.02, -0.05], "radius": 0.05}},
    "box": {"box": {"min": [-0.11, -0.12, -0.1], "max": [0.12, 0.11, 0.0]}},
    "inside of a box": {"box": {"min": [-0.25, -0.25, 0.0], "max": [0.25, 0.25, 1.0]}, "inside": True},
    "inside of a sphere": {"sphere": {"center": [0.0, 0.0, 0.3], "radius": 0.42}, "inside": True},
    "inside of a capsule": {
        "capsule": {"from": [-0.1, 0.0, 0.3], "to": [0.1, 0.0, 0.3], "radius": 0.38},
        "inside": True,
    },
}


def dropped(shape: str, **more: Any) -> dict[str, Any]:
    time = {"end": 0.24, "step": 0.01}
    return {"mesh": SHEET, "obstacles": {"it": OBSTACLES[shape]}, "time": time} | GRAVITY | more


@pytest.mark.parallel(2)
@pytest.mark.parametrize("shape", OBSTACLES)
def test_a_sheet_falls_on_an_obstacle(comm: MPI.Comm, shape: str) -> None:
    with Watched(comm, dropped(shape)) as run:
        most = 0.0

        def watch(simulation: SteppedScene) -> None:
            nonlocal most
            most = max(most, run.forces()[1])

        run.run(watch)
        assert most > 0.01
        assert run.x[:, 2].max() > -0.3


def test_a_sheet_falls_on_a_mesh(comm: MPI.Comm, shared_tmp: Path) -> None:
    """An open mesh with a sharp corner."""
    if comm.rank == 0:
        corners = [(-0.1, -0.1, -0.05), (0.12, -0.1, -0.05), (0.0, 0.13, -0.05), (0.01, 0.0, 0.01)]
        sides = [(0, 1, 3), (1, 2, 3), (2, 0, 3)]
        obj_file(shared_tmp / "spike.obj", corners, sides)
    comm.Barrier()
    obstacle = {"mesh": {"file": str(shared_tmp / "spike.obj")}}
    with Watched(comm, dropped("plane", obstacles={"spike": obstacle})) as run:
        run.run()
        assert run.x[:, 2].max() > -0.05


@pytest.mark.parametrize("gap", [1e-3, pytest.param(1e-5, marks=pytest.mark.parallel(1))])
def test_small_gaps_take_few_iterations(comm: MPI.Comm, gap: float) -> None:
    """A sheet that starts half a millimetre above a sphere, and touches it pair by pair."""
    mesh = SHEET | {"transform": {"translate": [-0.3, -0.29, 0.0005]}}
    ball = {"sphere": {"center": [0.0, 0.0, -0.25], "radius": 0.25}}
    scene = {"mesh": mesh, "contact": {"gap": gap}, "obstacles": {"it": ball}, "solver": {}}
    with Watched(comm, scene | GRAVITY | {"time": {"end": 0.1, "step": 0.005}}) as run:
        steps: list[int] = []
        while not run.simulation.finished:
            steps.append(run.simulation.step().newton_iterations)
            run.look()
        assert run.forces()[1] > 0.01
        assert np.median(steps) <= 12


def test_a_plane_carries_the_weight_at_rest(comm: MPI.Comm) -> None:
    """In a static analysis."""
    with Watched(comm, dropped("plane", time={"analysis": "static", "step": 1.0})) as run:
        run.run()
        total, _ = run.forces(run.equations.x)
        weight = 9.81 * comm.allreduce(float(run.equations.mass.sum()))
        np.testing.assert_allclose(total, [0.0, 0.0, weight], atol=1e-6 * weight)
        left = run.x[:, 2]
        assert 0.0 < left.min() <= left.max() < CONTACT["gap"]


@pytest.mark.parallel(2)
@pytest.mark.parametrize("integrator", ["beuler", "midpoint"])
@pytest.mark.parametrize("shape", ["plane", "sphere", "box"])
def test_moving_obstacles_carry_the_sheet(comm: MPI.Comm, shape: str, integrator: str) -> None:
    """Upwards at 1 m/s, while they turn."""
    motion = [
        {"time": 0.0},
        {"time": 0.1, "translate": [0.0, 0.0, 0.1], "rotate": {"axis": [0.0, 1.0, 0.0], "degrees": 10.0}},
    ]
    obstacle = OBSTACLES[shape] | {"motion": motion, "interpolation": "linear"}
    time = {"end": 0.06, "step": 0.004, "integrator": integrator}
    with Watched(comm, dropped("plane", obstacles={"it": obstacle}, time=time)) as run:
        run.run()
        assert run.x[:, 2].max() > 0.04


@pytest.mark.parametrize("speed", [10.0, 100.0])
def test_a_sheet_pulled_against_another_never_crosses_it(comm: MPI.Comm, speed: float) -> None:
    """Handles pull a sheet against one with held corners."""
    held = grid(0.6, 0.6, 4, 4) | {"transform": {"translate": [-0.3, -0.3, 0.0]}}
    pulled = grid(0.2, 0.2, 2, 2) | {"transform": {"translate": [-0.1, -0.1, 0.05]}}
    end = 0.2 / speed
    scene = {
        "mesh": [held, pulled],
        "handles": [
            {"box": [[-1.0, -1.0, -0.01], [-0.29, 1.0, 0.01]]},
            {"box": [[0.29, -1.0, -0.01], [1.0, 1.0, 0.01]]},
            {"box": [[-0.11, -0.11, 0.04], [-0.09, 0.11, 0.06]], "motion": "down"},
        ],
        "motions": {"down": [{"time": 0.0}, {"time": end, "translate": [0.0, 0.0, -0.2]}]},
        "time": {"end": end, "step": end / 8},
    }
    with Watched(comm, scene) as run:
        try:
            run.run()
        except SolverError as error:
            assert "pass through" in str(error)  # noqa: PT017
            run.look()
        else:
            assert run.x[25:, 2].min() == pytest.approx(-0.15, abs=1e-6)


@pytest.mark.parametrize("handled", [True, False])
def test_common_motions_of_many_gaps_per_step_are_free(comm: MPI.Comm, handled: bool) -> None:
    """A handle moves by ten gaps in a step; a plate moves with a sheet that flies in front of it."""
    up = {"rise": [{"time": 0.0}, {"time": 0.1, "translate": [0.0, 0.0, 2.0]}]}
    moving = {"motions": up, "time": {"end": 0.1, "step": 0.01}}
    plate = {"box": {"min": [-1.0, -1.0, -0.2], "max": [2.0, 2.0, -0.01]}, "motion": "rise"}
    more = {"handles": [{"group": "left", "motion": "rise"}]} if handled else {"obstacles": {"it": plate}}
    with Watched(comm, {"mesh": LOWER} | moving | more) as run:
        if not handled:
            run.throw(lambda x: np.broadcast_to([0.0, 0.0, 22.0], x.shape))
        for _ in range(4):
            assert run.simulation.step().rejected == 0
            run.look()
        assert run.x[:, 2].max() > 0.2


def turned(mesh: dict[str, Any], degrees: float, place: list[float]) -> dict[str, Any]:
    turn = {"axis": [1.0, 0.0, 0.0], "degrees": degrees}
    return mesh | {"transform": {"rotate": turn, "translate": place}}


STRIP = grid(0.4, 0.02, 12, 1, "alternating")
CORNERS = {"handles": [{"nodes": [0, 5, 24, 29]}]}
DIRECTORS = MATERIAL | {"bending": 1e-3, "bending_model": "midedge"}
WALL = {"w": {"mesh": {"file": "wall.obj"}}}
SPIN = [{"time": 0.0}, {"time": 0.1, "rotate": {"axis": [1.0, 0.0, 0.0], "degrees": 400.0}}]
HOSTILE: dict[str, dict[str, Any]] = {
    "a strip edge-on": {
        "mesh": [LOWER, turned(STRIP, 90.0, [0.05, 0.2, 0.04])],
        "contact": {"gap": 0.008},
        **CORNERS,
    },
    "a strip edge-on an open mesh": {
        "mesh": turned(STRIP, 90.0, [-0.2, 0.01, 0.04]),
        "contact": {"gap": 0.008},
        "obstacles": WALL,
    },
    "an open mesh that spins": {
        "mesh": turned(grid(0.4, 0.4, 5, 5), 0.0, [-0.2, -0.2, 0.02]),
        "obstacles": {"w": WALL["w"] | {"motion": SPIN}},
    },
    "cells unlike each other": {
        "mesh": [LOWER, turned(grid(0.1, 0.1, 12, 12), 10.0, [0.2, 0.1, 0.04])],
        "contact": {"gap": 0.004, "thickness": 0.001, "friction": 0.3},
        **CORNERS,
    },
    "directors and thickness": {
        "mesh": [LOWER, turned(UPPER, 20.0, [0.05, 0.05, 0.05])],
        "material": DIRECTORS,
        "contact": {"gap": 0.01, "thickness": 0.01, "friction": 0.3},
        **CORNERS,
    },
    "a plane of symmetry": {
        "mesh": turned(LOWER, 0.0, [-0.2, 0.0, 0.02]),
        "material": DIRECTORS,
        "handles": [{"group": "left", "symmetry": "x"}],
        "obstacles": {"ball": {"sphere": {"center": [-0.2, 0.2, -0.2], "radius": 0.2}}},
    },
}
"""Scenes with edge-on strips and sharp or spinning obstacles; sheets are thrown downwards."""


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.parallel(1)) if "material" in scene else name
        for name, scene in HOSTILE.items()
    ],
)
def test_nothing_crosses_with(comm: MPI.Comm, name: str, shared_tmp: Path) -> None:
    if comm.rank == 0:
        corners = [(-0.5, 0.0, 0.0), (0.5, 0.013, 0.0), (0.5, 0.0, -0.3), (-0.5, 0.0, -0.3)]
        obj_file(shared_tmp / "wall.obj", corners, [(0, 1, 2), (0, 2, 3)])
    comm.Barrier()
    scene = {"solver": {}, "time": {"end": 0.06, "step": 0.004}} | GRAVITY | HOSTILE[name]
    if "w" in scene.get("obstacles", {}):
        wall = scene["obstacles"]["w"] | {"mesh": {"file": str(shared_tmp / "wall.obj")}}
        scene |= {"obstacles": {"w": wall}}
    most = 0.0
    with Watched(comm, scene) as run:
        run.throw(lambda x: np.where(x[:, 2:] > 1e-9, [0.0, 0.0, -3.0], 0.0))

        def watch(simulation: SteppedScene) -> None:
            nonlocal most
            most = max(most, run.forces()[1])

        run.run(watch)
    assert most > 0.01
