"""Bending with one unknown on every edge: convergence, frames, clamps, resumed runs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from examples import BENDING, curved_sheet
from mpi4py import MPI
from numpy.typing import NDArray
from oracle import differences, directors_along_normals, gradient, hessian
from physics import (
    CLOTH,
    Simulation,
    end_on_one_rank,
    gathered,
    grid,
    mirrored,
    obj_file,
    reference,
    rotation,
    scene_of,
    symmetry_planes,
)

from lyra_petsc.errors import InputError
from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.meshes import rectangle, walls
from lyra_petsc.experiments.verification.cases.shells import (
    symmetric,
)
from lyra_petsc.output.recorder import Recorder
from lyra_petsc.stepping.simulation import SteppedScene as Run
from lyra_petsc.terms.bending.midedge import MidEdge
from lyra_petsc.terms.bending.midedge_shape import unit
from lyra_petsc.terms.loads.moment import Moment

Array = NDArray[np.float64]

PLATE = {"d11": 1.0, "d22": 1.0, "d12": 0.3, "d33": 0.35}
STIFF = {"density": 1.0, "membrane": {"c11": 1e6, "c22": 1e6, "c12": 0.0, "c33": 5e5}, "bending": PLATE}
TIGHT = {"force_tolerance": 1e-10, "step_tolerance": 1e-10}
STEPS = {"end": 0.08, "step": 0.01}
SHEET: dict[str, Any] = {
    "mesh": grid(0.6, 0.4, 5, 4, "alternating"),
    "material": CLOTH | {"bending": 2e-2, "bending_model": "midedge", "damping": 0.005},
    "gravity": [0, 0, -9.81],
    "handles": [{"box": [[-1, -1, -1], [0.01, 1, 1]], "clamp": True}],
    "solver": TIGHT,
}


def midedge_of(simulation: Simulation | Run) -> MidEdge:
    term = simulation.problem.terms["midedge"]
    assert isinstance(term, MidEdge)
    return term


# -- the energy ----------------------------------------------------------------------------------------


def cylinder(pattern: str, n: int) -> float:
    """Energy over ½ B κ² A of a sheet rolled up to κ = 1 with directors along the exact normals."""
    with Simulation({"mesh": grid(1.0, 1.0, n, n, pattern), "material": STIFF}, MPI.COMM_SELF) as simulation:
        term, x = midedge_of(simulation), simulation.equations.x.copy()
        rows = slice(0, simulation.problem.points.n_vertices)
        flat, edges = x[rows].copy(), term.of_edges
        x[rows] = np.column_stack([np.sin(flat[:, 0]), flat[:, 1], 1.0 - np.cos(flat[:, 0])])
        term.initialise(x)
        tangent, across = term.frames.vectors
        middle = flat[edges.ends].mean(axis=1)[:, 0]
        normal = np.column_stack([-np.sin(middle), np.zeros(len(middle)), np.cos(middle)])
        sine = np.sum(np.cross(tangent, across) * normal, axis=1)
        x.ravel()[edges.indices] = edges.length * np.arctan2(sine, np.sum(across * normal, axis=1))
        return float(term.energies(x, term.frames).sum()) / 0.5


@pytest.mark.parametrize("pattern", ["diagonal", "alternating", "criss-cross"])
def test_energy_of_a_cylinder(pattern: str) -> None:
    """½ D11 κ² per area, with a discretisation error of second order."""
    errors = [abs(cylinder(pattern, n) - 1.0) for n in (4, 8, 16)]
    assert errors[0] < 0.03
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders.min() > 1.8


def test_moments_and_forces_balance_under_rotation(tmp_path: Path) -> None:
    """Σ x × f + Σ m t = 0 with frames of the edges' present directions."""
    content = {
        "mesh": curved_sheet(tmp_path / "sheet.obj"),
        "material": BENDING | {"bending_model": "midedge"},
    }
    with Simulation(content, MPI.COMM_SELF) as simulation:
        term, n = midedge_of(simulation), simulation.problem.points.n_vertices
        random = np.random.default_rng(2)
        x = simulation.equations.x.copy()
        x[:n] = (x[:n] + random.uniform(-0.1, 0.1, (n, 3))) @ rotation([1.0, 2.0, 0.5], 0.9).T
        x.ravel()[term.of_edges.indices] = directors_along_normals(term, x)
        before = term.energies(x, term.frames)
        term.accept(x, term.frames)
        np.testing.assert_allclose(term.energies(x, term.frames), before, rtol=1e-12)
        pull = gradient(term, x, term.frames)
        moments = pull.ravel()[term.of_edges.indices] * term.of_edges.length
        torque = np.cross(x[:n], pull[:n]).sum(axis=0) + moments @ term.frames.direction
        assert np.abs(torque).max() < 1e-13 * np.abs(pull).max()


@pytest.mark.parametrize("degrees", [40, 50, 85, 95, 140, 175])
def test_derivatives_at_any_angle(tmp_path: Path, degrees: float) -> None:
    """Gradient and Hessian at large angles between directors and normals."""
    content = {
        "mesh": curved_sheet(tmp_path / "sheet.obj"),
        "material": BENDING | {"bending_model": "midedge"},
    }
    with Simulation(content, MPI.COMM_SELF) as simulation:
        term, x = midedge_of(simulation), simulation.equations.x.copy()
        turn = np.radians(degrees) * np.resize([1.0, -1.0, 1.0, 1.0], len(term.edge_indices))
        places, length = term.edge_indices, term.of_edges.length
        x.ravel()[places] = directors_along_normals(term, x) + length * turn
        analytic = gradient(term, x, term.frames)
        numeric = differences(lambda z: term.energies(z, term.frames).sum(), x, 1e-4)
        np.testing.assert_allclose(analytic, numeric, rtol=0.0, atol=1e-7 * np.abs(analytic).max())
        exact = hessian(term, x, term.frames, 0.0)
        numeric = differences(lambda z: gradient(term, z, term.frames), x, 1e-4)
        np.testing.assert_allclose(exact, numeric, rtol=0.0, atol=1e-7 * np.abs(exact).max())
        regularised = hessian(term, x, term.frames, 1.0).reshape(x.size, x.size)
        assert np.linalg.eigvalsh(regularised)[0] > -1e-12 * np.abs(regularised).max()


def test_energy_is_continuous_at_all_angles() -> None:
    """It grows up to 180° on either side, to the same value for flat sheets."""
    with Simulation({"mesh": grid(1.0, 1.0, 1, 1), "material": STIFF}, MPI.COMM_SELF) as simulation:
        term, x = midedge_of(simulation), simulation.equations.x.copy()
        direction = np.zeros_like(x)
        direction.ravel()[term.of_edges.indices] = term.of_edges.length * [1.0, 0.1, 0.2, -0.1, 0.3]

        def energy(turn: float) -> float:
            return float(term.energies(x + turn * direction, term.frames).sum())

        assert energy(np.pi - 1e-9) == pytest.approx(energy(np.pi + 1e-9), rel=1e-7)
        assert energy(0.25 * np.pi - 1e-9) == pytest.approx(energy(0.25 * np.pi + 1e-9), rel=1e-7)
        values = [energy(turn) for turn in np.linspace(0.0, np.pi, 20)]
        assert (np.diff(values) > 0.0).all()


