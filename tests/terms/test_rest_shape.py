"""Rest shapes: curved surfaces, prescribed curvature, hinge stiffness, masses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from examples import BENDING, curved_sheet
from mpi4py import MPI
from physics import CLOTH, Simulation, grid, obj_file

from lyra_petsc.experiments.meshes import rectangle
from lyra_petsc.terms.bending.hinge import Bending


def bending_of(simulation: Simulation) -> Bending:
    term = simulation.problem.terms["bending"]
    assert isinstance(term, Bending)
    return term


def test_cylinder_at_rest_is_curved_and_free_of_force(tmp_path: Path) -> None:
    content = {"mesh": curved_sheet(tmp_path / "cylinder.obj"), "material": BENDING}
    with Simulation(content, MPI.COMM_SELF) as simulation:
        bending = bending_of(simulation)
        assert np.abs(bending.angles(simulation.equations.x)).max() > 0.1
        force = np.zeros_like(simulation.equations.x)
        bending.add_gradient(simulation.equations.x, None, force)
        simulation.problem.membrane.add_gradient(simulation.equations.x, None, force)
        assert np.abs(force).max() < 1e-11
        before = simulation.x
        np.testing.assert_allclose(simulation.run(0.05, 3), before, atol=1e-13)


@pytest.mark.parametrize("curvature", [(0.02, 0.0, 0.0), (0.0, 0.03, 0.0), (0.01, -0.02, 0.015)])
@pytest.mark.parametrize("pattern", ["diagonal", "alternating", "criss-cross"])
@pytest.mark.parametrize("warp", [0.0, 30.0])
def test_rest_curvature_is_that_of_the_interpolated_paraboloid(
    curvature: tuple[float, float, float], pattern: str, warp: float
) -> None:
    material = CLOTH | {"bending": 1e-3, "rest_curvature": list(curvature), "warp_degrees": warp}
    with Simulation(
        {"mesh": grid(1.0, 0.8, 4, 3, pattern), "material": material}, MPI.COMM_SELF
    ) as simulation:
        bending = bending_of(simulation)
        x = simulation.equations.x.copy()
        angle = np.radians(warp)
        u, w = (
            np.cos(angle) * x[:, 0] + np.sin(angle) * x[:, 1],
            np.cos(angle) * x[:, 1] - np.sin(angle) * x[:, 0],
        )
        k11, k22, k12 = curvature
        x[:, 2] = 0.5 * k11 * u**2 + 0.5 * k22 * w**2 + k12 * u * w
        rest = bending.elements.data["rest_angle"]
        # angles of a surface with small slopes s agree with its slopes up to s³
        np.testing.assert_allclose(bending.angles(x), rest, atol=1e-3 * np.abs(rest).max())
        flat = float(bending.energies(simulation.equations.x).sum())
        assert flat > 0.0
        assert float(bending.energies(x).sum()) < 1e-6 * flat


def test_rest_curvature_does_not_depend_on_the_numbering(tmp_path: Path) -> None:
    # a curved rest shape: the material axes of neighbours differ
    vertices, triangles = rectangle(4, 3, 1.0, 0.75)
    vertices[:, 2] = 0.1 * np.sin(5.0 * vertices[:, 0]) * np.cos(3.0 * vertices[:, 1])
    order = np.random.default_rng(4).permutation(len(vertices))
    found = []
    for name, numbers in (("as it is", np.arange(len(vertices))), ("permuted", order)):
        mesh = obj_file(
            tmp_path / f"{name}.obj", vertices[np.argsort(numbers)], numbers[triangles[:: 1 - 2 * len(found)]]
        )
        material = CLOTH | {"bending": 1e-3, "rest_curvature": [0.5, -1.0, 0.7]}
        with Simulation({"mesh": mesh, "material": material}, MPI.COMM_SELF) as simulation:
            found.append(simulation.energy("bending"))
    assert found[0] > 1e-6
    assert found[1] == pytest.approx(found[0], rel=1e-12)


def test_positive_curvature_raises_the_sheet_towards_its_normal() -> None:
    material = CLOTH | {"bending": 1e-3, "rest_curvature": [0.1, 0.1, 0.0]}
    with Simulation({"mesh": grid(1, 1, 2, 2), "material": material}, MPI.COMM_SELF) as simulation:
        # the grid's normals are +z; with κ > 0 the corners rise above the middle
        assert np.all(bending_of(simulation).elements.data["rest_angle"] <= 1e-15)
        bowl, dome = simulation.equations.x.copy(), simulation.equations.x.copy()
        squared = (bowl[:, 0] - 0.5) ** 2 + (bowl[:, 1] - 0.5) ** 2
        bowl[:, 2], dome[:, 2] = 0.05 * squared, -0.05 * squared
        bending = bending_of(simulation)
        assert bending.energies(bowl).sum() < 0.01 * bending.energies(dome).sum()


def test_curvature_of_a_sheet_that_starts_flat_rolls_it_up() -> None:
    # one cell strip: each hinge across turns by κ times the distance of the triangles' heights
    material = CLOTH | {"bending": 1e-3, "rest_curvature": [2.0, 0.0, 0.0]}
    with Simulation({"mesh": grid(1, 0.1, 10, 1), "material": material}, MPI.COMM_SELF) as simulation:
        bending = bending_of(simulation)
        across = np.isclose(bending.elements.data["length"], 0.1)
        np.testing.assert_allclose(bending.elements.data["rest_angle"][across], -2.0 * 0.1, rtol=1e-12)


@pytest.mark.parametrize("pattern", ["diagonal", "alternating"])
def test_a_clamped_strip_rolls_up_without_energy(pattern: str) -> None:
    # the chord of the first cell leaves the clamp at half the angle between two chords
    turn = 0.3
    material = CLOTH | {"bending": 1e-3, "rest_curvature": [turn / 0.1, 0.0, 0.0]}
    scene = {
        "mesh": grid(1, 0.1, 10, 1, pattern),
        "material": material,
        "handles": [{"group": "left", "clamp": True}],
    }
    with Simulation(scene, MPI.COMM_SELF) as simulation:
        simulation.equations.begin_step(0.0, 1.0)
        flat = simulation.x
        assert simulation.energy("clamp") > 1e-6
        slope = turn * (np.arange(10) + 0.5)
        along = np.concatenate([[0.0], np.cumsum(0.1 * np.cos(slope))])
        up = np.concatenate([[0.0], np.cumsum(0.1 * np.sin(slope))])
        column = np.rint(flat[:, 0] / 0.1).astype(int)
        simulation.set_state(x=np.column_stack([along[column], flat[:, 1], up[column]]))
        assert simulation.energy("bending") < 1e-25
        assert simulation.energy("clamp") < 1e-25
        assert simulation.energy("membrane") < 1e-25


@pytest.mark.parametrize("angle", [-2.5, -0.4, 0.3, 2.0])
def test_hinge_energy_is_b_l2_theta2_over_twice_the_areas(tmp_path: Path, angle: float) -> None:
    # two right triangles on a common edge of length 0.5 with heights 0.2 and 0.3
    flat = [(0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.1, 0.2, 0.0), (0.3, -0.3, 0.0)]
    mesh = obj_file(tmp_path / "hinge.obj", flat, [(0, 1, 2), (1, 0, 3)])
    b = 0.04
    with Simulation({"mesh": mesh, "material": CLOTH | {"bending": b}}, MPI.COMM_SELF) as simulation:
        x = np.array(flat)
        # triangle (1, 0, 3) turned about the edge; below the normals (−z) the angle is positive
        x[3, 1:] = -0.3 * np.cos(angle), -0.3 * np.sin(angle)
        simulation.set_state(x=x)
        assert bending_of(simulation).angles(simulation.equations.x)[0] == pytest.approx(angle, rel=1e-13)
        expected = b * 0.5**2 * angle**2 / (2 * (0.05 + 0.075))
        assert simulation.energy("bending") == pytest.approx(expected, rel=1e-13)


def test_stiffness_follows_the_direction_of_the_rest_edge() -> None:
    values = {"warp": 1.0, "bias": 2.0, "weft": 4.0}
    material = CLOTH | {"bending": list(values.values())}
    with Simulation({"mesh": grid(1, 1, 2, 2), "material": material}, MPI.COMM_SELF) as simulation:
        data = bending_of(simulation).elements.data
        x, quad = simulation.equations.x, bending_of(simulation).stencil
        edge = x[quad[:, 1]] - x[quad[:, 0]]
        b = data["k"] * 2 * (2 * 0.125) / data["length"] ** 2
        along_x, along_y = np.isclose(edge[:, 1], 0.0), np.isclose(edge[:, 0], 0.0)
        np.testing.assert_allclose(b[along_x], values["warp"])
        np.testing.assert_allclose(b[along_y], values["weft"])
        np.testing.assert_allclose(b[~along_x & ~along_y], values["bias"])
        assert along_x.sum() == along_y.sum() == 2


def test_lumped_mass_is_a_third_of_each_triangle() -> None:
    with Simulation({"mesh": grid(1.0, 0.5, 2, 1)}, MPI.COMM_SELF) as simulation:
        mass = simulation.mass
        assert mass.sum() == pytest.approx(0.2 * 0.5, rel=1e-14)
        share = 0.2 * 0.125 / 3.0
        np.testing.assert_allclose(mass, share * np.array([2, 3, 1, 1, 3, 2]), rtol=1e-13)


GEO = """
Point(1) = {0, 0, 0}; Point(2) = {1, 0, 0}; Point(3) = {1, 1, 0}; Point(4) = {0, 1, 0};
Point(5) = {2, 0, 0}; Point(6) = {2, 1, 0};
Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Line(5) = {2, 5}; Line(6) = {5, 6}; Line(7) = {6, 3};
Curve Loop(1) = {1, 2, 3, 4}; Plane Surface(1) = {1};
Curve Loop(2) = {5, 6, 7, -2}; Plane Surface(2) = {2};
Transfinite Curve {1, 2, 3, 4, 5, 6, 7} = 2;
Physical Surface("left") = {1}; Physical Surface("right") = {2};
"""


def test_the_softer_material_counts_at_the_hinge_between_two(tmp_path: Path) -> None:
    path = tmp_path / "two.geo"
    path.write_text(GEO, encoding="utf-8")
    soft, hard = 0.25, 4.0
    material = [
        CLOTH | {"bending": hard, "damping": 0.2, "group": "left"},
        CLOTH | {"bending": soft, "damping": 0.4, "group": "right"},
    ]
    with Simulation(
        {"mesh": {"file": str(path), "size": 5.0}, "material": material}, MPI.COMM_SELF
    ) as simulation:
        bending = bending_of(simulation)
        data, x = bending.elements.data, simulation.equations.x
        middle = x[bending.stencil[:, :2], 0].mean(axis=1)
        areas = 0.5 * data["rest_height"] * data["length"]
        b = data["k"] * 2.0 * areas / data["length"] ** 2
        between = np.isclose(middle, 1.0) & np.isclose(np.ptp(x[bending.stencil[:, :2], 0], axis=1), 0.0)
        assert between.sum() >= 1
        np.testing.assert_allclose(b, np.where((middle < 1.0) & ~between, hard, soft))
        np.testing.assert_allclose(
            data["damping"], np.where(between, 0.3, np.where(middle < 1.0, 0.2, 0.4)), rtol=1e-12
        )


def test_each_sheet_has_its_own_material() -> None:
    mesh = [
        {"grid": {"width": 1, "height": 1, "nx": 1, "ny": 1}, "name": "left"},
        {
            "grid": {"width": 1, "height": 1, "nx": 1, "ny": 1},
            "name": "right",
            "transform": {"translate": [3, 0, 0]},
        },
    ]
    material = [CLOTH | {"bending": 1.0}, CLOTH | {"density": 0.5, "group": "right"}]
    with Simulation({"mesh": mesh, "material": material}, MPI.COMM_SELF) as simulation:
        # without bending the right sheet has no hinge at all
        assert bending_of(simulation).n_elements == 1
        assert simulation.mass[:4].sum() == pytest.approx(0.2)
        assert simulation.mass[4:].sum() == pytest.approx(0.5)
