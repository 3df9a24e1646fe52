"""Every law of the membrane: its derivatives, its tangent at rest, convexity, and strips pushed together."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray
from oracle import differences, gradient, hessian
from physics import Simulation, obj_file
from scipy.optimize import brentq

from lyra_petsc.errors import InputError
from lyra_petsc.kernels.element import kernel
from lyra_petsc.scene.load import scene_of
from lyra_petsc.scene.materials.library import ShellMaterial, measured, resolve
from lyra_petsc.scene.schema import Material
from lyra_petsc.terms.membrane_laws import LAWS, law_of
from lyra_petsc.terms.membrane_laws.measured import fit_errors

pytestmark = pytest.mark.quick

Array = NDArray[np.float64]

SHEET = {"young": 2.0e6, "thickness": 1.0e-3, "density": 1.0}
MATERIALS: list[dict[str, Any]] = [
    {"cloth": "gray-interlock"},
    *({"cloth": name, "law": "measured", "stretching_scale": 1.7} for name in measured()),
    *(SHEET | {"poisson": nu, "law": "neo-hookean"} for nu in (-0.3, 0.0, 0.3, 0.5)),
    {"cloth": "rubber-sheet-1mm", "law": "neo-hookean"},
]
every_law = pytest.mark.parametrize("keys", MATERIALS, ids=lambda keys: "-".join(map(str, keys.values())))
stable = pytest.mark.parametrize("keys", MATERIALS[1:], ids=lambda keys: "-".join(map(str, keys.values())))

STRAINS = [np.array(e) for e in product((-0.35, -0.1, 0.0, 0.08, 0.4), (-0.3, 0.02, 0.3), (-0.25, 0.0, 0.15))]


class Law:
    """A material's energy, stress and tangent as functions of e (3,)."""

    def __init__(self, shell: ShellMaterial) -> None:
        module, self._c = law_of(shell.law), np.array([law_of(shell.law).parameters(shell)])
        energy, stress, tangent = module.energy, module.stress, module.tangent

        @kernel()
        def all_of(e, c):  # type: ignore[no-untyped-def]
            w = energy(e[0], e[1], e[2], c, 0)
            return w, stress(e[0], e[1], e[2], c, 0), tangent(e[0], e[1], e[2], c, 0)

        self._all_of = all_of

    def energy(self, e: Array) -> float:
        return float(self._all_of(e, self._c)[0])

    def stress(self, e: Array) -> Array:
        return np.array(self._all_of(e, self._c)[1])

    def tangent(self, e: Array) -> Array:
        c11, c12, c22, c33, c13, c23 = self._all_of(e, self._c)[2]
        return np.array([[c11, c12, c13], [c12, c22, c23], [c13, c23, c33]])


def shell_of(keys: dict[str, Any]) -> ShellMaterial:
    return resolve(Material.model_validate(keys))[0]


def test_every_law_is_tested() -> None:
    assert {keys.get("law", "stvk") for keys in MATERIALS} == set(LAWS)


@every_law
def test_stress_and_tangent_are_the_derivatives(keys: dict[str, Any]) -> None:
    law = Law(shell_of(keys))
    for e in STRAINS:
        h = 1e-5
        stress, tangent = law.stress(e), law.tangent(e)
        for i, step in enumerate(h * np.eye(3)):
            slope = (law.energy(e + step) - law.energy(e - step)) / (2.0 * h)
            assert slope == pytest.approx(stress[i], abs=1e-7 * np.abs(tangent).max())
            change = (law.stress(e + step) - law.stress(e - step)) / (2.0 * h)
            np.testing.assert_allclose(change, tangent[i], rtol=0.0, atol=1e-4 * np.abs(tangent).max())


@every_law
def test_at_rest_it_is_the_library(keys: dict[str, Any]) -> None:
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
def test_its_tangent_is_positive_semidefinite(keys: dict[str, Any]) -> None:
    law = Law(shell_of(keys))
    for e in STRAINS:
        values = np.linalg.eigvalsh(law.tangent(e))
        assert values[0] >= -1e-12 * values[2]


@stable
@pytest.mark.parametrize("degrees", [0.0, 30.0, 45.0, 90.0])
def test_a_strip_pushed_together_never_gives_way(keys: dict[str, Any], degrees: float) -> None:
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


def test_st_venant_kirchhoff_gives_way() -> None:
    # what the test above is to see
    law = Law(shell_of({"cloth": "gray-interlock"}))
    forces = [x * law.stress(np.array([0.5 * (x * x - 1.0), 0.0, 0.0]))[0] for x in (0.6, 0.577, 0.5)]
    assert forces[1] < forces[0]
    assert forces[1] < forces[2]


def test_incompressible_sheet_is_pulled_as_theory_says() -> None:
    # Treloar: a strip of thickness h with ν = ½ is pulled with E h/3 (λ − 1/λ²)
    law = Law(shell_of(SHEET | {"poisson": 0.5, "law": "neo-hookean"}))
    for stretch in (0.5, 0.9, 1.5, 3.0):
        along = 0.5 * (stretch**2 - 1.0)
        across = brentq(lambda y, x=along: law.stress(np.array([x, y, 0.0]))[1], -0.49, 2.0, xtol=1e-14)
        assert 1.0 + 2.0 * across == pytest.approx(1.0 / stretch, rel=1e-9)
        force = stretch * law.stress(np.array([along, across, 0.0]))[0]
        assert force == pytest.approx(2.0e3 / 3.0 * (stretch - stretch**-2), rel=1e-9)


def test_fitted_cloths_are_nearer_to_their_tables() -> None:
    errors = fit_errors()
    assert set(errors) == set(measured())
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
        term, x = simulation.problem.membrane, simulation.system.x
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
        ({"cloth": "paper", "law": "measured"}, "paper was not"),
        ({"cloth": "aluminium", "law": "measured"}, "aluminium was not"),
        (SHEET | {"poisson": 0.3, "law": "measured"}, "measured is for cloths that were: 11oz"),
        ({"cloth": "gray-interlock", "law": "neo-hookean"}, "is for isotropic sheets"),
        ({"cloth": "gray-interlock", "law": "ogden"}, "must be one of stvk, measured, neo-hookean"),
    ],
)
def test_laws_of_other_materials_are_refused(material: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=r"material\.law") as refused:
        scene_of({"mesh": {"grid": GRID}, "material": material, "time": {"end": 1.0, "step": 0.1}})
    assert words in str(refused.value)


GRID = {"width": 1.0, "height": 1.0, "nx": 2, "ny": 2}


def test_two_laws_in_a_scene_are_refused() -> None:
    materials = [{"cloth": "gray-interlock", "law": "measured"}, {"cloth": "paper", "group": "a"}]
    mesh = {"grid": GRID, "name": "a"}
    with pytest.raises(InputError, match=r"material\[1\]\.law: all materials of a scene share one"):
        Simulation({"mesh": mesh, "material": materials}, MPI.COMM_SELF)