@pytest.mark.parallel(2)
def test_one_linear_solve_a_step_unfolds_a_crumpled_sheet(comm: MPI.Comm) -> None:
    """The solve rotates directors beyond a right angle, where the energy was once unbounded."""
    scene: dict[str, Any] = {
        "mesh": grid(1.0, 1.0, 20, 20, "alternating"),
        "material": CLOTH | {"bending": 1e-4, "bending_model": "midedge", "damping": 0.005},
        "handles": [{"nodes": [0, 20]}],
        "initial": {"noise": 0.2, "seed": 1},
        "time": {"end": 0.05, "step": 0.005, "integrator": "semi-implicit"},
        "solver": {},
    }
    _, energies = outcome(comm, scene)
    assert np.isfinite(energies).all()


@pytest.mark.parametrize("pattern", ["diagonal", "alternating", "criss-cross"])
@pytest.mark.parametrize("clamp", [True, False])
def test_plates_converge(pattern: str, clamp: bool) -> None:
    """Clamped and supported squares under uniform load: Timoshenko & Woinowsky-Krieger, tables 8 and 35."""
    errors = []
    for n in (8, 16):
        box = (
            [[-1, -1, -1], [0, 2, 1]],
            [[1, -1, -1], [2, 2, 1]],
            [[-1, -1, -1], [2, 0, 1]],
            [[-1, 1, -1], [2, 2, 1]],
        )
        content = {
            "mesh": grid(1.0, 1.0, n, n, pattern),
            "material": STIFF,
            "handles": [{"box": each, "clamp": clamp} for each in box],
            "loads": [{"traction": [0.0, 0.0, 1e-6]}],
            "time": {"analysis": "static", "end": 1.0, "step": 1.0},
            "solver": TIGHT,
        }
        simulation = Run(MPI.COMM_SELF, scene_of(content))
        simulation.step()
        middle = n // 2 * (n + 2)
        height = gathered(simulation.problem.points, simulation.problem.equations.x)[middle, 2]
        errors.append(height / 1e-6 / (0.00126532 if clamp else 0.00406235) - 1.0)
        simulation.destroy()
    assert 0.0 < errors[1] < (0.1 if clamp else 0.02)
    assert np.log2(errors[0] / errors[1]) > 1.8


# -- steps ---------------------------------------------------------------------------------------------


def outcome(comm: MPI.Comm, scene: dict[str, Any]) -> tuple[Array, Array]:
    """Positions in mesh order, and energies and works, after a whole run."""
    simulation = Run(comm, scene_of(SHEET | scene))
    while not simulation.finished:
        simulation.step()
    budget = simulation.budget
    energies = np.array(
        [budget.kinetic, budget.membrane, budget.bending, budget.dissipation, budget.external_work]
    )
    x = gathered(simulation.problem.points, simulation.problem.equations.x)
    simulation.destroy()
    return x, energies


TURN = {
    "handles": [SHEET["handles"][0] | {"motion": "turn", "interpolation": "linear"}],
    "motions": {
        "turn": [
            {"time": 0.0},
            {"time": 1.0, "rotate": {"axis": [0, 1, 0], "degrees": 400}},
        ]
    },
}


