"""Contact does not depend on the number of ranks, which share its work."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from physics import (
    Simulation,
    direct_solver,
    gathered,
    grid,
    mirrored,
    obj_file,
    scene_of,
    symmetry_planes,
)

from lyra_petsc.contact.barrier import ContactBarrier
from lyra_petsc.stepping.energy_balance import EnergyBalance
from lyra_petsc.stepping.simulation import SteppedScene

Array = NDArray[np.float64]

pytestmark = pytest.mark.parallel

SQUARE = grid(0.1, 0.1, 1, 1)
"""Two triangles, four vertices."""

FLOOR = {"plane": {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}}


TURNED = {"rotate": {"axis": [0.3, 1.0, 0.5], "degrees": 20.0}}


def on(value: Any, *ranks: int) -> Any:
    """A test's parameter that is run on ``ranks`` ranks and compared with one."""
    return pytest.param(value, marks=pytest.mark.parallel(*ranks, alone=False))


def falling(above: float) -> dict[str, Any]:
    return {
        "mesh": [
            SQUARE | {"transform": {"translate": [0, 0, 0.02]}},
            SQUARE | {"transform": {"translate": [0.01, 0.02, 0.02 + above]}},
        ],
        "gravity": [0, 0, -9.81],
        "contact": {"gap": 0.01},
        "obstacles": {
            "floor": FLOOR,
            "ball": {"sphere": {"center": [0.05, 0.05, -0.03], "radius": 0.04}},
        },
        "time": {"end": 1.0, "step": 0.004},
    }


@pytest.mark.parallel(alone=False)
def test_small_sheets_on_any_number_of_ranks(comm: MPI.Comm) -> None:
    results = []
    for ranks in (MPI.COMM_SELF, comm):
        with Simulation(falling(0.02), ranks) as simulation:
            results.append(simulation.run(0.004, 20))
            assert simulation.energy("contact") > 0.0
    heights = results[0][:, 2]
    assert heights.min() > 0.0
    assert heights[4:].max() - heights[:4].max() < 0.015  # the upper one has come near the lower one
    np.testing.assert_allclose(results[1], results[0], atol=1e-10)


def two_sheets(folder: Path) -> dict[str, Any]:
    """A rotated sheet falls on another one that is held by two of its edges."""
    turned = TURNED | {"translate": [0.05, 0.05, 0.08]}
    return {
        "mesh": [grid(0.3, 0.3, 6, 6), grid(0.2, 0.2, 5, 5) | {"transform": turned}],
        "handles": [{"nodes": [row * 7 for row in range(7)]}, {"nodes": [row * 7 + 6 for row in range(7)]}],
        "initial": {"velocity": [0.0, 0.0, -1.0]},
        "contact": {"friction": 0.3},
    }


def tent(folder: Path) -> dict[str, Any]:
    """A sheet falls on an open pyramid of four triangles."""
    corners = [(-0.1, -0.1, 0.0), (0.1, -0.1, 0.0), (0.1, 0.1, 0.0), (-0.1, 0.1, 0.0), (0.01, 0.0, 0.06)]
    sides = [(0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)]
    return {
        "mesh": grid(0.24, 0.24, 8, 8) | {"transform": {"translate": [-0.12, -0.12, 0.08]}},
        "contact": {"friction": 0.3},
        "obstacles": {"tent": {"mesh": obj_file(folder / "tent.obj", corners, sides)}},
    }


def roll(folder: Path) -> dict[str, Any]:
    """A strip, rolled up twice, falls on the floor and collapses on itself."""
    angles, wide = np.linspace(0.0, 4.0 * np.pi, 33), 4
    radius = 0.05 + 0.016 * angles / (2.0 * np.pi)
    spiral = np.column_stack([radius * np.cos(angles), radius * np.sin(angles) + 0.087])
    rows = [(a, 0.02 * j, b) for a, b in spiral for j in range(wide)]
    cells = [wide * i + j for i in range(len(spiral) - 1) for j in range(wide - 1)]
    triangles = [(c, c + 1, c + wide) for c in cells] + [(c + 1, c + wide + 1, c + wide) for c in cells]
    return {
        "mesh": obj_file(folder / "roll.obj", rows, triangles),
        "contact": {"friction": 0.3, "gap": 0.004},
        "obstacles": {"floor": FLOOR},
    }


