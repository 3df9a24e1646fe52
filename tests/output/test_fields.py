"""Optional fields of the states: values on shapes for which they are known."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from physics import Simulation, grid

from lyra_petsc.errors import InputError
from lyra_petsc.output.fields import FIELDS, check_field, chosen_fields
from lyra_petsc.scene import schema as control
from lyra_petsc.terms.bending.hinge import Bending

MATERIAL = {"density": 0.2, "membrane": {"c11": 100, "c22": 80, "c12": 20, "c33": 30}, "bending": 1e-3}
ALL = {"mesh": grid(1.0, 1.0, 8, 8), "material": MATERIAL, "output": {"fields": list(control.FIELDS)}}


def value(simulation: Simulation, name: str) -> np.ndarray:
    return FIELDS[name].compute(simulation.problem)


def test_scene_and_program_know_the_same_fields() -> None:
    assert set(FIELDS) == set(control.FIELDS)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_curvature_of_a_cylinder(sign: float) -> None:
    radius = 2.0
    with Simulation(ALL, MPI.COMM_SELF) as simulation:
        flat = simulation.x
        angle = flat[:, 0] / radius
        bent = np.column_stack([radius * np.sin(angle), flat[:, 1], sign * radius * (1.0 - np.cos(angle))])
        simulation.set_state(x=bent)
        original = simulation.problem.points.mesh_vertices
        inside = (np.abs(flat[original, :2] - 0.5) < 0.45).all(axis=1)
        curvature = value(simulation, "curvature")[inside]
    # curling towards the normal (+z) counts as positive
    np.testing.assert_allclose(curvature, sign / radius, rtol=2e-3)


def test_collapsed_triangles_have_no_curvature() -> None:
    with Simulation(ALL, MPI.COMM_SELF) as simulation:
        flat, noise = simulation.x, np.random.default_rng(3).normal(0.0, 1e-9, simulation.x.shape)
        simulation.set_state(x=flat * [0.0, 1.0, 1.0] + noise)
        bending = simulation.problem.terms["bending"]
        assert isinstance(bending, Bending)
        angles = bending.angles(simulation.equations.x)
        curvature, energy = value(simulation, "curvature"), value(simulation, "bending_energy")
    assert np.abs(angles).max() > 1.0
    assert not np.any(np.abs(curvature) > 1e-30)
    assert not np.any(energy > 1e-30)


@pytest.mark.parametrize("model", ["hinge", "midedge"])
def test_energy_densities_add_up(model: str) -> None:
    content = ALL | {"material": MATERIAL | {"bending_model": model}}
    with Simulation(content, MPI.COMM_SELF) as simulation:
        simulation.set_state(x=simulation.x + np.random.default_rng(3).normal(0.0, 0.01, simulation.x.shape))
        area = simulation.problem.membrane.elements.data["area"]
        total = value(simulation, "membrane_energy") @ area
        assert total == pytest.approx(simulation.energy("membrane"))
        vertex_area = simulation.mass / 0.2
        bending = value(simulation, "bending_energy") @ vertex_area[simulation.problem.points.mesh_vertices]
        name = "bending" if model == "hinge" else model
        assert bending == pytest.approx(simulation.energy(name))


def test_strain_and_stress_of_a_stretch() -> None:
    with Simulation(ALL, MPI.COMM_SELF) as simulation:
        simulation.set_state(x=simulation.x * [1.1, 1.0, 1.0])
        strain, stress = value(simulation, "green_strain"), value(simulation, "stress")
    np.testing.assert_allclose(
        strain, np.tile([0.105, 0.0, 0.0, 0.0, 0.0, 0.0], (len(strain), 1)), atol=1e-12
    )
    np.testing.assert_allclose(stress, np.tile([10.5, 0.0, 0.0, 2.1, 0.0, 0.0], (len(stress), 1)), atol=1e-10)


def test_displacement_is_relative_to_the_disturbed_start() -> None:
    moved = [0.1, -0.2, 0.3]
    with Simulation(ALL | {"initial": {"noise": 0.01}}, MPI.COMM_SELF) as simulation:
        assert not value(simulation, "displacement").any()
        simulation.set_state(x=simulation.x + moved)
        found = value(simulation, "displacement")
    np.testing.assert_allclose(found, np.tile(moved, (len(found), 1)), atol=1e-14)


def test_without_the_field_the_start_is_not_stored() -> None:
    with Simulation(ALL | {"output": {}}, MPI.COMM_SELF) as simulation:
        assert simulation.problem.start is None
        with pytest.raises(InputError, match=r"displacement.*output.fields"):
            check_field(FIELDS["displacement"], simulation.problem)


def test_a_field_of_an_absent_term_is_refused() -> None:
    content = ALL | {"material": MATERIAL | {"bending": 0}, "output": {"fields": ["curvature"]}}
    with Simulation(content, MPI.COMM_SELF) as simulation, pytest.raises(InputError, match="bending"):
        chosen_fields(simulation.problem)


def test_the_curvature_tensor_of_hinges_is_refused_with_the_remedy() -> None:
    content = ALL | {"output": {"fields": ["curvature_tensor"]}}
    with Simulation(content, MPI.COMM_SELF) as simulation, pytest.raises(InputError, match="model: hinge"):
        chosen_fields(simulation.problem)
