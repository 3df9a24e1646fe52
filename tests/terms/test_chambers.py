"""Gas and liquid in closed volumes: which surfaces are closed, and the law of the gas."""

from __future__ import annotations

from itertools import combinations, pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from closed_surfaces import sewn_layers, sphere, walled_box
from examples import example
from mpi4py import MPI
from oracle import frozen_by, gradient
from physics import CLOTH, Simulation, grid, obj_file, scene_of

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.closed_surface import branches, holes, outward, sewn_shut
from lyra_petsc.mesh.seams import SeamSide, SewnCurves, Ties
from lyra_petsc.terms.chambers import BULK_MODULUS, Chambers

pytestmark = pytest.mark.quick


def built(mesh: dict[str, Any], *loads: dict[str, Any], **more: Any) -> Simulation:
    material = CLOTH | {"bending_model": "midedge"}
    return Simulation({"mesh": mesh, "material": material, "loads": list(loads)} | more, MPI.COMM_SELF)


def chambers(simulation: Simulation) -> Chambers:
    term = simulation.problem.terms["chambers"]
    assert isinstance(term, Chambers)
    return term


def refusal(mesh: dict[str, Any], *loads: dict[str, Any]) -> InputError:
    with pytest.raises(InputError) as caught, built(mesh, *loads):
        pass
    return caught.value


def open_sphere(path: Path, *missing: int) -> dict[str, Any]:
    vertices, triangles = sphere(4)
    return obj_file(path, vertices, np.delete(triangles, missing, axis=0))


def test_a_polyhedron_has_its_volume_whatever_its_normals(tmp_path: Path) -> None:
    vertices, triangles = sphere(1)
    for turned in (0, 8):
        mixed = np.concatenate([triangles[:turned, ::-1], triangles[turned:]])
        with built(obj_file(tmp_path / "octahedron.obj", vertices, mixed), {"gas": {"pressure": 5.0}}) as own:
            (row,) = chambers(own).table_rows(own.equations.x, frozen_by(chambers(own), own.equations))
            notes = [note for note in own.problem.whole.notes if "inwards" in note]
        assert row[0] == "gas"
        assert row[1:] == pytest.approx((4.0 / 3.0, 5.0, 1.0))
        assert len(notes) == bool(turned)


def test_each_side_of_a_wall_is_a_chamber(tmp_path: Path) -> None:
    loads = [
        {"gas": {"group": [side, "wall"], "name": side, "pressure": pressure}}
        for side, pressure in (("left", 30.0), ("right", -20.0))
    ]
    with built(walled_box(tmp_path / "box.obj", 2), *loads) as own:
        term, x = chambers(own), own.equations.x
        frozen = frozen_by(term, own.equations)
        rows = term.table_rows(x, frozen)
        force = -gradient(term, x, frozen)
    assert [row[0] for row in rows] == ["left", "right"]
    assert [row[1:3] for row in rows] == [pytest.approx((1.0, 30.0)), pytest.approx((1.0, -20.0))]
    middle = int(np.flatnonzero(np.abs(x - [1.0, 0.5, 0.5]).max(axis=1) < 1e-9)[0])
    # both push the wall to the right, on a quarter of it
    np.testing.assert_allclose(force[middle], [0.25 * 50.0, 0.0, 0.0], rtol=0, atol=1e-6)
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-6)


def test_holes_are_named(tmp_path: Path) -> None:
    gas = {"gas": {"pressure": 5.0}}
    error = refusal(open_sphere(tmp_path / "open.obj", 0, 127), gas)
    assert "2 holes" in error.message
    assert error.message.count("(3 edges)") == 2
    assert error.key == "loads[0].gas"
    error = refusal(grid(1.0, 2.0, 2, 2), gas)
    assert "1 hole: 6 m long (8 edges) around (0.5, 1, 0)" in error.message


@pytest.mark.parametrize("numbers", [(3, 3), (3, 5)])
def test_a_surface_is_closed_over_the_gaps_of_its_seams(numbers: tuple[int, ...]) -> None:
    gas = {"gas": {"pressure": 5.0}}
    content = sewn_layers(numbers, 0.01, {"close": {"until": 0.1}}) | {"material": CLOTH, "loads": [gas]}
    with Simulation(content, MPI.COMM_SELF) as own:
        term, x = chambers(own), own.equations.x
        frozen = frozen_by(term, own.equations)
        ((_, volume, *_),) = term.table_rows(x, frozen)
        assert volume == pytest.approx(4e-4, rel=1e-12)
        force = -gradient(term, x, frozen)
        np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-9)
        # the strips of the gaps are pushed outwards: half of their load is on each side
        right = np.abs(x[:, 0] - 0.2) < 1e-9
        below = right & (x[:, 2] < 1e-9)
        assert force[right, 0].sum() == pytest.approx(5.0 * 0.2 * 0.01, rel=1e-6)
        assert 0.3 < force[below, 0].sum() / force[right, 0].sum() < 0.7
        # as the sides close the gap vanishes, and the layers enclose what is between them
        x, corners = x.copy(), own.problem.terms["membrane"].stencil
        upper = x[corners[:, 0], 2] > 0.005
        edge = (np.abs(x[:, :2] - 0.1) > 0.1 - 1e-9).any(axis=1)
        x[edge, 2] = 0.005
        ((_, volume, *_),) = term.table_rows(x, frozen)
    one, other = (x[corners][:, k, :2] - x[corners][:, 0, :2] for k in (1, 2))
    below_each = (
        0.5 * np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]) * x[corners][:, :, 2].mean(axis=1)
    )
    assert volume == pytest.approx(below_each[upper].sum() - below_each[~upper].sum(), rel=1e-12)


