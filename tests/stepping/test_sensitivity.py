"""Derivatives by tangent equations, compared with differences of runs, for all integrators and terms."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from closed_surfaces import sphere
from mpi4py import MPI
from physics import finished, grid, obj_file

import lyra_petsc
from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.perturbed_scenes import SceneParameter
from lyra_petsc.stepping.sensitivity import Sensitivities
from lyra_petsc.stepping.simulation import SteppedScene

STEP = 2e-4
"""Relative change of a parameter in central differences."""

TIGHT = {"force_tolerance": 1e-12, "step_tolerance": 1e-14}

# pulled from the first step on, so that no strain crosses 0, where the damping's K⁺ has a kink
PULLED: dict[str, Any] = {
    "mesh": grid(0.5, 0.4, 4, 3, "alternating"),
    "material": {
        "density": 0.2,
        "membrane": {"c11": 60.0, "c22": 40.0, "c12": 15.0, "c33": 12.0},
        "bending": 1e-3,
        "damping": 0.01,
    },
    "gravity": [0.0, 0.0, -9.81],
    "wind": {"velocity": [1.0, 2.0, 3.0], "density": 1.2, "drag": 0.3},
    "handles": [
        {"nodes": [0, 5, 10, 15], "clamp": True},
        {"nodes": [4, 9, 14, 19], "motion": "pull"},
        {"nodes": [12], "stiffness": 3.0},
        {"nodes": [7], "from": 0.02, "until": 0.03, "axes": ["z"]},
    ],
    "loads": [{"pressure": 2.0}, {"nodes": [6], "force": [0.0, 0.02, 0.03]}],
    "motions": {"pull": [{"time": 0}, {"time": 0.08, "translate": [0.05, 0.0, 0.01]}]},
    "time": {"end": 0.04, "step": 0.01},
    "solver": TIGHT,
    "petsc": {"ksp_rtol": 1e-13},
}

NUMBERS = {
    "material.membrane.c11": 60.0,
    "material.membrane.c22": 40.0,
    "material.membrane.c12": 15.0,
    "material.membrane.c33": 12.0,
    "material.bending": 1e-3,
    "material.damping": 0.01,
    "material.density": 0.2,
    "gravity[2]": -9.81,
    "wind.density": 1.2,
    "wind.drag": 0.3,
    "wind.velocity[1]": 2.0,
    "handles[2].stiffness": 3.0,
    "loads[0].pressure": 2.0,
    "loads[1].force[2]": 0.03,
}

SHELL = {"density": 0.4, "young": 2e6, "poisson": 0.3, "thickness": 5e-4, "damping": 0.01}
OF_SHELL = {
    "material.young": 2e6,
    "material.poisson": 0.3,
    "material.thickness": 5e-4,
    "material.damping": 0.01,
    "material.density": 0.4,
    "loads[0].pressure": 2.0,
    "handles[2].stiffness": 3.0,
}

PLATE = {
    "density": 0.4,
    "membrane": {"c11": 900.0, "c22": 700.0, "c12": 200.0, "c33": 200.0},
    "bending": {"d11": 2e-2, "d22": 1e-2, "d12": 3e-3, "d33": 4e-3},
    "damping": 0.01,
}
OF_PLATE = {f"material.bending.{key}": value for key, value in PLATE["bending"].items()}  # type: ignore[attr-defined]

# directors that are not at rest at the start, turned by moments
CURVED = PLATE | {"rest_curvature": [1.0, 0.5, 0.3], "warp_degrees": 20.0}
TURNED = {"loads": [{"pressure": 2.0}, {"group": "top", "moment": 0.01}]}
OF_CURVED = OF_PLATE | {
    "material.rest_curvature[0]": 1.0,
    "material.rest_curvature[2]": 0.3,
    "material.warp_degrees": 20.0,
    "loads[1].moment": 0.01,
}

PULL = [[0.02, 3.0], [0.05, 9.0], [0.1, 22.0], [0.3, 100.0]]
KES = {
    "density": 0.2,
    "membrane": {"c11": 60.0, "c22": 40.0, "c12": 15.0},
    "kes": {"B": [3.0, 2.0], "G": 0.3},
}
LAWS: dict[str, tuple[dict[str, Any], dict[str, float]]] = {
    "measured": (
        {"cloth": "gray-interlock", "law": "measured", "warp_degrees": 20.0},
        {
            "material.density_scale": 1.0,
            "material.stretching_scale": 1.0,
            "material.thicken": 1.0,
            "material.warp_degrees": 20.0,
        },
    ),
    "curves": (
        {
            "density": 0.2,
            "bending": 1e-3,
            "law": {"warp": PULL, "weft": PULL, "shear": [[0.1, 2.5], [0.4, 12.0]]},
        },
        {"material.density": 0.2, "material.stretching_scale": 1.0, "material.bending": 1e-3},
    ),
    "neo-hookean": (
        {"young": 2e5, "poisson": 0.3, "thickness": 5e-4, "density": 0.4, "law": "neo-hookean"},
        {"material.young": 2e5, "material.poisson": 0.3, "material.thickness": 5e-4},
    ),
    "kes": (KES, {"material.kes.B[0]": 3.0, "material.kes.B[1]": 2.0, "material.kes.G": 0.3}),
    "curvature of hinges": (
        # as the warp turns, strains cross 0, where damping has a kink
        KES | {"rest_curvature": [1.0, 0.5, 0.3], "warp_degrees": 20.0, "damping": 0.0},
        {
            "material.rest_curvature[0]": 1.0,
            "material.rest_curvature[1]": 0.5,
            "material.rest_curvature[2]": 0.3,
            "material.warp_degrees": 20.0,
        },
    ),
}


def scene(integrator: str, material: Mapping[str, Any] | None = None, **more: Any) -> Scene:
    """The pulled sheet; an equilibrium has no wind but its pressure."""
    content = PULLED | ({"material": dict(material)} if material else {}) | more
    if integrator != "static":
        return lyra_petsc.load(content | {"time": content["time"] | {"integrator": integrator}})
    still = content | {"time": {"analysis": "static"}, "handles": content["handles"][:3]}
    still["motions"] = {"pull": [{"time": 0}, {"time": 1.0, "translate": [0.03, 0.0, 0.01]}]}
    return lyra_petsc.load({key: value for key, value in still.items() if key != "wind"})


def of_integrator(integrator: str, numbers: Mapping[str, float]) -> dict[str, float]:
    """The parameters that have a meaning with this integrator."""
    gone = ("wind", "material.damping") if integrator == "static" else ()
    return {key: value for key, value in numbers.items() if not key.startswith(gone or "none")}


def end(scene: Scene) -> Array:
    """Final positions [m] of this rank's vertices."""
    with finished(MPI.COMM_WORLD, scene) as simulation:
        points = simulation.problem.points
        x: Array = simulation.problem.equations.x[: points.n_vertices].copy()
        order = np.argsort(points.mesh_vertices)
    return x[order]


