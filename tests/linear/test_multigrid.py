"""Geometric multigrid: iterations for various meshes, ranks and stiffness."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from physics import shape, stepped

from lyra_petsc.errors import InputError
from lyra_petsc.linear import presets
from lyra_petsc.linear.presets import PYTHON_TYPE
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.schema import Scene

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.parallel(3)


def hanging(cells: int, **time: Any) -> dict[str, Any]:
    """A square of gray interlock, held at two corners and falling."""
    corners = [cells * (cells + 1), (cells + 1) ** 2 - 1]
    return {
        "mesh": {"grid": {"width": 1.0, "height": 1.0, "nx": cells, "ny": cells}},
        "material": {"cloth": "gray-interlock", "damping": 0.03},
        "gravity": [0, 0, -9.81],
        "handles": [{"nodes": corners}],
        "time": {"end": 1.0, "step": 0.005, "integrator": "semi-implicit"} | time,
    }


def iterated(
    comm: MPI.Comm, content: dict[str, Any], steps: int, pc_type: str, **petsc: Any
) -> tuple[np.ndarray, list[int]]:
    """Positions in mesh order, and linear iterations of each step, or their mean over attempts."""
    with stepped(comm, Scene.model_validate(content), pc_type=pc_type, **petsc) as simulation:
        reports = [simulation.step() for _ in range(steps)]
        return shape(simulation), [r.linear_iterations // (1 + r.rejected) for r in reports]


def test_iterations_hardly_grow_with_the_mesh(comm: MPI.Comm) -> None:
    coarse, fine = (max(iterated(comm, hanging(cells), 3, "mg")[1]) for cells in (25, 75))
    assert 3 <= coarse <= 9
    assert fine <= 1.5 * coarse + 1


@pytest.mark.parallel(2)
@pytest.mark.parametrize(("scheme", "clamped"), [("semi-implicit", False), ("beuler", True)])
def test_unknowns_on_edges_take_few_iterations(scheme: str, clamped: bool, comm: MPI.Comm) -> None:
    """Coarse levels have none: directors must follow the vertices, or bending is too stiff there."""
    counts = []
    for model in ("hinge", "midedge"):
        content = hanging(75, integrator=scheme)
        content["material"] |= {"bending_model": model, "bending_scale": 100.0}
        if clamped:
            content["handles"] = [{"box": [[-1, -1, -1], [0.001, 2, 1]], "clamp": True}]
        counts.append(max(iterated(comm, content, 2, "python")[1]))
    assert counts[1] <= 1.4 * counts[0] + 1


@pytest.mark.parallel(2)
def test_stiff_cloth_and_long_steps(comm: MPI.Comm) -> None:
    content = hanging(50, step=0.04)
    content["material"]["stretching_scale"] = 1000.0
    assert max(iterated(comm, content, 3, "mg")[1]) <= 30


@pytest.mark.parametrize("kind", ["python", "mg"])  # both select the program's cycle
def test_the_solution_is_that_of_a_direct_solver(kind: str, comm: MPI.Comm) -> None:
    tight = {"ksp_rtol": 1e-11}
    x, _ = iterated(comm, hanging(25), 5, kind, **tight)
    direct, _ = iterated(comm, hanging(25), 5, "cholesky", **tight)
    assert np.abs(x - direct).max() < 1e-10


def test_newton_with_an_exact_hessian(comm: MPI.Comm) -> None:
    x, counts = iterated(comm, hanging(25, integrator="beuler"), 4, "mg")
    other, _ = iterated(comm, hanging(25, integrator="beuler"), 4, "pbjacobi")
    assert max(counts) < 40
    assert np.abs(x - other).max() < 1e-6


def test_handles_that_are_released(comm: MPI.Comm) -> None:
    content = hanging(25)
    content["handles"][0]["until"] = 0.015
    x, counts = iterated(comm, content, 8, "mg")
    direct, _ = iterated(comm, content, 8, "cholesky")
    assert max(counts) <= 10
    assert np.abs(x - direct).max() < 1e-6


@pytest.mark.parallel(2)
@pytest.mark.parametrize(
    "options",
    [
        {"pc_mg_levels": 1},
        {"pc_mg_levels": 50},
        {"pc_mg_w_from": 1},
        {"mat_type": "aij"},
        {"mg_coarse_pc_type": "svd"},
    ],
    ids=lambda options: " ".join(options),
)
def test_options_are_used(options: dict[str, Any], comm: MPI.Comm) -> None:
    if comm.size > 1 and "mg_coarse_pc_type" in options:
        options = {"mg_coarse_redundant_pc_type": "svd"}
    _, counts = iterated(comm, hanging(25), 2, "mg", **options)
    assert 0 < max(counts) < 20


@pytest.mark.parallel(2)
def test_levels_visited_twice(comm: MPI.Comm) -> None:
    content = hanging(75)
    content["material"] |= {"stretching_scale": 1000.0, "bending_scale": 1000.0}
    once, counts = iterated(comm, content, 3, "python")
    twice, fewer = iterated(comm, content, 3, "python", pc_mg_w_from=1)
    assert max(fewer) < max(counts)
    assert np.abs(once - twice).max() < 1e-6


def test_sweeps_over_the_vertices_where_edges_carry_unknowns(
    comm: MPI.Comm, capfd: pytest.CaptureFixture[str]
) -> None:
    content = hanging(40)
    content["material"]["bending_model"] = "midedge"
    content["material"]["bending_scale"] = 1000.0
    once, counts = iterated(comm, content, 3, "python", pc_mg_vertex_sweeps=1)
    assert "3 of each" not in capfd.readouterr().out
    often, fewer = iterated(comm, content, 3, "python", ksp_view="")
    assert sum(fewer) < 0.8 * sum(counts)
    assert np.abs(once - often).max() < 1e-6
    if comm.rank == 0:
        assert "  3 of each" in capfd.readouterr().out


@pytest.mark.parametrize(("bending", "sweeps"), [(1.0, 1), (5e3, 2)])
def test_stiffer_bending_takes_more_sweeps(
    comm: MPI.Comm, capfd: pytest.CaptureFixture[str], bending: float, sweeps: int
) -> None:
    content = hanging(12)
    content["material"] |= {"bending_model": "midedge", "bending_scale": bending}
    iterated(comm, content, 1, "python", ksp_view="")
    if comm.rank == 0:
        output = capfd.readouterr().out
        assert [number for number in (2, 3) if f"  {number} of each" in output] == [sweeps] * (sweeps > 1)


def test_a_python_preconditioner_of_the_user_is_kept(comm: MPI.Comm) -> None:
    own = {"pc_python_type": f"{__name__}.Scaling"}
    x, counts = iterated(comm, hanging(8), 2, "python", **own)
    direct, _ = iterated(comm, hanging(8), 2, "cholesky")
    assert max(counts) > 20
    assert np.abs(x - direct).max() < 1e-6


def test_it_is_refused_as_part_of_another_preconditioner(comm: MPI.Comm) -> None:
    with pytest.raises(InputError, match="main preconditioner only") as caught:
        iterated(comm, hanging(8), 1, "bjacobi", sub_pc_type="python", sub_pc_python_type=PYTHON_TYPE)
    assert caught.value.key == "-sub_pc_python_type"


@pytest.mark.parallel
def test_iterations_do_not_depend_on_the_ranks(comm: MPI.Comm) -> None:
    _, counts = iterated(comm, hanging(50), 3, "python")
    alone = comm.Split(comm.rank, 0)
    _, serial = iterated(alone, hanging(50), 3, "python")
    alone.Free()
    # but for sweeps, which see the values of other ranks later
    assert max(counts) <= max(serial) + 2


@pytest.mark.parallel
@pytest.mark.parametrize("model", ["hinge", "midedge"])
@pytest.mark.parametrize("pattern", ["diagonal", "criss-cross"])
def test_the_cycle_is_positive_definite(pattern: str, model: str, comm: MPI.Comm) -> None:
    """On ranks with scattered points; sweeps alone have an eigenvalue of −0.7 on three of them."""
    content = hanging(12, step=0.04)
    content["mesh"]["grid"] |= {"ny": 1, "height": 1.0 / 12.0, "pattern": pattern}
    content["handles"] = [{"nodes": [0]}]
    content["material"] |= {"bending_scale": 1000.0, "bending_model": model}
    given = {"pc_type": "python", "mat_partitioning_type": "average"}
    with stepped(comm, Scene.model_validate(content), **given) as simulation:
        simulation.step()
        pc = simulation.stepper.solver.snes.getKSP().getPC()
        b, x = pc.getOperators()[0].createVecs()
        columns = []
        for unknown in range(b.getSize()):
            b.zeroEntries()
            if comm.rank == 0:
                b.setValue(unknown, 1.0)
            b.assemble()
            pc.apply(b, x)
            columns.append(np.concatenate(comm.allgather(x.getArray())))
        cycle = np.array(columns)
    assert np.abs(cycle - cycle.T).max() < 1e-5 * np.abs(cycle).max()
    assert np.linalg.eigvalsh(cycle)[0] > 0.0


class Scaling:
    """A user's preconditioner: the identity."""

    def apply(self, pc: PETSc.PC, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """x = b."""
        b.copy(x)


def test_unbounded_sweeps_count_as_negative_curvature(
    comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the sixth step the exact Hessian, tried as its own preconditioner, is indefinite."""
    monkeypatch.setattr(presets, "TWICE_FROM", 30.0)
    settings = ("time.integrator=alpha2", "time.step=0.01")
    with stepped(comm, load_scene(ROOT / "configs" / "swing.yaml", settings)) as simulation:
        for _ in range(7):
            simulation.step()
        assert simulation.stepper.preset == "multigrid-w"
        assert not simulation.notes