def quarter(folder: Path) -> dict[str, Any]:
    """A quarter of a sheet with two symmetry planes falls on a ball and buckles."""
    mesh, _ = mirrored(folder / "quarter.obj", "", 14, lambda flat: 0.004 + 0.0 * flat[:, 0], 0.3)
    return {
        "mesh": mesh,
        "material": {"young": 1e6, "poisson": 0.3, "thickness": 5e-4, "density": 0.2, "damping": 0.002},
        "handles": symmetry_planes("xy"),
        "contact": {"friction": 0.3},
        "obstacles": {"ball": {"sphere": {"center": [0.0, 0.0, -0.2], "radius": 0.2}}},
    }


STEPS = 30


@pytest.mark.parametrize("scene", [on(two_sheets), on(tent, 2), on(roll, 3), on(quarter, 3)])
def test_ranks_agree(comm: MPI.Comm, shared_tmp: Path, scene: Any) -> None:
    common = {"gravity": [0.0, 0.0, -9.81], "material": {"cloth": "gray-interlock", "damping": 0.01}}
    content = common | {"time": {"end": 1.0, "step": 0.004}}
    (folder := shared_tmp / str(comm.rank)).mkdir()
    content |= scene(folder)
    results: list[list[Array]] = []
    for ranks in (MPI.COMM_SELF, comm):
        for name, value in (direct_solver(ranks) | {"ksp_rtol": "1e-12"}).items():
            PETSc.Options().setValue(name, value)
        simulation = SteppedScene(ranks, scene_of(content))
        size, contacts = simulation.problem.whole.size, 0.0
        results.append([])
        for step in range(1, STEPS + 1):
            simulation.step()
            contacts = max(contacts, simulation.energy_balance.columns()["contacts"])
            if step in (20, STEPS):
                results[-1].append(gathered(simulation.problem.points, simulation.problem.equations.x))
        assert contacts > 10.0
        simulation.destroy()
    for alone, together, tolerance in zip(*results, (1e-8, 1e-6), strict=True):
        np.testing.assert_allclose(together, alone, rtol=0.0, atol=tolerance * size)


def positions_after(comm: MPI.Comm, content: dict[str, Any], steps: int) -> tuple[Array, float, float]:
    """Positions (V, 3) in mesh order, the size of the mesh [m], and the most contacts after a step."""
    simulation, contacts = SteppedScene(comm, scene_of(content)), 0.0
    for _ in range(steps):
        simulation.step()
        contacts = max(contacts, simulation.energy_balance.columns()["contacts"])
    x, size = (
        gathered(simulation.problem.points, simulation.problem.equations.x),
        simulation.problem.whole.size,
    )
    simulation.destroy()
    return x, size, contacts


@pytest.mark.parametrize("integrator", [on("semi-implicit", 2), on("beuler"), on("bdf2", 3)])
def test_ranks_agree_with_the_default_solver(comm: MPI.Comm, integrator: str) -> None:
    """An impact magnifies the error that a step leaves, which depends on the number of ranks."""
    content = {
        "mesh": grid(0.5, 0.5, 12, 12) | {"transform": TURNED | {"translate": [-0.25, -0.25, 0.35]}},
        "gravity": [0.0, 0.0, -9.81],
        "material": {"cloth": "gray-interlock", "damping": 0.01},
        "initial": {"velocity": [0.0, 0.0, -10.0]},
        "contact": {"friction": 0.3},
        "obstacles": {"ball": {"sphere": {"center": [0.0, 0.0, 0.1], "radius": 0.15}}},
        "time": {"end": 1.0, "step": 0.004, "integrator": integrator},
        "solver": {},
    }
    (alone, size, contacts), (together, *_) = (
        positions_after(ranks, content, 20) for ranks in (MPI.COMM_SELF, comm)
    )
    assert contacts > 10.0
    np.testing.assert_allclose(together, alone, rtol=0.0, atol=1e-8 * size)