@pytest.mark.parallel(2, alone=False)
@pytest.mark.parametrize("scheme", ["beuler", "semi-implicit", "midpoint", "bdf2", "alpha2", "static"])
def test_runs_do_not_depend_on_ranks(comm: MPI.Comm, scheme: str) -> None:
    time = {"analysis": "static"} if scheme == "static" else STEPS | {"integrator": scheme}
    scene = TURN | {"time": time} if scheme != "static" else {"time": time}
    x, energies = outcome(comm, scene)
    alone = outcome(MPI.COMM_SELF, scene) if comm.rank == 0 else (x, energies)
    tolerance = 1e-5 if scheme == "semi-implicit" else 1e-8  # one linear solve, to 1e-6
    np.testing.assert_allclose(x, alone[0], rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(
        energies, alone[1], rtol=1e-3 if scheme == "semi-implicit" else 1e-6, atol=1e-9
    )


@pytest.mark.parametrize("scheme", ["midpoint", "bdf2", "alpha2"])
def test_order_with_a_turning_clamp(scheme: str) -> None:
    """Order of convergence, from runs with half the step."""
    smoothly = {
        "handles": [SHEET["handles"][0] | {"motion": "turn"}],
        "motions": {"turn": [{"time": 0.0}, {"time": 0.1, "rotate": {"axis": [0, 1, 0], "degrees": 60}}]},
        "output": {"every": 0.04},
        "material": SHEET["material"] | {"damping": 0.0},
    }
    ends = [
        outcome(MPI.COMM_SELF, smoothly | {"time": {"end": 0.04, "step": step, "integrator": scheme}})
        for step in (0.004, 0.002, 0.001)
    ]
    moved = [np.abs(a[0] - b[0]).max() for a, b in pairwise(ends)]
    assert np.log2(moved[0] / moved[1]) > 1.8


@pytest.mark.parametrize("scheme", ["midpoint", "bdf2", "alpha2"])
def test_order_with_damping(scheme: str) -> None:
    """Order of convergence, from runs with half the step; damping acts on directors, which have no mass.

    Accelerations at the start of a moving sheet need the rates of its directors.
    """
    start = {"initial": {"velocity": [0, 0, 1]}}
    ends = [
        outcome(MPI.COMM_SELF, start | {"time": {"end": 0.04, "step": step, "integrator": scheme}})
        for step in (0.004, 0.002, 0.001)
    ]
    moved = [np.abs(a[0] - b[0]).max() for a, b in pairwise(ends)]
    assert np.log2(moved[0] / moved[1]) > 1.8


def test_a_clamp_rotates_the_sheet() -> None:
    """A weightless sheet that is slowly rotated about its clamped edge moves as a rigid body."""
    degrees = 400.0
    keyframes = [{"time": 0.0}, {"time": 200.0, "rotate": {"axis": [0, 1, 0], "degrees": degrees}}]
    scene = TURN | {
        "mesh": grid(0.4, 0.1, 4, 1),
        "material": SHEET["material"] | {"damping": 0.0},  # with steps of 10° rates are inexact
        "gravity": [0, 0, 0],
        "motions": {"turn": keyframes},
        "time": {"end": 200.0, "step": 5.0},
        "output": {"every": 5.0},
    }
    x, energies = outcome(MPI.COMM_SELF, scene)
    expected = np.array([[0.1 * i, 0.1 * j, 0.0] for j in range(2) for i in range(5)])
    np.testing.assert_allclose(x, expected @ rotation([0, 1, 0], np.radians(degrees)).T, atol=1e-5)
    assert energies[2] < 1e-9


RIGHT = [[0.59, -1, -1], [1, 1, 1]]
SLIDING = {"box": RIGHT, "axes": ["z"], "clamp": True}


@pytest.mark.parallel(2)
def test_a_clamped_edge_slides_in_the_plane_of_the_sheet(comm: MPI.Comm) -> None:
    """Pulled sideways until it has turned far in its plane; under the weight its slope stays 0."""
    sideways = {
        "handles": [SHEET["handles"][0], SLIDING],
        "material": STIFF | {"membrane": {"c11": 10.0, "c22": 10.0, "c12": 3.0, "c33": 3.0}},
        "gravity": [0, 0, 0],
        "loads": [{"box": RIGHT, "force": [0, 0.1, 0]}],
        "time": {"analysis": "static", "step": 0.5},
    }
    x, energies = outcome(comm, sideways)
    edge = x[-1] - x[5]
    assert abs(edge[0]) > 0.3 * edge[1]
    assert energies[1] > 1e-3
    assert energies[2] < 1e-12
    light = {"material": STIFF | {"density": 1e-6}, "time": {"analysis": "static", "step": 1.0}}
    ends = SLIDING, {"box": RIGHT, "clamp": True}, {"box": RIGHT}
    held = [outcome(comm, light | {"handles": [SHEET["handles"][0], end]})[0][:, 2] for end in ends]
    np.testing.assert_allclose(held[0], held[1], rtol=0, atol=1e-6 * np.abs(held[1]).max())
    assert np.abs(held[2]).max() > 1.5 * np.abs(held[1]).max()


@pytest.mark.parametrize(
    ("handle", "more", "words"),
    [
        (SLIDING | {"axes": ["x", "y"]}, {}, "not along z out of it"),
        (SLIDING, {"material": CLOTH | {"bending": 2e-2, "bending_model": "hinge"}}, "not kept by hinges"),
        (SLIDING | {"motion": "turn"}, {"motions": TURN["motions"]}, "turns and slides"),
    ],
)
def test_clamps_that_cannot_slide_are_refused(
    handle: dict[str, Any], more: dict[str, Any], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        Run(MPI.COMM_SELF, scene_of(SHEET | {"handles": [handle]} | more))


@pytest.mark.parallel
@pytest.mark.parametrize("scheme", ["beuler", "alpha2"])
def test_a_run_resumes_on_other_ranks(comm: MPI.Comm, scheme: str, shared_tmp: Path) -> None:
    scene = TURN | {"time": STEPS | {"integrator": scheme}}
    whole = outcome(comm, scene)[0]
    x = end_on_one_rank(comm, scene_of(SHEET | scene), shared_tmp / "run", steps=4)
    if comm.rank == 0:
        np.testing.assert_allclose(x, whole, rtol=0.0, atol=1e-8)


CORNER, LEAN = (0.0, 1.0), (np.sin(np.radians(20.0)), 1.0 - np.cos(np.radians(20.0)))
COLUMN = ((0.0, 0.0), CORNER)


@pytest.mark.parametrize(
    ("beams", "axis", "compliance"),
    [
        ([(CORNER, (1.0, 1.0))], 2, 1.0 / 3.0 + 1.0),
        ([(CORNER, LEAN)], 0, (LEAN[1] - 1.0) ** 2 / 3.0 + ((1.0 - LEAN[1]) ** 3 + LEAN[1] ** 3) / 3.0),
        ([(CORNER, (1.0, 1.0)), ((-1.0, 1.0), CORNER)], 2, 1.0 / 3.0 + 1.0 / 8.0),
    ],
    ids=["right angle", "fold of 160°", "three at an edge"],
)
def test_walls_that_meet_bend_as_beams(
    beams: list[Any], axis: int, compliance: float, tmp_path: Path
) -> None:
    """A clamped column with beams of the same strip at its top, loaded at the end of one beam."""
    errors = []
    for n in (8, 16):
        vertices, faces = walls([COLUMN, *beams], n, n // 4, 0.25)
        end, force = np.flatnonzero(np.isclose(vertices[:, [0, 2]], beams[0][1]).all(axis=1)), np.zeros(3)
        force[axis] = 1e-4
        clamps = [{"box": [[x - 1e-6, -1, z - 1e-6], [x + 1e-6, 1, z + 1e-6]]} for x, z in ((0, 0), (-1, 1))]
        content = {
            "mesh": obj_file(tmp_path / "frame.obj", vertices, faces),
            "material": STIFF | {"bending": PLATE | {"d12": 0.0, "d33": 0.5}},
            "gravity": [0, 0, 0],
            "handles": [clamp | {"clamp": True} for clamp in clamps[: len(beams)]],
            "loads": [{"nodes": end.tolist(), "force": force.tolist()}],
            "time": {"analysis": "static", "step": 1.0},
        }
        deflection = (outcome(MPI.COMM_SELF, content)[0] - vertices)[end, axis].mean()
        errors.append(abs(deflection / (4e-4 * compliance) - 1.0))
    assert errors[0] < 0.03
    assert errors[1] < 0.35 * errors[0]


# -- rest shapes and refusals --------------------------------------------------------------------------


@pytest.mark.parametrize("pattern", ["diagonal", "criss-cross"])
def test_rest_curvature_rolls_a_strip_up(pattern: str) -> None:
    """A free strip of rest curvature κ11 comes to rest as a cylinder on the side of its normal."""
    material = STIFF | {"bending": PLATE | {"d12": 0.0}, "rest_curvature": [0.5, 0.0, 0.0]}
    content = {
        "mesh": grid(1.0, 0.25, 16, 4, pattern),
        "material": material,
        "handles": [{"box": [[-1, -1, -1], [0, 1, 1]], "clamp": True}],
        "time": {"analysis": "static", "step": 1.0},
        "solver": {},
    }
    x, energies = outcome(MPI.COMM_SELF, content | {"gravity": [0, 0, 0]})
    tip = x[np.argmax(x[:, 0])]
    np.testing.assert_allclose([tip[0], tip[2]], [np.sin(0.5) / 0.5, (1.0 - np.cos(0.5)) / 0.5], rtol=5e-3)
    assert energies[2] < 1e-3 * 0.5 * 0.25 * 0.25


@pytest.mark.parametrize(("twist", "rolled"), [(0.8, True), (0.15, False)])
def test_a_tape_spring_is_bistable(twist: float, rolled: bool, tmp_path: Path) -> None:
    """With rest curvature κ across it is also stable rolled up by d12 κ / d11 along, if stiff in twist.

    The chords of the start are so much shorter that it would fold if the forces that hold it were released
    step by step. S. D. Guest, S. Pellegrino, Proceedings of the Royal Society A 462 (2006) 839-854.
    """
    bent, coupling, stiffness = 50.0, 0.7, 0.02
    flat, faces = rectangle(16, 8, 0.12, 0.06, alternating=True)
    radius = 1.0 / (coupling * bent)
    turn = (flat[:, 0] - 0.06) / radius
    start = np.column_stack([radius * np.sin(turn), flat[:, 1], radius * np.cos(turn)])
    rows = [f"v {x} {y} {z}" for x, y, z in start.tolist()] + [f"vt {x} {y}" for x, y, *_ in flat.tolist()]
    rows += ["f " + " ".join(f"{k}/{k}" for k in face) for face in (faces + 1).tolist()]
    (tmp_path / "tape.obj").write_text("\n".join(rows) + "\n")
    plate = {"d11": 1.0, "d22": 1.0, "d12": coupling, "d33": twist}
    stretch = 12.0 / 4e-4**2
    middle = 4 * 17 + 8
    content = {
        "mesh": {"file": str(tmp_path / "tape.obj")},
        "material": {
            "density": 0.5,
            "membrane": {key.replace("d", "c"): stretch * stiffness * value for key, value in plate.items()},
            "bending": {key: stiffness * value for key, value in plate.items()},
            "rest_curvature": [0.0, -bent, 0.0],
        },
        "gravity": [0.0, 0.0, 0.0],
        "handles": [
            {"nodes": [middle]},
            {"nodes": [middle + 1], "axes": ["y", "z"]},
            {"nodes": [middle + 17], "axes": ["z"]},
        ],
        "time": {"analysis": "static", "step": 0.25},
    }
    run = Run(MPI.COMM_SELF, scene_of(content))
    newton = 0
    while not run.finished:
        newton += run.step().newton_iterations
    term = midedge_of(run)
    found = term.curvatures(run.problem.equations.x, term.frames)[:, :2].mean(axis=0)
    expected = [-coupling * bent, 0.0] if rolled else [0.0, -bent]
    np.testing.assert_allclose(found, expected, atol=6.0 if rolled else 0.1)  # free edges bend on
    assert run.stability["stable"]
    assert newton <= (30 if rolled else 400)
    run.destroy()


def fan(path: Path, *degrees: float, flat: bool = False) -> dict[str, Any]:
    """Triangles at these angles about the edge of vertices 0 and 1; with ``flat`` the rest shape is flat."""
    angles = np.radians(degrees)
    corners = [(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), *((np.cos(a), 0.5, np.sin(a)) for a in angles)]
    # orient those at 180° along the edge like the others
    faces = [(0, 2 + k, 1) if k % 2 == 0 else (0, 1, 2 + k) for k in range(len(angles))]
    mesh = obj_file(path, corners, faces)
    if flat:
        lines = path.read_text(encoding="utf-8").splitlines()
        lines = [*lines[:4], "vt 0 0", "vt 0 1", "vt 1 0.5", "vt -1 0.5", "f 1/1 3/3 2/2", "f 1/1 2/2 4/4"]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return mesh


def test_a_start_folded_by_180_degrees_is_refused(tmp_path: Path) -> None:
    """With a flat rest shape the side of the fold is undefined."""
    material = STIFF | {"bending_model": "midedge"}
    with Simulation(
        {"mesh": fan(tmp_path / "a.obj", 0, 0.2, flat=True), "material": material}, MPI.COMM_SELF
    ):
        pass
    content = scene_of({"mesh": fan(tmp_path / "b.obj", 0, 0.05, flat=True), "material": material})
    with pytest.raises(InputError, match=r"folded by 179.9° or more at the edge of vertices 0 and 1"):
        Run(MPI.COMM_SELF, content)


@pytest.mark.parametrize(
    "degrees", [(0, 0), (0, 10), (0, 120, 240), (0, 90, 180, 270), (0, 180, 90)], ids=str
)
def test_folds_and_branches_at_rest(degrees: Sequence[float], tmp_path: Path) -> None:
    """Triangles resist rotation relative to the others as in a flat pair, at any angles between them."""
    stiffness = []
    for number, each in enumerate((degrees, (0, 180))):
        content = {"mesh": fan(tmp_path / f"{number}.obj", *each), "material": STIFF | {"bending": PLATE}}
        with Simulation(content, MPI.COMM_SELF) as simulation:
            term, x = midedge_of(simulation), simulation.equations.x.copy()
            assert np.abs(gradient(term, x, term.frames)).max() < 1e-12
            if number == 0 and degrees != (0, 10):
                assert np.abs(term.curvatures(x, term.frames)).max() < 1e-12
            x.ravel()[term.edge_indices] = term.reset_frames(x)
            assert term.energies(x, term.frames).max() < 1e-24
            tip = np.flatnonzero(np.isclose(x, [1.0, 0.5, 0.0]).all(axis=1))[0]
            stiffness.append(hessian(term, x, term.frames)[tip, 2, tip, 2])
    assert stiffness[0] == pytest.approx(stiffness[1])


def test_rest_curvature_beyond_180_degrees_per_edge_is_refused() -> None:
    """Triangles of cells of 0.1 m have the tangent T = κ / 20 m, which is 1 + 3π/2 at 180°."""
    sheet = {"mesh": {"grid": {"width": 0.5, "height": 0.2, "nx": 5, "ny": 2}}}
    material = STIFF | {"bending_model": "midedge"}
    with Simulation(sheet | {"material": material | {"rest_curvature": [114.0, 0.0, 0.0]}}, MPI.COMM_SELF):
        pass
    content = scene_of(sheet | {"material": material | {"rest_curvature": [115.0, 0.0, 0.0]}})
    with pytest.raises(InputError, match=r"by more than 180° .* finer by 1, or less") as caught:
        Run(MPI.COMM_SELF, content)
    assert caught.value.key == "material[0].rest_curvature"


@pytest.mark.parametrize(("n", "alternating"), [(8, False), (24, False), (24, True)])
def test_a_coarse_shell_is_noted(tmp_path: Path, n: int, alternating: bool) -> None:
    """A quarter cylinder of radius 1 and thickness 0.01, √(t R) = 0.1; ``alternating``: with vertices of four
    and of eight triangles.
    """
    flat, faces = rectangle(n, n, 0.5 * np.pi, 1.0, alternating=alternating)
    bent = np.column_stack([np.sin(flat[:, 0]), flat[:, 1], np.cos(flat[:, 0])])
    material = {"young": 1e6, "poisson": 0.0, "thickness": 0.01, "density": 1.0}
    content = {"mesh": obj_file(tmp_path / "shell.obj", bent, faces), "material": material}
    found = coarse(content)
    assert len(found) == (1 if n == 8 else 0)
    assert not noted(content, "triangles of a curved shell")
    assert all("√(t R) = 0.1 m" in note or "√(t R) = 0.0" in note for note in found)


def octant(path: Path, n: int) -> dict[str, Any]:
    """An eighth of a sphere of radius 1 whose edges have n cells; four triangles meet at its corners."""
    row, place = np.array([(i, j) for i in range(n + 1) for j in range(n + 1 - i)]).T
    x = np.column_stack([row, place, n - row - place]) / n
    number = {(i, j): k for k, (i, j) in enumerate(zip(row.tolist(), place.tolist(), strict=True))}
    up = [((i, j), (i + 1, j), (i, j + 1)) for i, j in number if i + j < n]
    down = [((i + 1, j), (i + 1, j + 1), (i, j + 1)) for i, j in number if i + j < n - 1]
    faces = np.array([[number[corner] for corner in triangle] for triangle in up + down])
    return obj_file(path, x / np.linalg.norm(x, axis=1, keepdims=True), faces)


BALL = {"young": 1e7, "poisson": 0.3, "thickness": 0.04, "density": 1.0}


def test_vertices_of_four_triangles_in_a_curved_shell_are_noted(tmp_path: Path) -> None:
    """With the right error; free corners are not noted, nor are vertices of finer meshes."""
    pressure = 10.0
    ball = {"mesh": octant(tmp_path / "ball.obj", 16), "material": BALL, "handles": symmetric("xyz", 1.0)}
    load = {"loads": [{"pressure": pressure}], "time": {"analysis": "static", "step": 1.0}}
    run = Run(MPI.COMM_SELF, scene_of(ball | load))
    (said,) = (re.search(r"vertex (\d+) \(and 2 more\) only 4 .* about (\d+)% too", n) for n in run.notes)
    assert said is not None
    run.step()
    radius = np.linalg.norm(run.problem.equations.x[: run.problem.points.n_vertices], axis=1)
    run.destroy()
    given = pressure * (1.0 - BALL["poisson"]) / (2.0 * BALL["young"] * BALL["thickness"])
    lacking = 1.0 - (radius - 1.0) / given
    assert np.argmax(lacking) in (0, 16, len(radius) - 1)
    assert abs(lacking.max() - 0.01 * int(said[2])) < 0.02
    assert not noted(ball | {"handles": []}, "triangles of a curved shell")
    finer = {"mesh": octant(tmp_path / "finer.obj", 32)}
    assert not noted(ball | finer, "triangles of a curved shell")


def coarse(content: dict[str, Any]) -> list[str]:
    """Notes on triangles that are too large."""
    return noted(content, "large for the curvature")


def noted(content: dict[str, Any], words: str) -> list[str]:
    simulation = Run(MPI.COMM_SELF, scene_of(content))
    found = [note for note in simulation.notes if words in note]
    simulation.destroy()
    return found


THIN = {"young": 1e6, "poisson": 0.3, "thickness": 0.01, "density": 1.0}


@pytest.mark.parametrize("thickness", [0.01, 0.1])
def test_strips_as_narrow_as_thick_are_noted(thickness: float) -> None:
    """At 10 times their thickness they twist 0.63/10 too little; clamped, symmetric edges are not free."""
    content = {
        "mesh": grid(8.0, 1.0, 16, 2),
        "material": THIN | {"thickness": thickness},
        "handles": [{"group": "left", "clamp": True}, {"group": "right", "symmetry": "x"}],
    }
    found = noted(content, "transverse shear")
    assert len(found) == (1 if thickness == 0.1 else 0)
    assert all("torsional stiffness is about 6% too large" in note for note in found)
    everywhere = [{"group": "sheet", "clamp": True}]
    assert not noted(content | {"handles": everywhere}, "transverse shear")


def test_supported_edges_are_not_free() -> None:
    content = {"mesh": grid(8.0, 1.0, 16, 2), "material": THIN | {"thickness": 0.1}}
    rim = [{"group": group, "axes": ["z"]} for group in ("left", "right", "top", "bottom")]
    assert noted(content, "transverse shear")
    assert not noted(content | {"handles": rim}, "transverse shear")


@pytest.mark.parametrize(
    ("degrees", "power", "hold", "corner"),
    [
        (30, 1, {"axes": ["z"]}, "the corner of 150° .* 1 more"),
        (30, 4, {"axes": ["z"]}, ""),  # graded towards its corners
        (90, 1, {"axes": ["z"]}, ""),
        (30, 1, {"clamp": True}, ""),
        (30, 1, {"axes": ["x", "y"]}, ""),  # free
        (30, 1, {"axes": ["z"], "nodes": list(range(169))}, ""),  # held in its plane
    ],
)
def test_obtuse_corners_of_supports_are_noted(
    degrees: float, power: int, hold: dict[str, Any], corner: str, tmp_path: Path
) -> None:
    """Moments grow as r^(π/ω − 2) at a corner of angle ω between two simple supports."""
    n = 12
    flat, faces = rectangle(n, n, 1.0, 1.0)
    near = 0.5 * (2.0 * np.minimum(flat, 1.0 - flat)) ** power
    x, y = np.where(flat < 0.5, near, 1.0 - near)[:, :2].T
    angle = np.radians(degrees)
    vertices = np.column_stack([x + np.cos(angle) * y, np.sin(angle) * y, 0.0 * x])
    rim = np.flatnonzero(np.isclose(flat[:, :2] % 1.0, 0.0).any(axis=1)).tolist()
    content = {"mesh": obj_file(tmp_path / "skew.obj", vertices, faces), "material": THIN}
    found = noted(content | {"handles": [{"nodes": rim} | hold]}, "unbounded moments")
    assert len(found) == (1 if corner else 0)
    assert all(re.search(corner, note) for note in found)


def test_reentrant_corners_of_supports_are_noted(tmp_path: Path) -> None:
    flat, faces = rectangle(8, 8, 1.0, 1.0)
    shape = faces[(flat[faces].mean(axis=1)[:, :2] < 0.5).any(axis=1)]
    used, shape = np.unique(shape, return_inverse=True)
    x, y = flat[used, 0], flat[used, 1]
    mesh = obj_file(tmp_path / "ell.obj", np.column_stack([x, y, 0.0 * x]), shape.reshape(-1, 3))
    within = (x > 0.0) & (y > 0.0) & (x < 1.0) & (y < 1.0) & ((x < 0.5) | (y < 0.5))
    rim = [{"nodes": np.flatnonzero(~within).tolist(), "axes": ["z"]}]
    (found,) = noted({"mesh": mesh, "material": THIN, "handles": rim}, "unbounded moments")
    assert re.search("the corner of 270° .* to 0.0006 m", found)


def test_a_polygon_for_a_disc_has_no_corners(tmp_path: Path) -> None:
    turns = np.linspace(0.0, 2.0 * np.pi, 13)[:-1]
    ring = np.column_stack([np.cos(turns), np.sin(turns), 0.0 * turns])
    faces = [(0, 1 + k, 1 + (k + 1) % 12) for k in range(12)]
    mesh = obj_file(tmp_path / "disc.obj", np.vstack([np.zeros((1, 3)), ring]), np.array(faces))
    rim = [{"nodes": list(range(1, 13)), "axes": ["z"]}]
    assert not noted({"mesh": mesh, "material": THIN, "handles": rim}, "unbounded moments")


def test_walls_that_meet_are_not_noted(tmp_path: Path) -> None:
    """A fold of 45° between flat walls is no curvature, nor is that of a third wall."""
    material = {"young": 1e6, "poisson": 0.0, "thickness": 0.001, "density": 1.0}
    half = np.sqrt(0.5)
    tube = [(0, 0), (1, 0), (1 + half, half), (1 + half, 1 + half), (1, 1 + 2 * half)]
    for name, parts in {
        "tube": pairwise(tube),
        "tee": [COLUMN, (CORNER, (1.0, 1.0)), ((-1.0, 1.0), CORNER)],
    }.items():
        vertices, faces = walls(list(parts), 8, 2, 0.25)
        assert not coarse({"mesh": obj_file(tmp_path / f"{name}.obj", vertices, faces), "material": material})


def test_one_sheet_bends_by_one_model() -> None:
    hinge = STIFF | {"bending": 1.0}
    two = {"mesh": [grid(1, 1, 2, 2) | {"name": "a"}, grid(1, 1, 2, 2) | {"name": "b"}]}
    sheets = two | {"material": [STIFF | {"group": "a"}, hinge | {"group": "b"}]}
    simulation = Run(MPI.COMM_SELF, scene_of(sheets))
    assert {"bending", "midedge"} <= set(simulation.problem.terms)
    simulation.destroy()


# -- symmetry planes -----------------------------------------------------------------------------------


def vault_height(flat: Array) -> Array:
    """Of a shallow vault."""
    height: Array = 0.4 * (1.0 - flat[:, 0] ** 2) + 0.2 * (1.0 - flat[:, 1] ** 2)
    return height


def vault(mesh: dict[str, Any], handles: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    material = {"young": 1e8, "poisson": 0.3, "thickness": 0.02, "density": 200.0}
    static = {"time": {"analysis": "static", "step": 0.5}, "gravity": [0, 0, -9.81]}
    rim = {"box": [[0.999, -2, -1], [2, 2, 1]]}
    return {"mesh": mesh, "material": material, "handles": [rim, *handles], "solver": TIGHT} | static | more


@pytest.mark.parallel(2)
@pytest.mark.parametrize("motion", [False, True])
def test_a_part_with_symmetry_planes_moves_as_the_whole(
    comm: MPI.Comm, shared_tmp: Path, motion: bool
) -> None:
    """A vault under its weight; the rest shape is curved across both planes."""
    more: dict[str, Any] = {"time": {"end": 0.05, "step": 0.01, "integrator": "alpha2"}} if motion else {}
    other = [{"box": [[-2, -2, -1], [-0.999, 2, 1]]}]
    meshes = {name: (shared_tmp / f"part-{name}.obj", "xy".replace(name, "")) for name in ("xy", "x", "")}
    made = (
        {name: mirrored(path, images, 3, vault_height) for name, (path, images) in meshes.items()}
        if comm.rank == 0
        else {}
    )
    made = comm.bcast(made)
    results = {}
    for name, (mesh, start) in made.items():
        x, energies = outcome(
            comm, vault(mesh, symmetry_planes(name) + ([] if "x" in name else other), **more)
        )
        part = np.flatnonzero((start[:, :2] >= 0.0).all(axis=1))
        part = part[np.lexsort(start[part, :2].T)]
        results[name] = x[part], energies * 2.0 ** len(name), np.abs(x - start).max()
    whole = results[""]
    assert whole[2] > 1e-5
    for name in ("x", "xy"):
        np.testing.assert_allclose(results[name][0], whole[0], rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(results[name][1], whole[1], rtol=1e-5, atol=1e-9)


def test_symmetry_needs_vertices_in_a_plane_and_directors(tmp_path: Path) -> None:
    mesh, _ = mirrored(tmp_path / "vault.obj", "", 3, vault_height)
    for handle, material, words in (
        ({"box": [[-1, -1, -1], [0.5, 2, 1]], "symmetry": "x"}, {}, "beside the plane x = "),
        (symmetry_planes("x")[0], {"bending_model": "hinge"}, "is not kept by hinges"),
    ):
        content = vault(mesh, [handle])
        content["material"] = content["material"] | material
        with pytest.raises(InputError, match=words):
            Run(MPI.COMM_SELF, scene_of(content))


@pytest.mark.parametrize(
    ("arc", "cells", "incline", "off"),
    [
        (np.pi / 2, 2, 0, 0),  # at the plane a cell is off by half the angle between two cells
        (1e-9, 3, 9, 0),
        (1e-9, 3, 11, 11),
        (0.7, 8, 20, 22.5),
        (0, 3, 5, 0),
        (0, 3, 30, 22.2),
    ],
)
def test_symmetry_needs_a_sheet_normal_to_its_plane(
    tmp_path: Path, arc: float, cells: int, incline: float, off: float
) -> None:
    """Arcs [rad] that are inclined by some degrees where they meet the plane x = 0; an arc of 0 is a sheet
    that is folded along x.
    """
    flat, faces = rectangle(cells, 2, 1.0, 0.5)
    angle, turn = arc * flat[:, 0], np.radians(incline)
    if arc:
        x, z = np.sin(angle) / arc, (np.cos(angle) - 1.0) / arc
        x, z = x * np.cos(turn) + z * np.sin(turn), z * np.cos(turn) - x * np.sin(turn)
    else:
        x, z = flat[:, 0], np.abs(flat[:, 1] - 0.25) - flat[:, 0] * np.tan(turn)
    vertices = np.column_stack([x, flat[:, 1], z])
    content = vault(obj_file(tmp_path / "sheet.obj", vertices, faces), symmetry_planes("x"))
    content["handles"] = content["handles"][1:]
    if not off:
        Run(MPI.COMM_SELF, scene_of(content))
        return
    with pytest.raises(InputError, match=rf"off the normal of the plane x = 0 m by up to {off:g}") as raised:
        Run(MPI.COMM_SELF, scene_of(content))
    assert raised.value.key == "handles[0].symmetry"


@pytest.mark.parametrize(
    ("group", "axis", "words"),
    [("left", "y", "beside the plane y"), ("sheet", "x", "beside"), ("left", "z", "lies in the plane z")],
)
def test_symmetry_of_a_flat_sheet_is_refused_with_its_key(group: str, axis: str, words: str) -> None:
    """An edge normal to the plane gave the message on folds of the start shape, a sheet in the plane none."""
    content = vault(grid(1.0, 0.5, 4, 2, "diagonal"), [{"group": group, "symmetry": axis}])
    with pytest.raises(InputError, match=words) as raised:
        Run(MPI.COMM_SELF, scene_of(content))
    assert raised.value.key == "handles[1].symmetry"


# -- moments -------------------------------------------------------------------------------------------


def rolled(comm: MPI.Comm, n: int, pattern: str, **more: Any) -> tuple[Array, Array]:
    """A strip of length 12 and stiffness 100 N·m, rolled into a circle by its end moment: B2 of Sze et al."""
    scene = {
        "mesh": grid(12.0, 1.0, n, 2, pattern),
        "material": {"young": 1.2e6, "poisson": 0.0, "thickness": 0.1, "density": 1.0},
        "handles": [{"group": "left", "clamp": True}],
        "loads": [{"group": "right", "moment": 2.0 * np.pi * 100.0 / 12.0}],
        "gravity": [0, 0, 0],
        "time": {"analysis": "static", "step": 1.0},
        "solver": {"force_tolerance": 1e-8},
    }
    return outcome(comm, scene | more)


ROLLED_UP = 0.5 * 100.0 * (2.0 * np.pi / 12.0) ** 2 * 12.0


@pytest.mark.parametrize("pattern", ["diagonal", "alternating", "criss-cross"])
def test_an_end_moment_rolls_a_strip_into_a_circle(pattern: str) -> None:
    """In one load step: κ = M / D, and the load's work is the energy, as it grows with the rotation."""
    errors = []
    for n in (24, 48):
        x, energies = rolled(MPI.COMM_SELF, n, pattern)
        start = np.isclose(np.linalg.norm(x[:, [0, 2]], axis=1), 0.0)
        assert start.sum() >= 3
        middle = np.argmax(x[:, 2])
        errors.append([x[middle, 2] / (12.0 / np.pi) - 1.0, energies[2] / ROLLED_UP - 1.0])
        # single diagonals couple bending with twist: the end is at some distance from the start
        assert abs(x[middle, 1] - 0.5) <= (1.0 if pattern == "diagonal" else 0.5 + 1e-6)
        assert energies[4] == pytest.approx(energies[1] + energies[2], rel=0.02)
    assert np.abs(errors[1]).max() < 0.01
    assert np.abs(errors[1][1] / errors[0][1]) < 0.3


@pytest.mark.parallel(alone=False)
def test_moments_do_not_depend_on_ranks(comm: MPI.Comm) -> None:
    x, energies = rolled(comm, 24, "alternating")
    alone = rolled(MPI.COMM_SELF, 24, "alternating") if comm.rank == 0 else (x, energies)
    np.testing.assert_allclose(x, alone[0], rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(energies, alone[1], rtol=1e-6, atol=1e-6)


def test_a_moment_does_work_on_the_rotation_of_directors() -> None:
    """Against differences of directors, far from the frames' directions, where the frames rotate, too."""
    scene = {"mesh": grid(1.0, 1.0, 2, 3), "material": STIFF, "loads": [{"group": "top", "moment": 0.7}]}
    with Simulation(scene, MPI.COMM_SELF) as simulation:
        bending, load = midedge_of(simulation), simulation.problem.terms["moment"]
        assert isinstance(load, Moment)
        x = simulation.equations.x.copy()
        random = np.random.default_rng(3)
        x += random.uniform(-0.2, 0.2, x.shape)
        direction = random.uniform(-1.0, 1.0, x.shape)
        force = np.zeros_like(x)
        load.add_force(simulation.equations.targets_at(0.0, x), force)

        def shape(at: Array) -> Array:
            return bending._directors(at, bending.frames)[:, :3]

        step = 1e-6
        rate = (shape(x + step * direction) - shape(x - step * direction)) / (2.0 * step)
        tail, head = bending.of_edges.ends.T
        tangent = unit(x[head] - x[tail])
        turn = np.sum(rate * np.cross(tangent, shape(x)), axis=1)
        rest = simulation.problem.surface.x
        top = (rest[tail, 1] > 0.99) & (rest[head, 1] > 0.99)
        assert top.sum() == 2
        # the counter-clockwise direction is −x here, and positive moments act about its reverse
        along = np.sign(rest[head, 0] - rest[tail, 0])[top]
        expected = 0.7 * np.sum(bending.of_edges.length[top] * along * turn[top])
        assert np.sum(force * direction) == pytest.approx(expected, rel=1e-7)


def test_moments_are_refused_where_edges_carry_none() -> None:
    flat = {"mesh": grid(1.0, 1.0, 2, 2), "material": STIFF}
    load = {"group": "right", "moment": 1.0}
    for change, words in (
        ({"material": STIFF | {"bending": 1.0, "bending_model": "hinge"}}, "has no moments on edges"),
        ({"loads": [load | {"group": "corner"}]}, "no group 'corner'"),
    ):
        with pytest.raises(InputError, match=words):
            Run(MPI.COMM_SELF, scene_of(flat | {"loads": [load]} | change))


# -- reactions -----------------------------------------------------------------------------------------

CANTILEVER = {
    "mesh": grid(0.6, 0.2, 12, 4, "criss-cross"),
    "material": STIFF,
    "gravity": [0, 0, 0],
    "time": {"analysis": "static", "step": 1.0},
    "solver": TIGHT,
    "output": {"reactions": True},
}


def reactions(comm: MPI.Comm, scene: dict[str, Any], folder: Path, row: int = -1) -> dict[str, float]:
    """A row of reactions.csv, by default the last."""
    simulation = Run(comm, scene_of(scene))
    recorder = Recorder(simulation)
    if comm.rank == 0:
        folder.mkdir()
    comm.Barrier()
    recorder.begin(folder)
    while not simulation.finished:
        recorder.record(simulation.step())
    recorder.flush()
    recorder.close()
    simulation.destroy()
    lines = (folder / "reactions.csv").read_text().splitlines()
    return dict(zip(lines[0].split(","), map(float, lines[row].split(",")), strict=True))


@pytest.mark.parallel(2)
def test_before_the_first_step_a_clamp_has_no_moment(comm: MPI.Comm, shared_tmp: Path) -> None:
    scene = CANTILEVER | {"handles": [{"group": "left", "clamp": True}]}
    found = reactions(comm, scene, shared_tmp / "run", row=1)
    np.testing.assert_allclose([found[f"handle0_m{axis}"] for axis in "xyz"], 0.0, atol=1e-9)


@pytest.mark.parallel(2)
def test_the_load_of_a_corner_in_two_handles_counts_for_one(comm: MPI.Comm, shared_tmp: Path) -> None:
    """A clamp and a symmetry plane that hold the same corner: the clamp bears the weight, the plane nothing
    within itself.
    """
    handles = [{"group": "bottom", "symmetry": "y"}, {"group": "left", "clamp": True}]
    scene = CANTILEVER | {"handles": handles, "gravity": [0, 0, -0.1]}
    found = reactions(comm, scene, shared_tmp / "run")
    assert found["handle0_x"] == found["handle0_z"] == 0.0
    assert found["handle1_z"] == pytest.approx(0.1 * 0.6 * 0.2, rel=1e-6)


@pytest.mark.parallel(2)
@pytest.mark.parametrize("kind", ["clamp", "symmetry"])
def test_reaction_moments_balance_the_loads(comm: MPI.Comm, kind: str, shared_tmp: Path) -> None:
    """Reaction of a clamp or a symmetry plane to a force at the corner and a moment at the end."""
    hold: dict[str, Any] = {"clamp": True} if kind == "clamp" else {"symmetry": "x"}
    loads: list[dict[str, Any]] = [{"group": "right", "moment": 0.04}]
    handles = [{"group": "left", **hold}]
    if kind == "clamp":
        loads.append({"nodes": [12], "force": [0.0, 0.0, 0.02]})
    else:
        handles.append({"nodes": [0, 52], "axes": ["y", "z"]})
    found = reactions(comm, CANTILEVER | {"handles": handles, "loads": loads}, shared_tmp / "run")
    assert list(found)[2 + 3 * len(handles) :] == ["handle0_mx", "handle0_my", "handle0_mz"]
    moments = [found[f"handle0_m{axis}"] for axis in "xyz"]
    if kind == "clamp":
        assert found["handle0_z"] == pytest.approx(-0.02, rel=1e-5)
        # of the force about (0, 0.1, 0), to first order in the deflection
        np.testing.assert_allclose(moments[:2], [0.1 * 0.02, 0.6 * 0.02 + 0.04 * 0.2], rtol=0.002)
    else:
        np.testing.assert_allclose(moments, [0.0, 0.04 * 0.2, 0.0], atol=1e-6)


@pytest.mark.parallel(2)
def test_moments_are_balanced_where_edges_turn(comm: MPI.Comm) -> None:
    """The side with the moment turns in a load step, and with it the axis of the moment."""
    scene = CANTILEVER | {
        "handles": [{"group": "left", "clamp": True}],
        "loads": [{"group": "top", "moment": 3.0}],
        "output": {"every": None},
    }
    with Bench(comm).simulation(scene) as trial:
        balance = trial.run().simulation.energy_balance
        (force,) = np.array(balance.handle_forces(1))[:, :3]
        reaction = balance.handle_moments()[0] + np.cross([0.0, 0.1, 0.0], force)
        top = np.flatnonzero(np.isclose(trial.start[:, 1], 0.2))
        tangent = unit(np.diff(trial.x[top], axis=0))  # clockwise
    load = 3.0 * 0.05 * tangent.sum(axis=0)
    assert np.abs(tangent[-1, 2]) > 0.1
    np.testing.assert_allclose(reaction, -load, rtol=0.0, atol=1e-8 * np.linalg.norm(load))  # was 0.24


@pytest.mark.parallel(2)
def test_the_moment_of_a_clamp_that_turns(comm: MPI.Comm, shared_tmp: Path) -> None:
    """Rate of the angular momentum of a stiff sheet that is rotated about its edge."""
    turn = [{"time": 0.0}, {"time": 2.0, "rotate": {"axis": [0, 1, 0], "degrees": 720}}]
    scene = CANTILEVER | {
        "handles": [{"group": "left", "clamp": True, "motion": "turn"}],
        "motions": {"turn": turn},
        "time": {"end": 0.2, "step": 0.01},
        "material": STIFF | {"bending": {"d11": 1e3, "d22": 1e3, "d33": 5e2}},
    }
    found = reactions(comm, scene, shared_tmp / "run")
    # φ = 4π (3 s² − 2 s³), s = t/2, at t = 0.2 s; the lag of the steps and of the sheet are of order 1 %
    acceleration = 4.0 * np.pi * (6.0 - 12.0 * 0.1) / 4.0
    inertia = 0.6 * 0.2 * 0.6**2 / 3.0
    assert found["handle0_my"] == pytest.approx(inertia * acceleration, rel=0.05)


# -- strips --------------------------------------------------------------------------------------------


def jittered(n: int, m: int) -> tuple[Array, NDArray[np.int64]]:
    """A strip of length 1 in n × m square cells, its vertices moved within it by up to 0.2 of a cell."""
    vertices, triangles = rectangle(n, m, 1.0, m / n, alternating=False)
    vertices = vertices[:, :2].copy()
    random = np.random.default_rng(1)
    for axis, end in enumerate((1.0, m / n)):
        free = (vertices[:, 0] > 1e-9) & (vertices[:, 0] < 1.0 - 1e-9)
        free &= (vertices[:, axis] > 1e-9) & (vertices[:, axis] < end - 1e-9)
        vertices[free, axis] += random.uniform(-0.2, 0.2, free.sum()) / n
    return np.column_stack([vertices, np.zeros(len(vertices))]), triangles


@pytest.mark.parametrize("pattern", ["diagonal", "jittered"])
@pytest.mark.parametrize("weight", [0.0, 10.0])
def test_cantilevers_bend_as_the_elastica(pattern: str, weight: float, tmp_path: Path) -> None:
    """Under a tip load 4 B/L² (Bisshopp & Drucker 1945), or their weight 10 B/L³, without a factor on B."""
    n, m = 50, 2
    mesh = grid(1.0, m / n, n, m, pattern)
    if pattern == "jittered":
        mesh = obj_file(tmp_path / "strip.obj", *jittered(n, m))
    tip = {"box": [[1.0, -1.0, -1.0], [2.0, 1.0, 1.0]], "force": [0.0, 0.0, -4.0 * m / n]}
    scene = {
        "mesh": mesh,
        "material": STIFF | {"bending": {"d11": 1.0, "d22": 1.0, "d33": 0.5}},
        "handles": [{"box": [[-1, -1, -1], [0, 1, 1]], "clamp": True}],
        "gravity": [0, 0, -weight],
        "loads": [] if weight else [tip],
        "time": {"analysis": "static"},
        "solver": {"force_tolerance": 1e-7},
    }
    x, _ = outcome(MPI.COMM_SELF, scene)
    end = x.reshape(m + 1, n + 1, 3)[:, -1].mean(axis=0)
    rows = reference("cantilevers")["own_weight" if weight else "tip_load"]["rows"]
    row = next(row for row in rows if row[0] == (weight or 4.0))
    drop, reach = (row[1], row[2]) if weight else (row[3], 1.0 - row[2])
    np.testing.assert_allclose([-end[2], end[0]], [drop, reach], rtol=0.0, atol=2e-4)


# -- extremes ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "scheme"),
    [
        ("spin", "beuler"),
        ("spin", "alpha2"),
        ("noise", "semi-implicit"),
        ("noise", "alpha2"),
        ("pressed", "alpha2"),
    ],
)
def test_extreme_cases_give_finite_results(kind: str, scheme: str) -> None:
    """Finite results for edges turning by 230° in a step, a crumpled start, edges pressed together."""
    scene: dict[str, Any] = {
        "mesh": grid(0.4, 0.4, 6, 6, "alternating"),
        "material": CLOTH | {"bending": 2e-4, "bending_model": "midedge"},
        "gravity": [0, 0, -9.81],
        "handles": [],
        "initial": {"noise": 0.03, "seed": 2},
        "time": {"end": 0.1, "step": 0.01, "integrator": scheme},
        "solver": {},
    }
    if kind == "spin":
        scene |= {"initial": {"angular_velocity": [3.0, 5.0, 400.0]}, "gravity": [0, 0, 0]}
        scene["material"] |= {"membrane": {"c11": 1e5, "c22": 1e5, "c12": 0.0, "c33": 5e4}}
    elif kind == "pressed":
        there = [{"time": 0.0}, {"time": 0.1, "translate": [-0.38, 0.0, 0.0]}]
        moved = {"group": "right", "motion": "press", "interpolation": "linear"}
        scene |= {"handles": [{"group": "left"}, moved], "motions": {"press": there}}
        scene["initial"] = {"noise": 1e-3, "seed": 1}
    x, energies = outcome(MPI.COMM_SELF, scene)
    assert np.isfinite(x).all()
    assert np.isfinite(energies).all()
    assert np.linalg.norm(np.ptp(x, axis=0)) > 0.1


# -- three triangles at an edge ------------------------------------------------------------------------


def t_frame(path: Path, n: int) -> dict[str, Any]:
    """A plate over 0 ≤ x ≤ 2, and one of height 1 that stands on its middle: n cells to a length of 1."""
    flat, triangles = rectangle(2 * n, 2, 2.0, 2.0 / n)
    leg, more = rectangle(n, 2, 1.0, 2.0 / n)
    standing = np.column_stack([np.ones(len(leg)), leg[:, 1], leg[:, 0]])
    both = np.concatenate([flat, standing])
    _, first, number = np.unique(np.round(both, 9), axis=0, return_index=True, return_inverse=True)
    faces = number.ravel()[np.concatenate([triangles, more + len(flat)])]
    return obj_file(path, both[first], faces)


PUSH = 1e-6


def pushed(comm: MPI.Comm, path: Path, n: int) -> float:
    """Deflection [m] of the upper edge of the standing plate under a force per width PUSH [N/m]."""
    content = {
        "mesh": t_frame(path, n),
        "material": STIFF | {"bending": PLATE | {"d12": 0.0, "d33": 0.5}},
        "handles": [{"box": [[x - 1e-6, -1, -1e-6], [x + 1e-6, 1, 1e-6]]} for x in (0.0, 2.0)],
        "loads": [{"box": [[0.9, -1, 0.999], [1.1, 1, 1.001]], "force": [PUSH * 2.0 / n, 0, 0]}],
        "time": {"analysis": "static", "step": 1.0},
        "solver": TIGHT,
    }
    run = Run(comm, scene_of(content))
    while not run.finished:
        run.step()
    x = gathered(run.problem.points, run.problem.equations.x)
    run.destroy()
    return float(x[x[:, 2] > 0.999][:, 0].mean() - 1.0)


@pytest.mark.parallel(2)
def test_a_plate_stands_on_another(tmp_path: Path, comm: MPI.Comm) -> None:
    """F L³ / 3D from the standing plate, and F L³ / 6D from the rotation of the joint on a span of 2 L."""
    exact = PUSH * (1.0 / 3.0 + 1.0 / 6.0)
    coarse, fine = (pushed(comm, tmp_path / f"frame{n}.obj", n) for n in (8, 16))
    assert abs(fine - exact) < 0.55 * abs(coarse - exact)
    np.testing.assert_allclose(2.0 * fine - coarse, exact, rtol=0.01)  # extrapolated from first order


def test_hinges_are_refused_where_three_plates_meet(tmp_path: Path) -> None:
    content = {"mesh": t_frame(tmp_path / "frame.obj", 2), "material": CLOTH | {"bending": 1e-4}}
    with pytest.raises(InputError, match=r"more than two triangles: vertices \d+-\d+ in .* midedge"):
        Run(MPI.COMM_SELF, scene_of(content))
