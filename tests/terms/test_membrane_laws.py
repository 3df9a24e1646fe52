"""Membrane laws: derivatives, tangent at rest, convexity, and compressed strips."""

from __future__ import annotations

import json
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from mpi4py import MPI
from oracle import differences, gradient, hessian
from physics import Simulation, obj_file
from scipy.optimize import brentq

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.kernels.cache import Index
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.load import load_scene, scene_of
from lyra_petsc.scene.material_block import Material
from lyra_petsc.scene.materials.library import ShellMaterial, measured_names, resolve_material
from lyra_petsc.scene.messages import validated
from lyra_petsc.terms.membrane_laws import LAWS, law_of
from lyra_petsc.terms.membrane_laws.measured import fit_errors

pytestmark = pytest.mark.quick


GRID = {"width": 1.0, "height": 1.0, "nx": 2, "ny": 2}
SCENE = {"time": {"end": 1.0, "step": 0.1}}
SHEET = {"young": 2.0e6, "thickness": 1.0e-3, "density": 1.0}
CURVES = {
    "warp": [[0.01, 2.0], [0.03, 10.0], [0.1, 60.0]],  # J-shaped, as cloth's
    "weft": [[0.0, 0.0], [0.05, 4.0], [0.12, 30.0], [0.2, 70.0]],
    "shear": [[0.1, 2.0], [0.2, 3.5], [0.4, 12.0]],
}
MATERIALS: list[dict[str, Any]] = [
    {"cloth": "gray-interlock"},
    *({"cloth": name, "law": "measured", "stretching_scale": 1.7} for name in measured_names()),
    *(SHEET | {"poisson": nu, "law": "neo-hookean"} for nu in (-0.3, 0.0, 0.3, 0.5)),
    {"cloth": "rubber-sheet-1mm", "law": "neo-hookean"},
    {"cloth": "gray-interlock", "law": CURVES, "stretching_scale": 1.7},
]
every_law = pytest.mark.parametrize("keys", MATERIALS, ids=lambda keys: "-".join(map(str, keys.values())))
stable = pytest.mark.parametrize("keys", MATERIALS[1:], ids=lambda keys: "-".join(map(str, keys.values())))

STRAINS = [np.array(e) for e in product((-0.35, -0.1, 0.0, 0.08, 0.4), (-0.3, 0.02, 0.3), (-0.25, 0.0, 0.15))]


@cache
def compiled(name: str) -> Any:
    """Energy, stress and tangent of a law, compiled as in kernels."""
    law = law_of(name)
    energy, stress, tangent = law.energy, law.stress, law.tangent

    @numba.njit
    def all_of(e, c):  # type: ignore[no-untyped-def]
        n = Index(0)
        first, second, third = e[0], e[1], e[2]
        return (
            energy(first, second, third, c, n),
            stress(first, second, third, c, n),
            tangent(first, second, third, c, n),
        )

    return all_of


class Law:
    """A material's energy, stress and tangent as functions of e (3,)."""

    def __init__(self, shell: ShellMaterial) -> None:
        self._law = compiled(shell.law)
        self._c = np.array([law_of(shell.law).parameters(shell)])

    def energy(self, e: Array) -> float:
        return float(self._law(e, self._c)[0])

    def stress(self, e: Array) -> Array:
        return np.array(self._law(e, self._c)[1])

    def tangent(self, e: Array) -> Array:
        c11, c12, c22, c33, c13, c23 = self._law(e, self._c)[2]
        return np.array([[c11, c12, c13], [c12, c22, c23], [c13, c23, c33]])


def shell_of(keys: dict[str, Any]) -> ShellMaterial:
    return resolve_material(Material.model_validate(keys))[0]


def test_every_law_is_tested() -> None:
    assert {shell_of(keys).law for keys in MATERIALS} == set(LAWS)


@every_law
def test_stress_and_tangent_are_derivatives_of_the_energy(keys: dict[str, Any]) -> None:
    law = Law(shell_of(keys))
    for e in STRAINS:
        h = 1e-5
        stress, tangent = law.stress(e), law.tangent(e)
        for i, step in enumerate(h * np.eye(3)):
            slope = (law.energy(e + step) - law.energy(e - step)) / (2.0 * h)
            assert slope == pytest.approx(stress[i], abs=1e-7 * np.abs(tangent).max())
            change = (law.stress(e + step) - law.stress(e - step)) / (2.0 * h)
            np.testing.assert_allclose(change, tangent[i], rtol=0.0, atol=2e-4 * np.abs(tangent).max())


@every_law
def test_tangent_at_rest_is_that_of_the_library(keys: dict[str, Any]) -> None:
    shell, zero = shell_of(keys), np.zeros(3)
    law = Law(shell)
    rest = [[shell.c11, shell.c12, 0.0], [shell.c12, shell.c22, 0.0], [0.0, 0.0, shell.c33]]
    np.testing.assert_allclose(law.tangent(zero), rest, rtol=1e-14, atol=1e-14 * np.abs(rest).max())
    assert law.energy(zero) == 0.0
    assert not law.stress(zero).any()
    # and with all of it near rest: the energy is not drowned in round-off
    e = np.array([3e-7, -1e-7, 2e-7])
    assert law.energy(e) == pytest.approx(0.5 * e @ rest @ e, rel=1e-5)


