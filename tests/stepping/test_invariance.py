"""A run does not depend on units, on directions in space, on numbers of vertices, or on a uniform motion."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from physics import finished, grid, obj_file, shape
from scipy.spatial.transform import Rotation

import lyra_petsc
from lyra_petsc.arrays import Array
from lyra_petsc.experiments.meshes import rectangle

CELLS = 5, 3
VERTICES = 24
STEP, STEPS = 0.005, 6


def end(
    folder: Path,
    integrator: str,
    model: str,
    *,
    units: tuple[float, float, float] = (1.0, 1.0, 1.0),
    turn: Array | None = None,
    order: Array | None = None,
) -> tuple[Array, dict[str, float]]:
    """Positions [m] and energies [J] at the end of a bent sheet that falls on a moving ball, in SI units.

    ``units`` are a metre, a second and a kilogram in those of the scene; ``order`` are the numbers in a grid
    of the vertices of the mesh, whose triangles are then in another order, too.
    """
    m, s, kg = units
    rotation = np.eye(3) if turn is None else turn
    flat, triangles = rectangle(*CELLS, 1.0, 0.6)
    if order is None:
        order = np.arange(VERTICES)
    else:
        triangles = np.roll(triangles[::-1], 1, axis=1)
    number = np.argsort(order)
    u, v, _ = flat.T
    start = np.column_stack([0.7 * np.sin(u / 0.7), v, 0.7 * (1.0 - np.cos(u / 0.7))])
    left, corner, inside = number[u == 0.0].tolist(), int(number[-1]), int(number[8])

    def vector(values: list[float], unit: float) -> list[float]:
        return (unit * (rotation @ np.array(values))).tolist()

    force, stiffness = kg * m / s**2, kg / s**2
    motion = [
        {"time": 0.0},
        {
            "time": 0.02 * s,
            "rotate": {"axis": vector([1.0, 2.0, 3.0], 1.0), "degrees": 5.0},
            "translate": vector([0.01, 0.0, 0.005], m),
        },
    ]
    bending = 1e-4 * force * m
    content = {
        "mesh": obj_file(
            folder / "sheet.obj", (m * start @ rotation.T)[order], number[triangles], m * flat[order, :2]
        ),
        "material": {
            "density": 0.2 * kg / m**2,
            "membrane": {
                c: k * stiffness for c, k in (("c11", 60.0), ("c22", 40.0), ("c12", 15.0), ("c33", 12.0))
            },
            "bending_model": model,
            "bending": [bending, 0.7 * bending, 0.4 * bending]
            if model == "hinge"
            else {"d11": bending, "d22": 0.5 * bending, "d12": 0.1 * bending, "d33": 0.3 * bending},
            "warp_degrees": 25.0,
            "damping": 0.01 * s,
            "rest_curvature": [1.0 / m, -0.5 / m, 0.3 / m],
        },
        "gravity": vector([1.0, 0.5, -9.0], m / s**2),
        "wind": {
            "velocity": vector([1.0, 2.0, 3.0], m / s),
            "density": 1.2 * kg / m**3,
            "drag": 0.3 * kg / (m**2 * s),
        },
        "handles": [
            {"nodes": left, "motion": "pull"},
            {"nodes": [corner], "stiffness": 5.0 * stiffness},
        ],
        "loads": [
            {"pressure": 2.0 * force / m**2},
            {"nodes": [inside], "force": vector([0.0, 0.02, 0.03], force)},
        ],
        "motions": {"pull": motion},
        "contact": {"friction": {"static": 0.5, "kinetic": 0.3}},
        "obstacles": {
            "ball": {"sphere": {"center": vector([0.45, 0.3, -0.22], m), "radius": 0.3 * m}, "motion": "pull"}
        },
        "initial": {
            "velocity": vector([0.1, 0.0, -0.5], m / s),
            "angular_velocity": vector([1.0, 0.0, 2.0], 1.0 / s),
        },
        "time": {"end": STEPS * STEP * s, "step": STEP * s, "integrator": integrator},
        "output": {"every": STEPS * STEP * s},
        "solver": {"force_tolerance": 1e-10, "step_tolerance": 1e-10},
        "petsc": {"ksp_rtol": 1e-12},
    }
    with finished(MPI.COMM_WORLD, lyra_petsc.load(content)) as simulation:
        budget = asdict(simulation.budget)
        energies = {name: value / (force * m) for name, value in (budget | budget.pop("more")).items()}
        return shape(simulation)[number] @ rotation / m, energies


@pytest.mark.parallel(2)
@pytest.mark.parametrize(
    ("integrator", "model"),
    [
        ("beuler", "hinge"),
        ("semi-implicit", "midedge"),
        ("midpoint", "hinge"),
        ("bdf2", "midedge"),
        ("alpha2", "midedge"),
    ],
)
def test_units_directions_and_numbers_do_not_matter(integrator: str, model: str, tmp_path: Path) -> None:
    positions, energies = end(tmp_path, integrator, model)
    assert energies["contact_energy"] > 0.0
    shuffled = np.random.default_rng(3).permutation(VERTICES)
    others = (
        {"units": (8.0, 0.25, 64.0)},
        {"turn": Rotation.from_euler("xyz", [0.3, 1.1, 2.5]).as_matrix()},
        {"order": shuffled},
    )
    for other in others:
        found, of_found = end(tmp_path, integrator, model, **other)
        np.testing.assert_allclose(found, positions, rtol=0.0, atol=1e-9)
        assert of_found == pytest.approx(energies, rel=1e-8, abs=1e-12)


@pytest.mark.parallel(2)
@pytest.mark.parametrize(
    ("integrator", "model", "damping"),
    [
        ("beuler", "midedge", 0.01),
        ("semi-implicit", "hinge", 0.0),
        ("midpoint", "hinge", 0.0),
        ("bdf2", "hinge", 0.0),
        ("alpha2", "midedge", 0.01),
    ],
)
def test_a_uniform_motion_of_everything_does_not_matter(
    integrator: str, model: str, damping: float, comm: MPI.Comm
) -> None:
    """A flag at a clamp, above a ball that it touches; half hinges of moving clamps are not damped.

    With integrators of second order nothing touches: they treat fast sheets in contact apart.
    """
    near = -0.063 if integrator in ("beuler", "semi-implicit") else -0.2
    clamp = {"group": "left", "clamp": True} if integrator != "semi-implicit" else {"group": "left"}
    wind, along, time = np.array([1.0, 2.0, -1.0]), np.array([1.3, -0.7, 0.4]), 0.05
    ends, forces = [], []
    for velocity in (np.zeros(3), along):
        motion = {"motion": "away", "interpolation": "linear"}
        ball = {"sphere": {"center": [0.3, 0.15, near], "radius": 0.06}}
        content = {
            "mesh": grid(0.4, 0.3, 6, 5, "alternating"),
            "material": {"young": 2e5, "poisson": 0.3, "thickness": 1e-3, "density": 0.3}
            | {"damping": damping, "bending_model": model},
            "gravity": [0.0, 0.0, -9.81],
            "handles": [clamp | motion],
            "motions": {"away": [{"time": 0.0}, {"time": 1.0, "translate": velocity.tolist()}]},
            "initial": {"velocity": velocity.tolist()},
            "wind": {"velocity": (wind + velocity).tolist(), "density": 1.2, "drag": 0.2},
            "contact": {"gap": 0.004, "friction": 0.3},
            "obstacles": {"ball": ball | motion},
            "time": {"end": time, "step": 0.005, "integrator": integrator},
            "petsc": {"ksp_rtol": 1e-12} if integrator == "semi-implicit" else {},
        }
        with finished(comm, content) as simulation:
            ends.append(shape(simulation) - time * velocity)
            forces.append(simulation.energy_balance.obstacle_forces(1)[0, :3])
    assert (np.linalg.norm(forces[0]) > 1e-3) == (near > -0.1)
    np.testing.assert_allclose(ends[1], ends[0], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(forces[1], forces[0], rtol=1e-6, atol=1e-9)
