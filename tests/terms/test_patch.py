"""Patch tests: homogeneous deformations of an irregular patch against closed forms, to round-off."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from oracle import hessian
from physics import Simulation, obj_file, reference, rotation

from lyra_petsc.mesh.topology import boundary_edges

pytestmark = pytest.mark.quick


PATCH = reference("stvk_patch")
ROWS = PATCH["rows"]

#: an irregular patch: nine vertices, one inside and four off the middle of their edges
VERTICES = np.array(
    [[0, 0], [0.4, 0], [1, 0], [0, 0.55], [0.37, 0.61], [1, 0.3], [0, 0.9], [0.7, 0.9], [1, 0.9]], dtype=float
)
TRIANGLES = np.array(
    [[0, 1, 4], [1, 2, 5], [1, 5, 4], [0, 4, 3], [3, 4, 6], [4, 7, 6], [4, 5, 7], [5, 8, 7]], dtype=np.int64
)
AREA = 0.9
TILT = rotation([0.3, 1.0, -0.4], 1.1)


@pytest.fixture(params=[0.0, 37.0], ids=["warp0", "warp37"])
def warp(request: pytest.FixtureRequest) -> float:
    """Rotation of the warp direction [°]."""
    return float(request.param)


@pytest.fixture(params=range(len(ROWS)), ids=[f"{row[0]}-{row[1]}" for row in ROWS])
def row(request: pytest.FixtureRequest) -> list[object]:
    return list(ROWS[request.param])


@pytest.fixture
def patch(row: list[object], warp: float, tmp_path: Path) -> Iterator[Simulation]:
    c11, c12, c22, c33 = PATCH["materials"][row[0]]
    material = {
        "density": 0.1,
        "membrane": {"c11": c11, "c12": c12, "c22": c22, "c33": c33},
        "warp_degrees": warp,
    }
    mesh = obj_file(tmp_path / "patch.obj", np.column_stack([VERTICES, np.zeros(9)]), TRIANGLES)
    with Simulation({"mesh": mesh, "material": material}, MPI.COMM_SELF) as simulation:
        yield simulation


@pytest.mark.parametrize("stretches", [(1.2, 1.1), (1.3, 0.6), (0.5, 1.1), (0.7, 0.8)])
def test_regularisation_keeps_the_stress_of_extension_along_the_material_axes(
    stretches: tuple[float, float], tmp_path: Path
) -> None:
    mesh = obj_file(tmp_path / "one.obj", [(0, 0, 0), (1, 0.1, 0), (0.2, 0.8, 0)], [(0, 1, 2)])
    f = rotation([0, 0, 1], 0.4)[:2, :2] @ np.diag(stretches) @ rotation([0, 0, 1], 0.7)[:2, :2]
    with Simulation({"mesh": mesh}, MPI.COMM_SELF) as simulation:
        membrane = simulation.problem.membrane
        x = simulation.equations.x.copy()
        x[:, :2] = x[:, :2] @ f.T
        exact, regularised = (hessian(membrane, x, None, convexity) for convexity in (0.0, 1.0))
        order = membrane.stencil[0]
        green, stress = (values[0] for values in membrane.strain_and_stress(x))
        data = membrane.elements.data
        inverse, area, (c11, c12, c22, _) = data["inverse"][0], data["area"][0], membrane.laws[0][0]
    # the original program's geometric stiffness: strains cut at zero, no shear
    e11, e22 = np.maximum(green[:2], 0.0)
    kept = np.maximum([c11 * e11 + c12 * e22, c12 * e11 + c22 * e22], 0.0)
    dropped = np.array([[stress[0], stress[2]], [stress[2], stress[1]]]) - np.diag(kept)
    shape = np.vstack([-inverse.sum(axis=0), inverse])  # ∂F/∂x of each corner
    expected = area * shape @ dropped @ shape.T
    difference = (exact - regularised)[np.ix_(order, range(3), order, range(3))]
    np.testing.assert_allclose(
        difference, np.einsum("ab,ij->aibj", expected, np.eye(3)), atol=1e-11 * np.abs(exact).max()
    )


def test_energy_strain_stress_and_boundary_forces(patch: Simulation, row: list[object], warp: float) -> None:
    _, _, f, green, second, first, density = row
    q = rotation([0.0, 0.0, 1.0], np.radians(warp))[:2, :2]
    material = VERTICES @ q  # coordinates along warp and weft
    flat = material @ np.array(f).T
    patch.set_state(x=np.column_stack([flat, np.zeros(9)]) @ TILT.T + [0.5, -0.2, 0.8])
    stress = np.array(first)
    # at rest: strains of round-off times the stiffness
    scale = max(np.abs(stress).max(), 1e-2 * PATCH["materials"][row[0]][0])

    assert patch.energy("membrane") == pytest.approx(AREA * float(density), rel=1e-12, abs=1e-12)

    membrane = patch.problem.membrane
    strains, stresses = membrane.strain_and_stress(patch.equations.x)
    e11, e22, shear = green
    np.testing.assert_allclose(strains, np.tile([e11, e22, 0.5 * shear], (8, 1)), rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(stresses, np.tile(second, (8, 1)), rtol=1e-12, atol=1e-12 * scale)

    gradient = np.zeros_like(patch.equations.x)
    membrane.add_gradient(patch.equations.x, None, gradient)
    expected = np.zeros((9, 2))
    edges, _, opposite = boundary_edges(TRIANGLES)
    for (tail, head), inner in zip(edges, opposite, strict=True):
        along = material[head] - material[tail]
        outward = np.array([along[1], -along[0]])  # times the edge's length
        if outward @ (material[inner] - material[tail]) > 0.0:
            outward = -outward
        expected[[tail, head]] += 0.5 * stress @ outward
    np.testing.assert_allclose(
        patch.gather(gradient),
        np.column_stack([expected, np.zeros(9)]) @ TILT.T,
        rtol=0.0,
        atol=1e-12 * scale,
    )
