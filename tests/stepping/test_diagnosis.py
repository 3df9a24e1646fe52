"""Diagnosis of a failed step, the same on any number of ranks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, direct_solver, gathered, grid, stepped

from lyra_petsc.arrays import Array
from lyra_petsc.errors import SolverError
from lyra_petsc.stepping.failure.failure_report import Failure
from lyra_petsc.stepping.simulation import SteppedScene
from lyra_petsc.stepping.statics import equilibrium
from lyra_petsc.stepping.time_step import Evaluation

pytestmark = pytest.mark.parallel(2)

Spoil = Callable[[SteppedScene, Array], None]

SCENE: dict[str, Any] = {
    "mesh": grid(0.6, 0.4, 5, 4, "alternating"),
    "material": CLOTH | {"bending": 1e-4},
    "gravity": [0, 0, -9.81],
    "handles": [{"nodes": [0, 5]}],
    "time": {"end": 1.0, "step": 0.01},
}
STIFF = CLOTH | {"membrane": {"c11": 1.2e6, "c22": 1.2e6, "c12": 0.0, "c33": 6e5}, "bending": 1e-4}
ONE_ATTEMPT = {"ts_adapt_dt_min": "1.0"}
"""A smallest Δt above every Δt, so that a failed step is not repeated."""


@contextmanager
def failing(
    comm: MPI.Comm,
    scene: Mapping[str, Any],
    spoil: Spoil | None = None,
    petsc: Mapping[str, str] = ONE_ATTEMPT,
) -> Iterator[tuple[SteppedScene, SolverError, Failure]]:
    """A simulation whose step fails, its error and its failure report."""
    direct = direct_solver(comm) | {"ksp_rtol": "1e-12"}
    with stepped(comm, {**SCENE, **scene}, **direct | dict(petsc)) as simulation:
        if spoil is not None:
            equations = simulation.problem.equations
            plain = equations.forces.residual

            def spoiled(v: Array, at: Evaluation, out: Array) -> None:
                plain(v, at, out)
                spoil(simulation, out)

            equations.forces.residual = spoiled  # type: ignore[method-assign]

        def run() -> None:
            while not simulation.finished:
                simulation.step()

        with pytest.raises(SolverError) as caught:
            run()
        assert simulation.failure is not None
        yield simulation, caught.value, simulation.failure


def pushed(vertex: int, value: float) -> Spoil:
    """Adds an unbalanced force to one vertex of the mesh."""

    def spoil(simulation: SteppedScene, out: Array) -> None:
        out[simulation.problem.points.mesh_vertices == vertex] = value

    return spoil


def test_the_vertex_with_the_largest_residual_is_named(comm: MPI.Comm) -> None:
    with failing(comm, {}, pushed(17, 1e6)) as (simulation, error, failure):
        assert error.collective
        vertex = failure.diagnosis.vertex
        assert vertex.number == 17
        mesh = simulation.problem.mesh
        place = comm.bcast(mesh.positions[17] if mesh is not None else None)
        assert vertex.before == pytest.approx(place)
        assert f"worst at vertex 17 around ({place[0]:.4g}, {place[1]:.4g}, 0) m, mostly " in str(error)
        assert 1 < len(failure.advice) <= 3
        assert comm.allgather(str(error)) == [str(error)] * comm.size
        assert comm.allgather(error.details) == [error.details] * comm.size


def test_an_overflow_on_one_rank_is_detected_on_all(comm: MPI.Comm) -> None:
    with failing(comm, {}, pushed(23, np.nan)) as (_, error, failure):
        assert failure.diagnosis.kind == "overflow"
        assert failure.diagnosis.not_finite == 1
        assert failure.diagnosis.vertex.number == 23
        assert "overflow" in str(error)


@pytest.mark.filterwarnings("ignore:overflow")
def test_an_overflow_names_the_force_of_its_cause(comm: MPI.Comm) -> None:
    with failing(comm, {"gravity": [0, 0, -1e200]}) as (_, error, failure):
        assert failure.diagnosis.kind == "overflow"
        assert failure.diagnosis.overflowing == ["loads"]
        assert "or has the wrong unit (overflow in: loads)" in str(error)


def test_the_worst_place_does_not_depend_on_the_ranks(comm: MPI.Comm) -> None:
    scene = {"material": STIFF, "solver": {"max_iterations": 3}, "time": {"end": 1.0, "step": 0.04}}
    with failing(MPI.COMM_SELF, scene) as (_, _, alone):
        pass
    with failing(comm, scene) as (simulation, error, together):
        assert alone.diagnosis.vertex.number == together.diagnosis.vertex.number
        residual = gathered(simulation.problem.points, together.failed_solve.residual)
        residual[[0, 5]] = 0.0
        sizes = np.linalg.norm(residual, axis=1)
        assert together.diagnosis.vertex.number == sizes.argmax()
        assert together.diagnosis.norm == pytest.approx(np.linalg.norm(residual))
        assert together.diagnosis.norm == pytest.approx(alone.diagnosis.norm, rel=1e-5)
        assert together.diagnosis.kind == "nonlinear trouble"
        norms = [each.residual for each in together.failed_solve.iterations]
        assert len(norms) == 4
        assert norms[-1] == pytest.approx(together.diagnosis.norm)
        assert error.details[0].startswith("residual [N] by iteration (linear iterations): ")
        assert "try solver.max_iterations above 3" in str(error)


def test_earlier_attempts_are_reported(comm: MPI.Comm) -> None:
    time = {"end": 1.0, "step": 0.04}
    scene = {"material": STIFF, "solver": {"max_iterations": 1}, "time": time}
    with failing(comm, scene, petsc={"ts_adapt_dt_min": "0.005"}) as (_, error, failure):
        assert [tried.dt for tried in failure.attempts] == pytest.approx([0.04, 0.02, 0.01, 0.005])
        assert all(tried.newton_iterations == 1 and tried.residual > 0.0 for tried in failure.attempts)
        (line,) = [line for line in error.details if line.startswith("attempts before")]
        assert line.count(" (1)") == 3
        assert "-ts_adapt_dt_min below 0.005" in " ".join(error.details)


def test_a_linear_failure_is_distinguished(comm: MPI.Comm) -> None:
    scene = {"time": {"end": 1.0, "step": 0.01, "integrator": "semi-implicit"}, "material": STIFF}
    iterative = ONE_ATTEMPT | {"pc_type": "jacobi", "ksp_max_it": "2"}
    with failing(comm, scene, petsc=iterative) as (_, error, failure):
        assert failure.diagnosis.kind == "linear trouble"
        assert "the linear solve failed: too many linear iterations (linear trouble)" in str(error)
        assert "try a direct solver: -pc_type lu" in str(error)
        assert "in 2 iterations" in error.details[0]
        assert "or try -ksp_max_it above 2" in error.details


def test_a_failed_load_step(comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(equilibrium, "MAX_SOLVES", 2)
    with failing(comm, {"time": {"analysis": "static"}}) as (simulation, error, failure):
        assert "(load factor 0) did not converge even with an increment of" in str(error)
        assert "no equilibrium within 2 proximal steps" in str(error)
        assert len(failure.failed_solve.iterations) == 3  # before the first proximal step and after each
        assert failure.failed_solve.time == pytest.approx(failure.attempts[-1].dt)
        force = failure.failed_solve.residual
        assert np.sqrt(comm.allreduce(float(np.vdot(force, force)))) == pytest.approx(failure.diagnosis.norm)
        # the state is the one before the load step, the iterate another
        x = simulation.problem.equations.x[: simulation.problem.points.n_owned]
        assert comm.allreduce(float(np.abs(x[:, 2]).max(initial=0.0)), MPI.MAX) == 0.0
        assert (
            comm.allreduce(float(np.abs(failure.failed_solve.position - x).max(initial=0.0)), MPI.MAX) > 0.0
        )


def test_a_static_analysis_without_handles_ends_soon(comm: MPI.Comm) -> None:
    with failing(comm, {"time": {"analysis": "static"}, "handles": []}) as (_, error, _):
        assert "try handles (nothing holds the sheet)" in str(error)


def test_vertices_are_named_by_the_numbers_of_their_files(comm: MPI.Comm, shared_tmp: Path) -> None:
    triangles = (
        "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n5\n7 0 0 0\n9 5 5 5\n11 1 0 0\n30 0 1 0\n31 1 1 0\n"
    )
    triangles += "$EndNodes\n$Elements\n2\n1 2 2 0 1 7 11 30\n2 2 2 0 1 11 31 30\n$EndElements\n"
    if comm.rank == 0:
        (shared_tmp / "two.msh").write_text(triangles)
    comm.Barrier()
    left = {"file": str(shared_tmp / "two.msh")}
    with failing(comm, {"mesh": left, "handles": [{"nodes": [0]}]}, pushed(3, 1e6)) as (_, error, failure):
        assert failure.diagnosis.vertex.tag == 31
        assert "vertex 3 (node 31 of two.msh) around (1, 1, 0) m," in str(error)
    right = {"name": "right", **grid(1.0, 1.0, 2, 2), "transform": {"translate": [4, 0, 0]}}
    mesh = [left, right]
    with failing(comm, {"mesh": mesh, "handles": [{"nodes": [0, 4]}]}, pushed(12, 1e6)) as (_, error, _):
        assert "vertex 12 (vertex 8 of right) around (5, 1, 0) m" in str(error)
    with failing(comm, {"mesh": mesh, "handles": [{"nodes": [0, 4]}]}, pushed(2, 1e6)) as (_, error, _):
        assert "vertex 2 (node 30 of two.msh) around (0, 1, 0) m" in str(error)
