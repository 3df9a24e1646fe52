"""The linear solver with which a problem starts, and the next ones."""

from __future__ import annotations

import numpy as np
import pytest
from petsc4py import PETSc

from lyra_petsc.linear.pivots import negative_pivots, shows_negative_curvature
from lyra_petsc.linear.presets import PRESETS, candidates


@pytest.mark.parametrize(
    ("vertices", "ranks", "more", "first"),
    [
        (500, 1, {}, "block-jacobi"),
        (500, 1, {"iterations": 50.0}, "ilu"),
        (500, 3, {"iterations": 50.0}, "block-ilu"),
        (500, 1, {"iterations": 1e4}, "direct"),
        (5000, 1, {}, "multigrid"),
        (5000, 1, {"iterations": 1000.0}, "multigrid-w"),
        (200_000, 1, {}, "multigrid"),
        (200_000, 4, {"iterations": 1e5}, "multigrid-w"),
        (5000, 2, {"static": True}, "direct"),
        (200_000, 2, {"static": True}, "multigrid-w"),
    ],
)
def test_the_first_solver_suits_the_problem(
    vertices: int, ranks: int, more: dict[str, float], first: str
) -> None:
    chosen = candidates(vertices, ranks, **more)  # type: ignore[arg-type]
    assert chosen[0] == first
    assert len(set(chosen)) == len(chosen) > 1
    assert set(chosen) <= set(PRESETS)
    # solvers without a limit on the size
    assert {"multigrid", "multigrid-w", "gamg", "block-jacobi"} & set(chosen)


@pytest.mark.parametrize(
    ("values", "negative"), [([2.0, 1.0, 3.0], 0), ([2.0, -1.0, 3.0], 1), ([-2.0, -1.0, 3.0], 2)]
)
def test_pivots_show_negative_curvature(values: list[float], negative: int) -> None:
    mat = PETSc.Mat().createAIJ((3, 3), nnz=3, comm=PETSc.COMM_SELF)
    rotation = np.linalg.qr(np.arange(9.0).reshape(3, 3) ** 2 + np.eye(3))[0]
    mat.setValues(range(3), range(3), rotation @ np.diag(values) @ rotation.T)
    mat.assemble()
    mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    pc = PETSc.PC().create(PETSc.COMM_SELF)
    pc.setType("cholesky")
    pc.setFactorSolverType("mumps")
    pc.setOperators(mat)
    pc.setUp()
    assert shows_negative_curvature(pc)
    assert negative_pivots(pc) == negative


@pytest.mark.parametrize(
    ("kind", "shows"), [("pbjacobi", True), ("ilu", True), ("lu", False), ("none", True)]
)
def test_without_pivots_exact_factors_hide_negative_curvature(kind: str, shows: bool) -> None:
    pc = PETSc.PC().create(PETSc.COMM_SELF)
    pc.setType(kind)
    assert shows_negative_curvature(pc) is shows
    assert negative_pivots(pc) == 0
