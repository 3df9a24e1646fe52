"""Seams in multigrid: iterations as of the unsewn sheet."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import shape, stepped

from lyra_petsc.linear.coarsening import coarsen
from lyra_petsc.linear.tied_vertices import TiedVertices
from lyra_petsc.mesh.build import grid_sheet
from lyra_petsc.scene.schema import Grid, Scene

pytestmark = pytest.mark.parallel(3)


def hanging(cells: int, *parts: int, gap: float = 0.0, **material: Any) -> dict[str, Any]:
    """A square of gray interlock, whole or of ``parts`` of different numbers of cells, sewn side by side."""
    n = max(len(parts), 1)
    sheets: list[dict[str, Any]] = []
    for number, fine in enumerate(parts or (cells,)):
        grid = {"width": 1.0 / n, "height": 1.0, "nx": -(-fine // n), "ny": fine}
        place = [number * (1.0 / n + gap), 0.0, 0.0]
        sheets.append({"grid": grid, "name": f"part{number}", "transform": {"translate": place}})
    seams = [{"between": [f"part{k}/right", f"part{k + 1}/left"]} for k in range(n - 1)]
    corners = [[[x - 1e-3, 0.999, -1.0], [x + 1e-3, 1.001, 1.0]] for x in (0.0, 1.0 + (n - 1) * gap)]
    return {
        "mesh": sheets,
        "seams": seams,
        "material": {"cloth": "gray-interlock"} | material,
        "gravity": [0, 0, -9.81],
        "handles": [{"box": corner} for corner in corners],
        "time": {"end": 1.0, "step": 0.01},
    }


def iterated(comm: MPI.Comm, content: dict[str, Any], steps: int, **petsc: Any) -> tuple[float, str]:
    """Linear iterations per Newton iteration, and the linear solver."""
    with stepped(comm, Scene.model_validate(content), **petsc) as simulation:
        reports = [simulation.step() for _ in range(steps)]
        linear, newton = (
            sum(getattr(report, f"{kind}_iterations") for report in reports) for kind in ("linear", "newton")
        )
        return linear / newton, simulation.stepper.preset


@pytest.mark.parametrize("model", ["hinge", "midedge"])
def test_iterations_are_those_of_the_unsewn_sheet(model: str, comm: MPI.Comm) -> None:
    """Ten thousand vertices and the solver that the program takes; plain multigrid needs 300."""
    unsewn, solver = iterated(comm, hanging(100, bending_model=model), 3)
    sewn, same = iterated(comm, hanging(100, 100, 88, bending_model=model), 3)
    assert solver == same == "multigrid"
    assert sewn <= 1.2 * unsewn


@pytest.mark.parallel(2)
@pytest.mark.parametrize("parts", [(50, 44), (48, 30), (51, 47, 50)], ids=str)
@pytest.mark.parametrize(
    "material", [{}, {"bending_scale": 100.0}, {"stretching_scale": 100.0}], ids=["", "thick", "stiff"]
)
def test_iterations_of_other_seams_and_sheets(
    parts: tuple[int, ...], material: dict[str, Any], comm: MPI.Comm
) -> None:
    unsewn, _ = iterated(comm, hanging(50, **material), 3, pc_type="mg")
    sewn, _ = iterated(comm, hanging(50, *parts, **material), 3, pc_type="mg")
    assert sewn <= 1.2 * unsewn


def test_springs_between_all_vertices_of_equal_sides(comm: MPI.Comm) -> None:
    """Far stiffer than rigid seams; without time to close, these would be one sheet."""
    content = hanging(50, 50, 50)
    content["seams"][0]["stiffness"] = 1e7
    unsewn, _ = iterated(comm, hanging(50), 3, pc_type="mg")
    sewn, _ = iterated(comm, content, 3, pc_type="mg")
    assert sewn <= 1.2 * unsewn


@pytest.mark.parallel(1)
def test_soft_seams_are_left_to_the_sweeps(comm: MPI.Comm) -> None:
    unsewn, _ = iterated(comm, hanging(50), 3, pc_type="mg")
    for stiffness in (1.0, 50.0, 1e3, 1e5):
        content = hanging(50, 50, 44)
        content["seams"][0]["stiffness"] = stiffness
        sewn, _ = iterated(comm, content, 3, pc_type="mg")
        assert sewn <= 1.3 * unsewn, stiffness


@pytest.mark.parallel(2)
def test_seams_that_close_take_more_but_not_many(comm: MPI.Comm) -> None:
    content = hanging(50, 50, 44, gap=0.02)
    content["seams"][0]["close"] = {"until": 0.2}
    closing, _ = iterated(comm, content, 6, pc_type="mg")
    assert closing < 30.0  # 130 if multigrid does not know the seam


@pytest.mark.parallel(2)
def test_four_sheets_that_meet_in_a_point(comm: MPI.Comm) -> None:
    content = hanging(60)
    content["mesh"] = []
    for number, (name, cells) in enumerate(zip("abcd", (30, 27, 25, 31), strict=True)):
        grid = {"width": 0.5, "height": 0.5, "nx": cells, "ny": cells}
        place = [0.5 * (number % 2), 0.5 * (number // 2), 0.0]
        content["mesh"].append({"grid": grid, "name": name, "transform": {"translate": place}})
    pairs = ("a/right", "b/left"), ("c/right", "d/left"), ("a/top", "c/bottom"), ("b/top", "d/bottom")
    content["seams"] = [{"between": list(pair)} for pair in pairs]
    unsewn, _ = iterated(comm, hanging(60), 3, pc_type="mg")
    sewn, _ = iterated(comm, content, 3, pc_type="mg")
    assert sewn <= 1.2 * unsewn


@pytest.mark.parametrize("model", ["hinge", "midedge"])
def test_the_solution_is_that_of_a_direct_solver(model: str, comm: MPI.Comm) -> None:
    shapes = []
    for kind in ("mg", "cholesky"):
        content = hanging(25, 25, 22, bending_model=model)
        content["solver"] = {"force_tolerance": 1e-9, "step_tolerance": 1e-9}
        with stepped(comm, Scene.model_validate(content), pc_type=kind) as simulation:
            for _ in range(3):
                simulation.step()
            shapes.append(shape(simulation))
    assert np.abs(shapes[0] - shapes[1]).max() < 1e-8


@pytest.mark.parallel
def test_iterations_do_not_depend_on_the_ranks(comm: MPI.Comm) -> None:
    content = hanging(50, 50, 44)
    several, _ = iterated(comm, content, 3, pc_type="mg")
    alone = comm.Split(comm.rank, 0)
    serial, _ = iterated(alone, content, 3, pc_type="mg")
    alone.Free()
    assert abs(several - serial) <= 1.0


@pytest.mark.parallel(1)
def test_small_sewn_sheets_begin_with_multigrid_too(comm: MPI.Comm) -> None:
    """Incomplete factors take eight times the iterations of the unsewn sheet."""
    sewn, solver = iterated(comm, hanging(16, 16, 12), 3)
    assert solver == "multigrid"
    assert sewn < 4.0


@pytest.mark.parallel(1)
def test_the_interpolations_keep_all_ties_shut() -> None:
    """Chains and rings of ties, of which one is redundant, on a grid."""
    sheet = grid_sheet(Grid(width=1, height=1, nx=12, ny=12, pattern="diagonal"))
    ties = [
        {0: 1.0, 7: -1.0},
        {7: 1.0, 14: -0.4, 20: -0.6},
        {30: 1.0, 90: -1.0},
        {90: 1.0, 140: -1.0},
        {30: 1.0, 140: -1.0},
    ]
    tied = TiedVertices(169, ties)
    assert len(tied.free) == 165
    coarse = coarsen(sheet.points, sheet.triangles)
    on_coarse = tied.coarse(coarse)
    for n_free, rows, n in (
        (165, tied.rows, 169),
        (len(on_coarse.free), on_coarse.rows, len(coarse.vertices)),
        (len(on_coarse.free), on_coarse.after(coarse), 169),
    ):
        assert len(rows.start) == n + 1
        values = np.random.default_rng(1).normal(size=n_free)
        fine = np.add.reduceat(rows.weights * values[rows.parents], rows.start[:-1])
        sums = np.add.reduceat(rows.weights, rows.start[:-1])
        assert np.abs(sums - 1.0).max() < 1e-12
        if n == 169 and n_free == 165:
            for tie in ties:
                assert abs(sum(factor * fine[vertex] for vertex, factor in tie.items())) < 1e-12
