"""Signs of the stiffness near exact buckling loads, buckled shapes, and rigid motions of free bodies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import finished, grid, obj_file, rotation, shape
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from lyra_petsc.stepping.simulation import SteppedScene

PARALLEL = pytest.mark.parallel(3)

GREENHILL = 7.83735
"""Critical weight per length times L³ over B of an upright strip that is clamped below (Greenhill 1881)."""

HELD = {"negative_pivots": 0, "neutral_pivots": 0, "rigid_motions": 0, "stable": True}


def sheet(slenderness: float, poisson: float = 0.0) -> dict[str, Any]:
    """A homogeneous sheet with B = 1 N m and this thickness [m]."""
    stretch = 12.0 / slenderness**2
    membrane = {"c11": stretch, "c22": stretch, "c12": poisson * stretch}
    shear = {"c33": 0.5 * (1.0 - poisson) * stretch}
    return {"density": 1.0, "membrane": membrane | shear, "bending": 1.0, "bending_model": "midedge"}


def column(cells: int, slenderness: float, load: float, degrees: float = 0.0) -> dict[str, Any]:
    """A strip on its end with a multiple of its critical weight, turned with its weight by an angle."""
    axis = np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0)
    down = rotation(axis, np.radians(degrees)) @ [-load * GREENHILL, 0.0, 0.0]
    turned = {"transform": {"rotate": {"axis": axis.tolist(), "degrees": degrees}}}
    return {
        "mesh": grid(1.0, 2.0 / cells, cells, 2, "alternating") | turned,
        "material": sheet(slenderness),
        "gravity": down.tolist(),
        "handles": [{"group": "left", "clamp": True}],
        "time": {"analysis": "static"},
        "solver": {},
    }


def deflection(load: float) -> float:
    """Deflection of the tip of the heavy elastica, over its length."""

    def from_tip(angle: float) -> Any:
        def rate(s: float, y: Any) -> list[float]:  # from the tip: angle, curvature, deflection
            return [y[1], -load * GREENHILL * s * np.sin(y[0]), np.sin(y[0])]

        return solve_ivp(rate, (0.0, 1.0), [angle, 0.0, 0.0], rtol=1e-10, atol=1e-12).y[:, -1]

    return abs(float(from_tip(brentq(lambda angle: from_tip(angle)[0], 1e-2, 2.5))[2]))


def deflected(simulation: SteppedScene, degrees: float = 0.0) -> float:
    """Deflection of the tip across the strip's rest plane."""
    axis = np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0)
    return float(np.abs(shape(simulation) @ rotation(axis, np.radians(degrees)))[:, 2].max())


def test_the_heavy_elastica_itself() -> None:
    """Against the expansion of its deflection at the critical load."""
    one, other = deflection(1.002), deflection(1.008)
    assert other / one == pytest.approx(2.0, rel=0.01)


@pytest.mark.parametrize(
    ("cells", "slenderness", "degrees"),
    [
        (32, 1e-2, 0.0),
        (32, 1e-4, 40.0),
        (128, 1e-2, 40.0),
        pytest.param(128, 1e-4, 0.0, marks=PARALLEL),
        (256, 1e-4, 40.0),
    ],
)
def test_a_column_is_stable_below_its_critical_weight_only(
    cells: int, slenderness: float, degrees: float, comm: MPI.Comm
) -> None:
    with finished(comm, column(cells, slenderness, 0.995, degrees)) as simulation:
        assert simulation.stability == HELD
        assert deflected(simulation, degrees) < 1e-9
    with finished(comm, column(cells, slenderness, 1.005, degrees)) as simulation:
        assert simulation.stability == HELD
        error = 0.1 if cells == 32 else 0.015  # the load is 0.0003 or so off, and the root of 0.005 counts
        assert deflected(simulation, degrees) == pytest.approx(deflection(1.005), rel=error)


@pytest.mark.parametrize("load", [1.2, 2.0])
@pytest.mark.parametrize(("cells", "slenderness"), [(32, 1e-3), (256, 1e-4)])
def test_columns_are_found_far_beyond_their_critical_weight(
    load: float, cells: int, slenderness: float, comm: MPI.Comm
) -> None:
    with finished(comm, column(cells, slenderness, load)) as simulation:
        assert simulation.stability == HELD
        assert "followed once" in simulation.notes[-1]
        assert deflected(simulation) == pytest.approx(deflection(load), rel=3e-3)


@pytest.mark.parametrize("slenderness", [1e-2, 1e-4])
def test_hinges_buckle_at_the_load_of_their_own_stiffness(slenderness: float, comm: MPI.Comm) -> None:
    for load, buckles in ((0.98, False), (1.02, True)):
        scene = column(64, slenderness, 0.8 * load)
        scene["material"].pop("bending_model")
        with finished(comm, scene) as simulation:
            assert simulation.stability == HELD
            assert (deflected(simulation) > 1e-3) == buckles