def tangents(scene: Scene, numbers: Mapping[str, float]) -> dict[str, Array]:
    """Derivatives of `end` with respect to each parameter, times the parameter."""
    simulation = SteppedScene(MPI.COMM_WORLD, scene)
    chosen = [SceneParameter(key, value, abs(value)) for key, value in numbers.items()]
    beside = Sensitivities(simulation, chosen, tolerance=1e-11)
    while not simulation.finished:
        beside.step()
    points = simulation.problem.points
    order = np.argsort(points.mesh_vertices)
    found = {
        number.key: number.value * tangent.x[: points.n_vertices][order]
        for number, tangent in zip(chosen, beside.tangents, strict=True)
    }
    beside.destroy()
    simulation.destroy()
    return found


def difference(scene: Scene, direction: Mapping[str, float], step: float) -> Array:
    """Derivative of `end` for relative changes of the parameters."""

    def at(factor: float) -> Array:
        changes = {key: value * (1.0 + factor * step) for key, value in direction.items()}
        return end(scene.changed(changes))

    return (at(1.0) - at(-1.0)) / (2.0 * step)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["static", "bdf2"])
def test_each_parameter(integrator: str) -> None:
    pulled, numbers = scene(integrator), of_integrator(integrator, NUMBERS)
    found = tangents(pulled, numbers)
    for key, value in numbers.items():
        expected = difference(pulled, {key: value}, STEP)
        assert np.linalg.norm(expected) > 1e-7, key
        assert np.linalg.norm(found[key] - expected) < 1e-6 * np.linalg.norm(expected), key


@pytest.mark.parametrize("integrator", ["semi-implicit", "beuler", "midpoint", "alpha2"])
def test_all_parameters_together(integrator: str) -> None:
    agree(scene(integrator), of_integrator(integrator, NUMBERS))


@pytest.mark.parametrize("integrator", ["static", "midpoint"])
@pytest.mark.parametrize(("material", "numbers"), [(SHELL, OF_SHELL), (PLATE, OF_PLATE)])
def test_directors_at_rest(
    integrator: str, material: Mapping[str, Any], numbers: Mapping[str, float]
) -> None:
    agree(scene(integrator, material), of_integrator(integrator, numbers))


def agree(pulled: Scene, numbers: Mapping[str, float]) -> None:
    found, expected = tangents(pulled, numbers), difference(pulled, numbers, STEP)
    scale = np.sqrt(sum(np.sum(each**2) for each in found.values()))
    assert np.linalg.norm(sum(found.values()) - expected) < 1e-6 * scale


@pytest.mark.parametrize("integrator", ["static", "semi-implicit", "alpha2", "bdf2"])
def test_curved_sheets_with_directors(integrator: str) -> None:
    agree(scene(integrator, CURVED, **TURNED), of_integrator(integrator, OF_CURVED))