@every_law
def test_tangent_is_positive_semidefinite(keys: dict[str, Any]) -> None:
    law = Law(shell_of(keys))
    for e in STRAINS:
        values = np.linalg.eigvalsh(law.tangent(e))
        assert values[0] >= -1e-12 * values[2]


@stable
@pytest.mark.parametrize("degrees", [0.0, 30.0, 45.0, 90.0])
def test_a_compressed_strip_does_not_soften(keys: dict[str, Any], degrees: float) -> None:
    # held on both sides: the force λ S along the strip grows with compression, where St. Venant-
    # Kirchhoff's turns round at λ = 1/√3
    law, c, s = Law(shell_of(keys)), np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    stretches = np.geomspace(1.0, 0.12, 200)
    along = 0.5 * (stretches**2 - 1.0)
    n = np.array([c * c, s * s, c * s])
    e = along[:, None] * [c * c, s * s, 2.0 * c * s]
    forces = np.array(
        [
            stretch * (law.stress(each) @ [n[0], n[1], 2.0 * n[2]])
            for stretch, each in zip(stretches, e, strict=True)
        ]
    )
    assert (np.diff(forces) < 0.0).all()


def test_st_venant_kirchhoff_softens() -> None:
    # the softening that the test above excludes
    law = Law(shell_of({"cloth": "gray-interlock"}))
    forces = [x * law.stress(np.array([0.5 * (x * x - 1.0), 0.0, 0.0]))[0] for x in (0.6, 0.577, 0.5)]
    assert forces[1] < forces[0]
    assert forces[1] < forces[2]


def test_extension_of_an_incompressible_sheet_follows_theory() -> None:
    # Treloar: a strip of thickness h with ν = ½ is pulled with E h/3 (λ − 1/λ²)
    law = Law(shell_of(SHEET | {"poisson": 0.5, "law": "neo-hookean"}))
    for stretch in (0.5, 0.9, 1.5, 3.0):
        along = 0.5 * (stretch**2 - 1.0)
        across = brentq(lambda y, x=along: law.stress(np.array([x, y, 0.0]))[1], -0.49, 2.0, xtol=1e-14)
        assert 1.0 + 2.0 * across == pytest.approx(1.0 / stretch, rel=1e-9)
        force = stretch * law.stress(np.array([along, across, 0.0]))[0]
        assert force == pytest.approx(2.0e3 / 3.0 * (stretch - stretch**-2), rel=1e-9)


def test_curves_are_interpolated_at_their_points() -> None:
    law = Law(shell_of({"density": 0.2, "law": CURVES}))
    for x, force in [*CURVES["warp"], [0.2, 60.0 + 0.1 * 50.0 / 0.07]]:
        e = 0.5 * ((1.0 + x) ** 2 - 1.0)
        assert (1.0 + x) * law.stress(np.array([e, 0.0, 0.0]))[0] == pytest.approx(force, rel=1e-12)
    for x, force in CURVES["shear"]:
        # across, without stretches near collapse
        assert law.stress(np.array([0.0, 0.3, -x]))[2] == pytest.approx(-force, rel=1e-12)


def test_strains_that_may_be_percent_are_noted() -> None:
    for strain, expected in ((1.0, []), (5.0, ["strains up to 5; if they are percent"])):
        law = CURVES | {"shear": [[0.1, 2.0], [strain, 20.0]]}
        notes = resolve_material(validated(Material, {"density": 0.2, "law": law}, file=None))[1]
        assert [words in note for words, note in zip(expected, notes, strict=True)] == [True] * len(expected)


