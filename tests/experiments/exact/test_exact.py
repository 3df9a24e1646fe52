"""Exact motions compared with simulated steps, and refused for scenes to which they do not apply."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from physics import CLOTH, grid, scene_of
from physics import Simulation as Stepping

from lyra_petsc.errors import InputError
from lyra_petsc.experiments.exact_motions import SOLUTIONS, Body, exact_motion, matching
from lyra_petsc.terms import registry
from lyra_petsc.terms.registry import Registration, Role

pytest.importorskip("scipy")

SHEET = grid(0.6, 0.4, 3, 2, "alternating")
UPRIGHT = SHEET | {"transform": {"rotate": {"axis": [1, 0, 0], "degrees": 90}}}
AIR = {"velocity": [0, 0, 0], "density": 1.2, "drag": 0.3}
DOWN = [0, 0, -9.81]
ROUND = {"density": 0.2, "membrane": {"c11": 1000.0, "c22": 1000.0, "c12": 300.0, "c33": 350.0}}
FLOOR = {"floor": {"plane": {"point": [0, 0, -1], "normal": [0, 0, 1]}}}
SHELL = {"density": 0.1, "young": 1e6, "poisson": 0.3, "thickness": 1e-4}
RUBBER = {**SHELL, "law": "neo-hookean"}


def triangle(folder: Path, stretch: float = 1.2) -> dict[str, Any]:
    """An equilateral triangle of circumradius 0.5 m, stretched at the start."""
    angles = np.pi / 2 + 2 * np.pi / 3 * np.arange(3)
    rest = 0.5 * np.column_stack([np.cos(angles), np.sin(angles)])
    lines = [f"v {x * stretch!r} {y * stretch!r} 0.25" for x, y in rest.tolist()]
    lines += [f"vt {x!r} {y!r}" for x, y in rest.tolist()] + ["f 1/1 2/2 3/3"]
    path = folder / "triangle.obj"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return {"file": str(path)}


def content(name: str, folder: Path) -> dict[str, Any]:
    """A scene to which the exact solution ``name`` applies."""
    if name == "free-fall":
        return {"mesh": SHEET, "gravity": DOWN, "initial": {"velocity": [1.0, 0, 2.0]}}
    if name == "terminal-fall":
        return {"mesh": SHEET, "gravity": DOWN, "wind": AIR, "material": CLOTH | {"bending": 1e-4}}
    if name == "edge-fall":
        return {"mesh": UPRIGHT, "gravity": DOWN, "wind": AIR}
    return {"mesh": triangle(folder), "material": ROUND}


@pytest.mark.parallel(2)
@pytest.mark.parametrize("name", list(SOLUTIONS))
def test_backward_euler_converges_to_the_exact_motion(name: str, shared_tmp: Path, comm: MPI.Comm) -> None:
    if comm.size > 1 and (name == "breathing-triangle" or not PETSc.Sys.hasExternalPackage("mumps")):
        pytest.skip("one triangle is for one rank; the others need a parallel direct solver")
    end, coarse = (0.015, 150) if name == "breathing-triangle" else (0.2, 40)
    if comm.rank == 0:
        triangle(shared_tmp)
    comm.Barrier()
    scene = content(name, shared_tmp)
    motion = exact_motion(name, Body(scene_of(scene)))
    errors, states, energies = [], [], []
    for steps in (coarse, 2 * coarse):
        with Stepping(scene) as sheet:
            start = sheet.x
            states.append(sheet.run(end / steps, steps))
            errors.append(np.abs(states[-1] - motion.positions(start, end)).max())
            energies.append(sheet.energy("membrane") + 0.5 * float(sheet.mass @ (sheet.v**2).sum(axis=1)))
    assert errors[0] > 1e-4
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.15)
    extrapolated = 2.0 * states[1] - states[0]
    assert np.abs(extrapolated - motion.positions(start, end)).max() < 0.06 * errors[1]
    exact = motion.energies(end)
    expected = exact.kinetic + exact.membrane
    assert 2.0 * energies[1] - energies[0] == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("name", list(SOLUTIONS))
def test_velocity_is_the_derivative_and_energy_starts_as_the_scene(name: str, tmp_path: Path) -> None:
    body = Body(scene_of(content(name, tmp_path)))
    motion = exact_motion(name, body)
    start, h, t = body.mesh.positions, 1e-5, 0.07
    assert np.allclose(motion.positions(start, 0.0), start, atol=1e-14)
    rate = (motion.positions(start, t + h) - motion.positions(start, t - h)) / (2.0 * h)
    kinetic = 0.5 * float(body.rest.mass @ (rate**2).sum(axis=1))
    energies = motion.energies(t)
    assert energies.kinetic == pytest.approx(kinetic, rel=1e-6)
    potential = -float(body.rest.mass @ (motion.positions(start, t) @ body.gravity))
    assert energies.potential == pytest.approx(potential, rel=1e-12, abs=1e-14)


@pytest.mark.parametrize("stretch", [1.2, 0.7])
def test_the_breathing_triangle_conserves_energy_and_has_the_right_extremes(
    stretch: float, tmp_path: Path
) -> None:
    body = Body(scene_of({"mesh": triangle(tmp_path, stretch), "material": ROUND}))
    motion = exact_motion("breathing-triangle", body)
    start = body.mesh.positions
    times = np.linspace(0.0, 0.5, 2001)
    radius = [np.linalg.norm(motion.positions(start, t)[0] - start.mean(axis=0)) / 0.5 for t in times]
    other = np.sqrt(2.0 - stretch**2)
    assert min(radius) == pytest.approx(min(stretch, other), rel=1e-4)
    assert max(radius) == pytest.approx(max(stretch, other), rel=1e-4)
    # λ'' = −k (λ³ − λ), by differences
    h, k = times[1], 1300.0 / (0.2 * 0.25)
    middle = np.array(radius[1:-1])
    second = (np.array(radius[2:]) - 2.0 * middle + np.array(radius[:-2])) / h**2
    assert np.abs(second + k * (middle**3 - middle)).max() < 0.01 * k


@pytest.mark.parametrize("name", list(SOLUTIONS))
def test_the_exact_motion_of_a_scene_is_found(name: str, tmp_path: Path) -> None:
    solution = matching(Body(scene_of(content(name, tmp_path))))
    assert solution is not None
    assert solution.name == name


@pytest.mark.parametrize("name", list(SOLUTIONS))
def test_no_exact_motion_where_a_term_acts_that_it_does_not_account_for(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also a term that is registered later."""
    body = Body(scene_of(content(name, tmp_path)))
    other = Registration("magnet", lambda scene, shells: True, Role.LOAD)
    monkeypatch.setattr(registry, "REGISTRY", [*registry.REGISTRY, other])
    assert matching(body) is None
    with pytest.raises(InputError, match="which has magnet"):
        exact_motion(name, body)


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("free-fall", {"handles": [{"nodes": [0]}]}, "handles"),
        ("free-fall", {"wind": AIR}, "wind"),
        ("free-fall", {"loads": [{"pressure": 1.0}]}, "pressure"),
        ("free-fall", {"contact": {}}, "contact"),
        ("terminal-fall", {"contact": {}, "obstacles": FLOOR}, "contact"),
        ("edge-fall", {"contact": {"friction": 0.2}}, "contact, friction"),
        ("breathing-triangle", {"contact": {}}, "contact"),
        ("breathing-triangle", {"material": RUBBER}, "membrane law other than stvk"),
        ("breathing-triangle", {"material": ROUND | {"friction_force": 0.1}}, "shear_friction"),
        ("free-fall", {"material": SHELL | {"rest_curvature": [1, 0, 0]}}, "bent"),
        ("free-fall", {"initial": {"noise": 1e-3}}, "initial.noise"),
        ("free-fall", {"initial": {"angular_velocity": [0, 0, 1]}}, "initial.angular_velocity"),
        ("free-fall", {"material": CLOTH | {"bending": 1e-4, "rest_curvature": [1, 0, 0]}}, "bent"),
        ("terminal-fall", {"wind": AIR | {"velocity": [0, 0, 1]}}, "wind that is not still"),
        ("terminal-fall", {"mesh": UPRIGHT}, "not flat and level"),
        ("terminal-fall", {"gravity": None}, "no gravity"),
        ("edge-fall", {"mesh": SHEET}, "not upright"),
        ("edge-fall", {"wind": AIR | {"drag": 0.0}}, "wind.drag 0"),
        ("breathing-triangle", {"mesh": SHEET}, "12 triangles instead of one"),
        ("breathing-triangle", {"material": CLOTH}, "c11 and c22 that differ"),
        ("breathing-triangle", {"gravity": DOWN}, "gravity"),
    ],
)
def test_a_violated_assumption_is_named(
    name: str, change: dict[str, Any], words: str, tmp_path: Path
) -> None:
    scene = {key: value for key, value in (content(name, tmp_path) | change).items() if value is not None}
    body = Body(scene_of(scene))
    with pytest.raises(InputError, match=words):
        exact_motion(name, body)


def test_sheets_of_different_densities_are_refused() -> None:
    two = [SHEET | {"name": "a"}, SHEET | {"name": "b", "transform": {"translate": [0, 0, 1]}}]
    materials = [CLOTH, CLOTH | {"density": 0.4, "group": "b"}]
    body = Body(scene_of({"mesh": two, "material": materials, "gravity": DOWN, "wind": AIR}))
    with pytest.raises(InputError, match="different densities"):
        exact_motion("terminal-fall", body)


def test_an_unknown_name_is_refused_with_the_nearest() -> None:
    body = Body(scene_of({"mesh": SHEET}))
    with pytest.raises(InputError, match="did you mean 'free-fall'"):
        exact_motion("freefall", body)