@pytest.mark.parametrize("load", [0.95, pytest.param(1.05, marks=PARALLEL)])
def test_a_pressed_plate_buckles_beyond_4_pi_squared_d_over_b_squared(load: float, comm: MPI.Comm) -> None:
    force = 4.0 * np.pi**2 * load
    middle = [[[x - 1e-9, 0.5 - 1e-9, -1], [x + 1e-9, 0.5 + 1e-9, 1]] for x in (0.0, 1.0)]
    scene = {
        "mesh": grid(1.0, 1.0, 12, 12, "alternating"),
        "material": sheet(1e-3, 0.3),
        "handles": [{"group": side, "axes": ["z"]} for side in ("left", "right", "bottom", "top")]
        + [{"box": middle[0], "axes": ["x", "y"]}, {"box": middle[1], "axes": ["y"]}],
        "loads": [{"group": "right", "force": [-force, 0, 0]}, {"group": "left", "force": [force, 0, 0]}],
        "time": {"analysis": "static"},
        "solver": {},
    }
    with finished(comm, scene) as simulation:
        assert simulation.stability == HELD
        assert (np.abs(shape(simulation)[:, 2]).max() > 1e-4) == (load > 1.0)


def balloon(path: Path) -> dict[str, Any]:
    """The mesh of an icosahedron whose triangles are divided into four twice, of radius 0.1 m."""
    golden = 0.5 + np.sqrt(1.25)
    corners = [(0.0, one, other * golden) for one in (-1.0, 1.0) for other in (-1.0, 1.0)]
    points = np.array([np.roll(corner, turn) for turn in range(3) for corner in corners])
    near = np.linalg.norm(points[:, None] - points, axis=2) < 2.1
    triples = [(a, b, c) for a in range(12) for b in range(a) for c in range(b)]
    faces = [points[list(three)] for three in triples if near[np.ix_(three, three)].all()]
    faces = [face if np.linalg.det(face) > 0.0 else face[::-1] for face in faces]
    for _ in range(2):
        halves = [(face, 0.5 * (face + np.roll(face, -1, axis=0))) for face in faces]
        faces = [
            np.array(each)
            for (a, b, c), (ab, bc, ca) in halves
            for each in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        ]
        faces = [face / np.linalg.norm(face, axis=1, keepdims=True) for face in faces]
    rows = np.round(0.1 * np.concatenate(faces), 12)
    vertices, index = np.unique(rows, axis=0, return_inverse=True)
    return obj_file(path, vertices, index.reshape(-1, 3))


TOP = [[-1, -1, 0.08], [1, 1, 1]]


@pytest.mark.parametrize(
    ("law", "held"),
    [("neo-hookean", False), ("bent", True), pytest.param("bent", False, marks=PARALLEL)],
)
def test_a_balloon_is_stable(law: str, held: bool, shared_tmp: Path, comm: MPI.Comm) -> None:
    rubber = {"young": 3e5, "poisson": 0.45, "thickness": 1e-3, "density": 1.0}
    if comm.rank == 0:
        balloon(shared_tmp / "ball.obj")
    comm.barrier()
    scene = {
        "mesh": {"file": str(shared_tmp / "ball.obj")},
        "material": rubber | ({"law": law} if law == "neo-hookean" else {"bending_model": "midedge"}),
        "handles": [{"box": TOP}] if held else [],
        "loads": [{"pressure": 100.0}],
        "time": {"analysis": "static"},
        "solver": {},
    }
    with finished(comm, scene) as simulation:
        assert simulation.stability == HELD | {"rigid_motions": 0 if held else 6}


@pytest.mark.parametrize(
    ("pull", "negative", "rigid"),
    [(0.1, 0, 4), (0.0, 0, 6), pytest.param(-0.1, 2, 4, marks=PARALLEL)],
)
def test_a_free_strip_is_counted_for_what_it_is(
    pull: float, negative: int, rigid: int, comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pulled at its ends it resists two rotations; pressed it gives way in them before it buckles."""
    monkeypatch.setattr("lyra_petsc.stepping.statics.descent.MAX_DESCENTS", 0)
    loads = [{"group": side, "force": [sign * pull, 0, 0]} for side, sign in (("right", 1), ("left", -1))]
    scene = {
        "mesh": grid(1.0, 0.2, 16, 2, "alternating"),
        "material": sheet(1e-2),
        "loads": loads,
        "time": {"analysis": "static"},
        "solver": {},
    }
    with finished(comm, scene) as simulation:
        expected = {"negative_pivots": negative, "rigid_motions": rigid, "stable": not negative}
        assert simulation.stability == HELD | expected


@pytest.mark.parametrize("up", [True, False])
def test_a_hinged_sheet_hangs_and_does_not_stand(
    up: bool, comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its rotation about the hinge is a rigid motion with the stiffness of its weight."""
    monkeypatch.setattr("lyra_petsc.stepping.statics.descent.MAX_DESCENTS", 0)
    scene = {
        "mesh": grid(1.0, 0.3, 8, 3, "alternating"),
        "material": sheet(1e-2) | {"density": 1e-3},
        "gravity": [-9.81 if up else 9.81, 0, 0],
        "handles": [{"group": "left"}],
        "time": {"analysis": "static"},
        "solver": {},
    }
    with finished(comm, scene) as simulation:
        assert simulation.stability == HELD | {"negative_pivots": int(up), "stable": not up}