def side(vertices: list[int]) -> SeamSide:
    return SeamSide(np.array(vertices), np.linspace(0.0, 1.0, len(vertices)))


def joined(one: list[int], other: list[int]) -> SewnCurves:
    none = Ties(np.empty((0, 3), dtype=np.int64), np.empty(0), np.empty(0))
    return SewnCurves((side(one), side(other)), 0, none)


def assert_closed(points: Array, triangles: Ints, volume: float) -> None:
    assert not holes(points, triangles)
    assert not len(branches(triangles))
    oriented, common = outward(points, triangles)
    assert common >= 0
    corners = points[oriented]
    assert np.linalg.det(corners).sum() / 6.0 == pytest.approx(volume, rel=1e-12)


def test_closed_curves_are_sewn_to_a_drum() -> None:
    # two fans of 5 and 7 triangles above each other
    points, triangles, rims = [], [], []
    for n, z in ((5, 0.0), (7, 1.0)):
        first = len(points)
        angles = 2.0 * np.pi * np.arange(n) / n
        points += [(0.0, 0.0, z), *((np.cos(a), np.sin(a), z) for a in angles)]
        rims.append([first + 1 + k % n for k in range(n + 1)])
        triangles += [(first, a, b) for a, b in pairwise(rims[-1])]
    shut = sewn_shut(np.array(triangles), [joined(*rims)])
    assert len(shut) == len(triangles) + 12
    assert not holes(np.array(points), shut)
    assert outward(np.array(points), shut)[1] >= 0


def test_corners_between_the_gaps_of_seams_are_filled() -> None:
    # the faces of a cube, drawn apart by 0.1: twelve seams, and eight corners of three faces
    faces = []
    for axis, at in product(range(3), (-1.1, 1.1)):
        for corner in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            point = np.insert(np.array(corner, dtype=np.float64), axis, at)
            faces.append(point)
    points = np.array(faces)
    triangles = np.array(
        [(4 * k + a, 4 * k + b, 4 * k + c) for k in range(6) for a, b, c in ((0, 1, 2), (0, 2, 3))]
    )
    edges = [(4 * k + a, 4 * k + (a + 1) % 4) for k in range(6) for a in range(4)]
    places = np.round(points)  # of the corners of the cube
    seams = [
        joined(list(one), list(other) if (places[one[0]] == places[other[0]]).all() else list(other[::-1]))
        for one, other in combinations(edges, 2)
        if {tuple(places[v]) for v in one} == {tuple(places[v]) for v in other}
    ]
    assert len(seams) == 12
    shut = sewn_shut(triangles, seams)
    assert len(shut) == 12 + 24 + 8
    # the cube of 2.2 without prisms at its edges and what is left at its corners
    corner = 0.1**3 - 0.1**3 / 6.0
    assert_closed(points, shut, 2.2**3 - 12 * 2.0 * 0.1**2 / 2.0 - 8 * corner)


def test_an_open_side_is_no_gap() -> None:
    content = sewn_layers((3, 3), 0.01, {}) | {"material": CLOTH, "loads": [{"gas": {"pressure": 5.0}}]}
    content["seams"] = content["seams"][1:]  # not the left one
    with pytest.raises(InputError) as caught, Simulation(content, MPI.COMM_SELF):
        pass
    assert "1 hole: 0.42 m long (8 edges) around (0, 0.1, 0.005)" in caught.value.message


@pytest.mark.parametrize(
    ("load", "words"),
    [
        ({"gas": {"pressure": 5.0}}, "edges of more than two triangles"),
        ({"gas": {"pressure": 5.0, "group": "left"}}, "1 hole: 4 m long"),
        ({"gas": {"pressure": 5.0, "group": ["left", "walls"]}}, "no group 'walls'"),
    ],
)
def test_chambers_that_are_not_closed_are_refused(load: dict[str, Any], words: str, tmp_path: Path) -> None:
    assert words in refusal(walled_box(tmp_path / "box.obj", 1), load).message


def test_a_surface_without_an_inside_has_no_orientation() -> None:
    # a Klein bottle of 4 × 4 squares, one of its directions reversed where it closes
    n, triangles = 4, []

    def vertex(i: int, j: int) -> int:
        return (i % n) * n + (j if i < n else -j) % n

    for i, j in np.ndindex(n, n):
        a, b, c, d = vertex(i, j), vertex(i + 1, j), vertex(i + 1, j + 1), vertex(i, j + 1)
        triangles += [(a, b, c), (a, c, d)]
    vertices = np.random.default_rng(1).uniform(size=(n * n, 3))
    assert not holes(vertices, np.array(triangles))
    assert outward(vertices, np.array(triangles))[1] == -1