@pytest.mark.parallel(alone=False)
def test_ranks_agree_on_a_table(comm: MPI.Comm) -> None:
    """Errors of a step's last linear solve are magnified after the cloth has met the table's edges."""
    content = {
        "mesh": grid(1.2, 1.2, 32, 32, "alternating") | {"transform": {"translate": [-0.6, -0.6, 0.02]}},
        "gravity": [0.0, 0.0, -9.81],
        "material": {"cloth": "gray-interlock", "damping": 0.02},
        "contact": {"friction": 0.3},
        "obstacles": {"table": {"box": {"min": [-0.4, -0.4, -0.05], "max": [0.4, 0.4, 0.0]}}},
        "time": {"end": 1.0, "step": 0.005},
        "solver": {},
    }
    (alone, size, _), (together, *_) = (
        positions_after(ranks, content, 35) for ranks in (MPI.COMM_SELF, comm)
    )
    np.testing.assert_allclose(together, alone, rtol=0.0, atol=1e-7 * size)


def test_ranks_agree_where_sheets_collide(comm: MPI.Comm) -> None:
    """Sheets buckle in one of many ways.

    Errors of the preconditioner in the first Newton increments, which depend on the ranks, must not decide in
    which.
    """
    turned = TURNED | {"translate": [-0.05, 0.03, 0.06 + 0.14435478835021417]}
    content = {
        "mesh": [grid(0.5, 0.5, 12, 12), grid(0.5, 0.5, 12, 12) | {"transform": turned}],
        "gravity": [0.0, 0.0, -9.81],
        "material": {"cloth": "gray-interlock", "damping": 0.01},
        "contact": {"friction": 0.3},
        "time": {"end": 1.0, "step": 0.005},
        "solver": {},
    }
    blocks = {"pc_type": "bjacobi", "pc_bjacobi_local_blocks": "3", "sub_pc_type": "ilu"}
    results, contacts = [], 0.0
    for ranks, options in ((MPI.COMM_SELF, {}), (comm, blocks)):
        for name, value in options.items():
            PETSc.Options().setValue(name, value)
        simulation = SteppedScene(ranks, scene_of(content))
        equations, points = simulation.problem.equations, simulation.problem.points
        n, v = points.n_owned, equations.v[: points.n_owned].copy()
        v[:, 2] = np.where(points.mesh_vertices < 13 * 13, 10.0, -10.0)
        equations.state.set(equations.x[:n], v)
        simulation.stepper.start(0.0, 0)
        simulation.energy_balance = EnergyBalance(equations)
        for _ in range(3):
            simulation.step()
            contacts = max(contacts, simulation.energy_balance.columns()["contacts"])
        size = simulation.problem.whole.size
        results.append(gathered(simulation.problem.points, equations.x))
        simulation.destroy()
    assert contacts > 10.0
    np.testing.assert_allclose(results[1], results[0], rtol=0.0, atol=1e-8 * size)


def test_ranks_share_the_pairs_of_a_stack(comm: MPI.Comm) -> None:
    one, gap = grid(1.0, 1.0, 12, 12), 0.02
    content = {
        "mesh": [one | {"transform": {"translate": [0.0, 0.0, 0.9 * gap * (n + 1)]}} for n in range(4)],
        "contact": {"gap": gap},
        "obstacles": {"floor": FLOOR},
    }
    with Simulation(content, comm) as simulation:
        contact = simulation.problem.terms["contact"]
        assert isinstance(contact, ContactBarrier)
        work = np.array(comm.allgather(contact.n_elements))
        whole = comm.allreduce(contact.n_owned)
        # cuts, 13 vertices long, are to a rank's part of a sheet as √ranks
        assert work.max() < (1.0 + 0.26 * comm.size**0.5) * whole / comm.size
