"""Loads: total forces, their distribution over vertices, the time window; the law of the wind."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from oracle import frozen_by, gradient
from physics import Simulation, grid, obj_file, rotation

from lyra_petsc.arrays import Array
from lyra_petsc.terms.term import Load, UpcomingStep, Viscous

#: a unit square of two triangles with a curve group of unequal edges, a surface and a point group
GEO = """
Point(1) = {0, 0, 0}; Point(2) = {1, 0, 0}; Point(3) = {1, 1, 0}; Point(4) = {0, 1, 0};
Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4}; Plane Surface(1) = {1};
Transfinite Curve {1, 3} = 4 Using Progression 2; Transfinite Curve {2, 4} = 3;
Physical Surface("sheet") = {1}; Physical Curve("base") = {1}; Physical Point("corners") = {3, 4};
"""


def force_of(simulation: Simulation, t0: float = 0.0, t1: float = 0.01) -> Array:
    """Force (V, 3) [N] of all loads in the present state, in mesh order."""
    equations = simulation.equations
    out = np.zeros_like(equations.x)
    for term in simulation.problem.terms.values():
        if isinstance(term, Load):
            term.add_force(UpcomingStep(t0, t1, t1, equations.x, equations.reference.at), out)
    return simulation.gather(out)


def loaded(mesh: dict[str, Any], *loads: dict[str, Any], **more: Any) -> Simulation:
    return Simulation({"mesh": mesh, "loads": list(loads)} | more, MPI.COMM_SELF)


@pytest.fixture
def geo(tmp_path: Path) -> dict[str, Any]:
    pytest.importorskip("gmsh")
    path = tmp_path / "square.geo"
    path.write_text(GEO, encoding="utf-8")
    return {"file": str(path), "size": 0.4}


@pytest.mark.parametrize(
    ("faces", "pressure", "words"),
    [
        ([(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)], 20, None),
        ([(1, 2, 0), (3, 1, 0), (3, 2, 1), (2, 3, 0)], 20, "so that 20 Pa compress it; -20 would"),
        ([(1, 2, 0), (3, 1, 0), (3, 2, 1), (2, 3, 0)], -20, "so that -20 Pa inflate it; 20 would"),
        ([(1, 2, 0), (3, 1, 0), (3, 2, 1)], 20, None),
    ],
)
def test_normals_that_point_into_a_closed_surface_are_noted(
    tmp_path: Path, faces: list[tuple[int, ...]], pressure: float, words: str | None
) -> None:
    mesh = obj_file(tmp_path / "mesh.obj", [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], faces)
    with loaded(mesh, {"pressure": pressure}) as simulation:
        found = [note for note in simulation.problem.whole.notes if "point inwards" in note]
        assert len(found) == (words is not None)
        assert not words or words in found[0]


TOTAL = [3.0, -2.0, 1.0]


@pytest.mark.parametrize("group", ["sheet", "base", "corners"])
def test_total_force_on_a_group_whatever_its_mesh(geo: dict[str, Any], group: str) -> None:
    with loaded(geo, {"group": group, "force": TOTAL}) as simulation:
        force, x = force_of(simulation), simulation.x
        np.testing.assert_allclose(force.sum(axis=0), TOTAL, rtol=1e-13)
        part = force[:, 2]
        if group == "sheet":  # a uniform pull: its resultant goes through the centre of area
            np.testing.assert_allclose(part @ x[:, :2], [0.5, 0.5], rtol=1e-12)
            assert np.all(part > 0.0)
        elif group == "base":  # along an edge by length, though its elements are unequal
            assert np.all((part > 0.0) == (x[:, 1] == 0.0))
            assert part @ x[:, 0] == pytest.approx(0.5, rel=1e-12)
            assert np.ptp(part[part > 0.0]) > 0.05
        else:
            np.testing.assert_allclose(part[x[:, 1] == 1.0][[0, -1]].max(), 0.5)
            assert np.count_nonzero(part) == 2


def test_force_on_nodes_and_boxes_is_shared_equally() -> None:
    with loaded(grid(1, 1, 2, 2), {"nodes": [0, 8], "force": [0, 0, 4.0]}) as simulation:
        force = force_of(simulation)
        np.testing.assert_array_equal(np.flatnonzero(force[:, 2]), [0, 8])
        np.testing.assert_allclose(force[[0, 8], 2], 2.0)
    box = {"box": [[-1, -1, -1], [0.1, 2, 1]], "force": [6.0, 0, 0]}
    with loaded(grid(1, 1, 2, 2), box) as simulation:
        np.testing.assert_allclose(force_of(simulation)[[0, 3, 6], 0], 2.0)


def test_loads_on_the_same_vertex_add_up() -> None:
    with loaded(
        grid(1, 1, 1, 1), {"nodes": [0], "force": [1.0, 0, 0]}, {"nodes": [0, 1], "force": [2.0, 4.0, 0]}
    ) as simulation:
        np.testing.assert_allclose(force_of(simulation)[:2], [[2.0, 2.0, 0.0], [1.0, 2.0, 0.0]])


def test_traction_acts_per_rest_area_also_on_a_stretched_sheet() -> None:
    with loaded(grid(2.0, 0.5, 3, 2), {"traction": [0.5, 1.0, -3.0]}) as simulation:
        simulation.set_state(x=3.0 * simulation.x)
        np.testing.assert_allclose(force_of(simulation).sum(axis=0), [0.5, 1.0, -3.0], rtol=1e-13)
        np.testing.assert_allclose(force_of(simulation), simulation.mass[:, None] / 0.2 * [0.5, 1.0, -3.0])


def test_pressure_on_a_tilted_stretched_triangle_is_p_a_n(tmp_path: Path) -> None:
    tilt = rotation([1.0, 0.5, 0.0], 0.8)
    with loaded(grid(1, 1, 1, 1), {"pressure": 40.0}) as simulation:
        simulation.set_state(x=2.0 * simulation.x @ tilt.T)
        force = force_of(simulation)
        normal = tilt @ [0.0, 0.0, 1.0]
        np.testing.assert_allclose(force.sum(axis=0), 40.0 * 4.0 * normal, atol=1e-12)
        # current area 2 of each triangle, a third of p a n to each corner; two corners have both
        shares = 40.0 * 2.0 / 3.0 * np.array([2, 1, 1, 2])
        np.testing.assert_allclose(force, shares[:, None] * normal, atol=1e-12)


def test_pressure_in_a_closed_surface_has_no_resultant(tmp_path: Path) -> None:
    path = tmp_path / "tetrahedron.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1.5 0\nv 0.2 0.1 0.9\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")
    with loaded({"file": str(path)}, {"pressure": 10.0}) as simulation:
        force, x = force_of(simulation), simulation.x
        np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-14)
        np.testing.assert_allclose(np.cross(x, force).sum(axis=0), 0.0, atol=1e-14)
        # p dV: virtual work of a uniform blow-up is 3 p V, and outwards
        assert np.vdot(force, x) == pytest.approx(3.0 * 10.0 * (1.0 * 1.5 * 0.9 / 6.0), rel=1e-12)


def test_gravity_is_mass_times_acceleration() -> None:
    with Simulation({"mesh": grid(1, 2, 2, 3), "gravity": [0.1, 0.2, -9.81]}, MPI.COMM_SELF) as simulation:
        np.testing.assert_allclose(
            force_of(simulation), simulation.mass[:, None] * [0.1, 0.2, -9.81], rtol=1e-14
        )


def test_loads_act_within_their_window_only() -> None:
    load = {"nodes": [0], "force": [1.0, 0, 0], "from": 0.5, "until": 1.0}
    pressure = {"pressure": 3.0, "from": 0.5, "until": 1.0}
    with loaded(grid(1, 1, 1, 1), load, pressure) as simulation:
        for t0, t1, acts in ((0.0, 0.5, False), (0.5, 0.6, True), (0.9, 1.0, True), (1.0, 1.1, False)):
            force = force_of(simulation, t0, t1)
            np.testing.assert_allclose(force.sum(axis=0), [1.0, 0, 3.0] if acts else 0.0, atol=1e-14)


def wind_on(simulation: Simulation, v: Array) -> Array:
    term = simulation.problem.terms["wind"]
    assert isinstance(term, Viscous)
    return -gradient(term, v, frozen_by(term, simulation.equations))


def test_wind_force_of_a_tilted_sheet_follows_the_law() -> None:
    wind, density, drag = np.array([2.0, -1.0, 3.0]), 1.3, 0.7
    block = {"velocity": wind.tolist(), "density": density, "drag": drag}
    tilt = rotation([1.0, 0.2, 0.3], 0.6)
    for speed in (np.zeros(3), np.array([5.0, 1.0, -2.0]), np.array([1.0, 0.0, 9.0])):
        with Simulation({"mesh": grid(2, 1, 2, 1), "wind": block}, MPI.COMM_SELF) as simulation:
            # stretched: the force counts rest area all the same
            simulation.set_state(x=1.5 * simulation.x @ tilt.T)
            relative, normal = wind - speed, tilt @ [0.0, 0.0, 1.0]
            along = relative @ normal
            expected = 2.0 * (density * abs(along) * along * normal + drag * (relative - along * normal))
            force = wind_on(simulation, np.tile(speed, (6, 1)))
            np.testing.assert_allclose(force.sum(axis=0), expected, rtol=1e-12)


def test_wind_does_not_depend_on_the_side_of_the_sheet(tmp_path: Path) -> None:
    block = {"velocity": [0.0, 1.0, 2.0], "density": 1.0, "drag": 0.2}
    forces = []
    for name, faces in (("up", "f 1 2 3\n"), ("down", "f 1 3 2\n")):
        path = tmp_path / f"{name}.obj"
        path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0.5\n" + faces)
        with Simulation({"mesh": {"file": str(path)}, "wind": block}, MPI.COMM_SELF) as simulation:
            forces.append(simulation.gather(wind_on(simulation, np.zeros((3, 3)))))
    np.testing.assert_allclose(forces[0], forces[1], rtol=1e-13)