@pytest.mark.parametrize("integrator", ["alpha2", "bdf2"])
def test_stiff_damping_whose_first_step_is_of_backward_euler(integrator: str) -> None:
    stiff = {"young": 6e6, "poisson": 0.3, "thickness": 0.005, "density": 0.2, "damping": 0.016}
    pulled = lyra_petsc.load(
        {
            "mesh": grid(1.0, 1.0, 2, 2),
            "material": stiff,
            "gravity": [5.0, -3.0, -6.0],
            "handles": [{"group": "left"}],
            "time": {"end": 0.03, "step": 0.01, "integrator": integrator}
            | ({"spectral_radius": 0.0} if integrator == "alpha2" else {}),
            "solver": TIGHT,
        }
    )
    with finished(MPI.COMM_WORLD, pulled) as simulation:
        assert any("repeated by backward Euler" in note for note in simulation.notes)
    agree(pulled, {"material.damping": 0.016, "material.young": 6e6})


@pytest.mark.slow
def test_each_parameter_of_curved_sheets_with_directors() -> None:
    pulled = scene("midpoint", CURVED, **TURNED)
    for key, value in OF_CURVED.items():
        agree(pulled, {key: value})


@pytest.mark.parametrize("law", LAWS)
def test_membrane_laws(law: str) -> None:
    material, numbers = LAWS[law]
    agree(scene("beuler", {"damping": 0.01} | material), numbers)


@pytest.mark.parametrize("integrator", ["static", "semi-implicit", "alpha2"])
def test_gas_in_a_closed_volume(integrator: str, tmp_path: Path) -> None:
    corners, triangles = sphere(3, 0.2)
    time: dict[str, Any] = {"end": 0.04, "step": 0.01, "integrator": integrator}
    content = {
        "mesh": obj_file(tmp_path / "ball.obj", corners, triangles),
        "material": PULLED["material"]
        | {"membrane": {"c11": 600.0, "c22": 400.0, "c12": 150.0, "c33": 120.0}},
        "handles": [
            {"box": [[-1, -1, -1], [1, 1, -0.1]]},
            {"box": [[-1, -1, 0.1], [1, 1, 1]], "motion": "up"},
        ],
        "motions": {"up": [{"time": 0}, {"time": 1.0, "translate": [0.0, 0.0, 0.01]}]},
        "loads": [{"gas": {"pressure": 30.0, "ambient": 2000.0}}],
        "time": {"analysis": "static"} if integrator == "static" else time,
        "solver": TIGHT,
        "petsc": {"ksp_rtol": 1e-13},
    }
    numbers = {"loads[0].gas.pressure": 30.0, "loads[0].gas.ambient": 2000.0, "material.membrane.c11": 600.0}
    agree(lyra_petsc.load(content), numbers)


@pytest.mark.parallel
def test_any_number_of_ranks() -> None:
    pulled = scene("bdf2")
    numbers = {key: NUMBERS[key] for key in ("material.bending", "material.density", "wind.density")}
    simulation = SteppedScene(MPI.COMM_WORLD, pulled)
    parameters = [SceneParameter(key, value, abs(value)) for key, value in numbers.items()]
    beside = Sensitivities(simulation, parameters, tolerance=1e-11)
    while not simulation.finished:
        beside.step()
    points = simulation.problem.points
    squares = [np.sum(tangent.x[: points.n_vertices] ** 2) for tangent in beside.tangents]
    norms = np.sqrt(points.global_sum(*map(float, squares)))
    beside.destroy()
    simulation.destroy()
    # of one rank
    assert norms == pytest.approx([1.1504691, 0.32105758, 0.049244067], rel=1e-6)


def test_a_parameter_at_its_lower_bound() -> None:
    """Damping cannot be negative: differences are one-sided."""
    material = PULLED["material"] | {"damping": 0.0}
    found = tangents(scene("beuler", material), {"material.bending": 1e-3})
    assert np.isfinite(found["material.bending"]).all()
    pulled = scene("beuler", material)
    simulation = SteppedScene(MPI.COMM_WORLD, pulled)
    beside = Sensitivities(simulation, [SceneParameter("material.damping", 0.0, 0.01)], tolerance=1e-11)
    while not simulation.finished:
        beside.step()
    points = simulation.problem.points
    slope = beside.tangents[0].x[: points.n_vertices][np.argsort(points.mesh_vertices)]
    beside.destroy()
    simulation.destroy()

    def at(damping: float) -> Array:
        return end(pulled.changed({"material.damping": damping}))

    step = 1e-5
    expected = (-1.5 * at(0.0) + 2.0 * at(step) - 0.5 * at(2.0 * step)) / step
    assert np.linalg.norm(slope - expected) < 1e-5 * np.linalg.norm(expected)


def test_a_misspelt_parameter_is_refused() -> None:
    simulation = SteppedScene(MPI.COMM_WORLD, scene("beuler"))
    with pytest.raises(InputError, match="bendig"):
        Sensitivities(simulation, [SceneParameter("material.bendig", 1.0, 1.0)])
    simulation.destroy()