def test_curves_from_files_are_stored_in_the_scene(tmp_path: Path) -> None:
    (tmp_path / "curves").mkdir()
    text = '\ufeff"strain"; "N/m"\n# KES\n"0.01"; 2\n\n0.03;10\n'
    (tmp_path / "curves" / "warp.csv").write_text(text, encoding="utf-8")
    law = CURVES | {"warp": "curves/warp.csv"}
    scene = SCENE | {"mesh": {"grid": GRID}, "material": {"density": 0.2, "bending": 1e-5, "law": law}}
    (tmp_path / "scene.yaml").write_text(json.dumps(scene))
    loaded = load_scene(tmp_path / "scene.yaml")
    stored = tmp_path / "stored.yaml"
    stored.write_text(dump_scene(loaded))
    (tmp_path / "curves" / "warp.csv").unlink()
    assert load_scene(stored) == loaded
    assert resolve_material(loaded.material[0])[0].curves[0] == ((0.0, 0.0), (0.01, 2.0), (0.03, 10.0))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0,0\n0.02,5\n0.01,7\n", "line 3: strain 0.01 is not more than 0.02"),
        ("0,0\n0.02,5\n\n0.03,5\n", "line 4: force 5 is not more than 5"),
        ("0,1\n0.02,5\n", "line 1: the force at zero strain must be 0"),
        ("-0.1,-3\n0.02,5\n", "line 1: strain -0.1 is negative"),
        ("strain,force\n", "has 0 points"),
        ("0.1,nan\n", "line 1: must be two numbers"),
        ("strain;force\n0,01;5\n", "line 2: must be two numbers with decimal points"),
        ("strain [%],force\n1,5\n", "heading says '%'; give strain as a fraction"),
        ("0.1,5\n12,60\n", "line 2: strain 12 is 1200 %"),
        ("1e-300,1e-300\n2e-300,5e300\n", "slopes that are no numbers"),
        (2**18 * "0.1,5\n", "thin the curve out to at most 1000 points"),
        (None, "no such file"),
    ],
)
def test_invalid_curves_are_refused(text: str | None, words: str, tmp_path: Path) -> None:
    if text is not None:
        (tmp_path / "shear.csv").write_text(text)
    law = CURVES | {"shear": "shear.csv"}
    scene = SCENE | {"mesh": {"grid": GRID}, "material": {"cloth": "paper", "law": law}}
    (tmp_path / "scene.yaml").write_text(json.dumps(scene))
    with pytest.raises(InputError, match=r"material\.law\.shear: .*shear\.csv") as refused:
        load_scene(tmp_path / "scene.yaml")
    assert words in str(refused.value)


def test_fitted_laws_approximate_the_tables_better() -> None:
    errors = fit_errors()
    assert set(errors) == set(measured_names())
    for fitted, of_stvk in errors.values():
        assert fitted < of_stvk
    # interlock stretched along the warp by 1/6, by its row of the tables
    law, stvk = (Law(shell_of({"cloth": "gray-interlock", "law": name})) for name in ("measured", "stvk"))
    e = np.array([0.5 * ((7.0 / 6.0) ** 2 - 1.0), 0.0, 0.0])
    table = 2.0 * np.array([46.364765, 53.694656]) * e[0]
    error, before = (np.abs(each.stress(e)[:2] - table).max() for each in (law, stvk))
    assert error < 0.65 * before


@pytest.mark.parametrize("cloth", ["gray-interlock", "rubber-sheet-1mm"])
def test_forces_of_a_sheet_are_the_derivatives_of_its_energy(cloth: str, tmp_path: Path) -> None:
    law = "measured" if cloth == "gray-interlock" else "neo-hookean"
    mesh = obj_file(tmp_path / "one.obj", [(0, 0, 0), (1, 0.1, 0), (0.2, 0.8, 0)], [(0, 1, 2)])
    with Simulation({"mesh": mesh, "material": {"cloth": cloth, "law": law}}, MPI.COMM_SELF) as simulation:
        term, x = simulation.problem.membrane, simulation.equations.x
        for scale in (0.5, 0.97, 1.1):
            y = scale * x + np.random.default_rng(1).uniform(-0.05, 0.05, x.shape)
            force, stiffness = gradient(term, y, None), hessian(term, y, None, 0.0)
            slopes = differences(lambda z: term.energies(z, None).sum(), y, 1e-5)
            np.testing.assert_allclose(force, slopes, rtol=0.0, atol=1e-7 * np.abs(force).max())
            slopes = differences(lambda z: gradient(term, z, None), y, 1e-5)
            np.testing.assert_allclose(stiffness, slopes, rtol=0.0, atol=1e-6 * np.abs(stiffness).max())


@pytest.mark.parametrize(
    ("material", "words"),
    [
        ({"cloth": "paper", "law": "measured"}, "paper is none of them"),
        (SHEET | {"poisson": 0.3, "law": "measured"}, "measured is for measured cloths: 11oz"),
        ({"cloth": "gray-interlock", "law": "neo-hookean"}, "is for isotropic sheets"),
        ({"density": 1.0, "law": CURVES | {"warp": [1.0, 2.0]}}, "law.warp: must be a file, or points"),
        (SHEET | {"poisson": 0.3, "law": CURVES}, "curves take the place of membrane"),
        ({"law": CURVES | {"weft": "no.csv"}, "density": 1.0}, "no.csv: no such file"),
        ({"cloth": "gray-interlock", "law": "ogden"}, "must be one of stvk, measured, neo-hookean"),
    ],
)
def test_laws_that_do_not_fit_the_material_are_refused(material: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=r"material\.law") as refused:
        scene_of(SCENE | {"mesh": {"grid": GRID}, "material": material})
    assert words in str(refused.value)


def test_two_laws_in_a_scene_are_refused() -> None:
    materials = [{"cloth": "gray-interlock", "law": "measured"}, {"cloth": "paper", "group": "a"}]
    mesh = {"grid": GRID, "name": "a"}
    with pytest.raises(InputError, match=r"material\[1\]\.law: all materials of a scene share one"):
        Simulation({"mesh": mesh, "material": materials}, MPI.COMM_SELF)