def test_a_flat_start_holds_no_gas(tmp_path: Path) -> None:
    vertices, triangles = sphere(2)
    flat = obj_file(tmp_path / "flat.obj", vertices * [1.0, 1.0, 1e-9], triangles)
    assert "no gas" in refusal(flat, {"gas": {"pressure": 5.0}}).message


@pytest.mark.parametrize(
    ("load", "words"),
    [
        ({"pressure": 200.0, "volume": 0.1}, "gas: {pressure: 200}"),
        ({"gas": {"pressure": 200.0, "volume": 0.1}}, "liquid: {volume: 0.1}"),
        ({"gas": {"pressure": 200.0}, "group": "all"}, "belongs into the block"),
        ({"gas": {"pressure": 200.0}, "until": 3.0}, "acts always"),
        ({"gas": {"pressure": -2e5}}, "must be > -ambient"),
        ({"gas": {"pressure": 1.0, "amount": [[0, 1], [1, 0]]}}, "must be > 0, not 0"),
        ({"gas": {"pressure": 1.0, "group": ["a", "a"]}}, "each group once"),
        ({"gas": {"pressure": 1.0}, "liquid": {"volume": 1.0}}, "exactly one of"),
    ],
)
def test_wrong_keys_are_explained(load: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        scene_of({"mesh": grid(1.0, 1.0, 1, 1), "loads": [load]})
    assert words in str(caught.value)


@pytest.mark.parametrize("exponent", [1.0, 1.4])
def test_the_law_of_the_gas(exponent: float, tmp_path: Path) -> None:
    amount, ambient, pressure = 1.7, 1000.0, 300.0
    vertices, triangles = sphere(3)
    load = {"pressure": pressure, "ambient": ambient, "amount": amount, "exponent": exponent}
    with built(obj_file(tmp_path / "ball.obj", vertices, triangles), {"gas": load}) as own:
        term, x = chambers(own), own.equations.x
        frozen = frozen_by(term, own.equations)
        ((_, start, *_),) = term.table_rows(x, frozen)
        for size in (0.5, 1.0, 1.6):
            ((_, volume, gauge, _),) = term.table_rows(size * x, frozen)
            constant = amount**exponent * (pressure + ambient) * start**exponent
            assert (gauge + ambient) * volume**exponent == pytest.approx(constant, rel=1e-12)
            assert term.energies(size * x, frozen).sum() >= 0.0
        relaxed = amount ** (1.0 / 3.0) * (1.0 + pressure / ambient) ** (1.0 / (3.0 * exponent))
        assert term.energies(relaxed * x, frozen).sum() == pytest.approx(0.0, abs=1e-9)
        assert np.isinf(term.energies(-x, frozen).sum())


def test_liquid_is_as_stiff_as_water(tmp_path: Path) -> None:
    vertices, triangles = sphere(3)
    with built(obj_file(tmp_path / "ball.obj", vertices, triangles), {"liquid": {}}) as own:
        term, x = chambers(own), own.equations.x
        frozen = frozen_by(term, own.equations)
        pressures = [term.table_rows(size * x, frozen)[0][2] for size in (1.0, 1.0 - 1e-6)]
    assert pressures[0] == 0.0
    assert pressures[1] == pytest.approx(3e-6 * BULK_MODULUS, rel=1e-4)


@pytest.mark.parametrize("centre", [0.0, 1.0, 30.0])
def test_pressures_of_round_off_are_none(centre: float, tmp_path: Path) -> None:
    vertices, triangles = sphere(9, 0.3)
    path = obj_file(tmp_path / "ball.obj", vertices + centre, triangles)
    with built(path, {"gas": {"pressure": 0.0}}) as own:
        term, x = chambers(own), own.equations.x
        frozen = frozen_by(term, own.equations)
        assert term.table_rows(x, frozen)[0][2] == 0.0
        inflated = centre + (1.0 + 1e-12) * (x - centre)
        assert term.table_rows(inflated, frozen)[0][2] == pytest.approx(-3 * 1.4e-12 * 101325.0, rel=0.1)


def test_force_scale_bounds_the_round_off(tmp_path: Path) -> None:
    far = 100.0
    with example("chambers", tmp_path) as own:
        term, x = chambers(own), own.equations.x
        frozen = frozen_by(term, own.equations)
        scale = term.force_scale(far + 1.0)
        sums = np.bincount(term.stencil.ravel(), np.repeat(scale, 3), len(x))
        there = gradient(term, x + far, frozen_by(term, own.equations, x + far))
        noise = np.linalg.norm(there - gradient(term, x, frozen))
    assert 0.0 < noise <= 10.0 * np.finfo(float).eps * np.linalg.norm(sums)
