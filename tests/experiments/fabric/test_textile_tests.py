"""Textile tests: known constants of materials, shadows of known area, and refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

import lyra_petsc
from lyra_petsc.errors import InputError
from lyra_petsc.experiments import drape
from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.drape import DISC, count_folds, disc_mesh, drape_coefficient, shadow
from lyra_petsc.experiments.fabric import textile_tests
from lyra_petsc.experiments.fabric.fabric_report import Record, pictures
from lyra_petsc.experiments.fabric.specimens import Fabric, fabric_of
from lyra_petsc.experiments.fabric.textile_tests import TESTS, cases_of
from lyra_petsc.scene.materials.measured_curves import force_at

FABRIC = Fabric(
    "fabric",
    {
        "density": 0.2,
        "membrane": {"c11": 900.0, "c22": 800.0, "c12": 50.0, "c33": 30.0},
        "bending": {"d11": 1e-5, "d12": 0.0, "d22": 5e-6, "d33": 3e-6},
        "bending_model": "midedge",
    },
)


@pytest.fixture(autouse=True)
def fewer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Coarse meshes and few load steps, which suffice for known constants."""
    fewer = {"CELLS": 30, "PULLS": 12, "SHEARED": 6.0, "SHEARS": 12, "TURNS": 5}
    for name, value in fewer.items():
        monkeypatch.setattr(textile_tests, name, value)


@pytest.mark.parallel(2)
def test_the_cantilever_reproduces_b(comm: MPI.Comm) -> None:
    bias = Fabric("fabric", FABRIC.block | {"warp_degrees": 30.0})  # where it lies in the scene
    with Bench(comm) as bench:
        record = textile_tests.cantilever(bench, bias, 90.0)
    assert record.verdicts["B"].passed, record.verdicts
    numbers = {number.quantity: number.value for number in record.numbers}
    assert numbers["B"] == pytest.approx(5.0, rel=5e-3)  # µN·m, of the weft
    assert numbers["overhang"] == pytest.approx(2.0 * numbers["bending length c"])


def test_bending_reproduces_b_and_2hb() -> None:
    rubbing = Fabric("fabric", FABRIC.block | {"friction_moment": [3e-4, 1e-4]})
    with Bench(MPI.COMM_SELF) as bench:
        record = textile_tests.bending(bench, rubbing, 0.0)
    assert set(record.verdicts) == {"B", "2HB at 0.5 cm⁻¹", "2HB at 1.5 cm⁻¹"}
    assert all(verdict.passed for verdict in record.verdicts.values()), record.verdicts
    assert record.numbers[0].value == pytest.approx(1e-5 / 9.80665e-5, rel=0.01)
    assert record.numbers[1].value == pytest.approx(6e-4 / 9.80665e-3, rel=0.01)


def test_shear_and_tension_reproduce_their_constants() -> None:
    rubbing = Fabric("fabric", FABRIC.block | {"friction_force": 0.7})
    with Bench(MPI.COMM_SELF) as bench:
        sheared, pulled = textile_tests.shear(bench, rubbing, 0.0), textile_tests.tensile(bench, FABRIC, 90.0)
    assert set(sheared.verdicts) == {"G", "2HG", "2HG5"}
    assert all(verdict.passed for verdict in sheared.verdicts.values()), sheared.verdicts
    assert sheared.numbers[0].value == pytest.approx(np.radians(30.0) / 0.980665, rel=5e-3)
    assert sheared.numbers[2].value == pytest.approx(2.0 * 0.7 / 0.980665, rel=1e-4)
    emt = pulled.numbers[0].value / 100.0
    # (1 + e) c22 E of a strip that cannot contract
    assert 800.0 * (1.0 + emt) * 0.5 * ((1.0 + emt) ** 2 - 1.0) == pytest.approx(490.3, rel=0.02)


def test_tension_reproduces_a_curve() -> None:
    """Also one that softens below the slope at rest, and that of the weft only."""
    curve = [[e, 600.0 * (1.0 - np.exp(-e / 0.02))] for e in (0.001, 0.004, 0.01, 0.03, 0.08, 0.2, 0.5)]
    law = {"warp": [[0.1, 50.0]], "weft": curve, "shear": [[0.1, 5.0]]}
    soft = Fabric("soft", {"density": 0.2, "bending": 1e-5, "bending_model": "midedge", "law": law})
    with Bench(MPI.COMM_SELF) as bench:
        record = textile_tests.tensile(bench, soft, 90.0)
    assert record.curves[0].y[-1] >= 500.0
    points = tuple((0.0 + x, 0.0 + y) for x, y in [(0.0, 0.0), *curve])
    forces = [force_at(points, x / 100.0) / 0.980665 for x in record.curves[0].x]
    assert record.curves[0].y == pytest.approx(forces, rel=1e-9)
    assert [force_at(points, x) for x, _ in points] == pytest.approx([y for _, y in points])


def test_shorter_steps_do_not_shift_the_curve(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if steps failed and were repeated."""
    with Bench(MPI.COMM_SELF) as bench:
        exact = textile_tests.tensile(bench, FABRIC, 0.0)
        steps, path = bench.steps, textile_tests._path
        monkeypatch.setattr(textile_tests, "_path", lambda values: path([0.0] * (2 * len(values) + 5)))
        again = textile_tests.tensile(bench, FABRIC, 0.0)
        assert bench.steps > 3 * steps
    assert again.curves[0].x == exact.curves[0].x
    assert again.curves[0].y == pytest.approx(exact.curves[0].y, rel=1e-6)


@pytest.mark.parametrize("test", ["bending", "cantilever", "shear", "loop"])
def test_a_stiff_membrane_does_not_lock(test: str) -> None:
    """Triangles that cross the lines of bending would make B a quarter too large."""
    metal = Fabric("metal", {"young": 7e9, "poisson": 0.3, "thickness": 1e-4, "density": 0.27})
    with Bench(MPI.COMM_SELF) as bench:
        record = getattr(textile_tests, test)(
            bench, Fabric("metal", metal.block | {"bending_model": "midedge"}), 0.0
        )
    assert record.verdicts
    assert all(verdict.passed for verdict in record.verdicts.values()), record.verdicts


def test_heart_loops_with_and_without_weight() -> None:
    assert textile_tests.loop_height(100.0) == pytest.approx(0.13386, abs=1e-4)
    # Peirce's formula is an approximation
    height = 6.0 * textile_tests.loop_height(1.0 / 6.0)
    assert textile_tests.loop_length(height, 6.0) == pytest.approx(1.0, rel=0.05)
    with Bench(MPI.COMM_SELF) as bench:
        record = textile_tests.loop(bench, FABRIC, 0.0)
    assert len(record.verdicts) == 3
    assert all(verdict.passed for verdict in record.verdicts.values()), record.verdicts


def test_a_loop_that_friction_holds_is_measured() -> None:
    """The shortest is no longer than one without weight, where Peirce's formula gives no number."""
    assert np.isnan(textile_tests.loop_length(0.13, 1.0))
    assert np.isnan(textile_tests.loop_length(0.6, 1.0))
    kes = {"B": 0.145, "2HB": 0.105, "G": 1.35}
    block = {"density": 0.245, "membrane": {"c11": 3900, "c22": 2100, "c12": 250}, "kes": kes}
    rubbing = Fabric("rubbing", block | {"bending_model": "midedge"})
    case = next(case for case in cases_of("loop") if case.name == "loop-warp")
    outcome = textile_tests.run_case(MPI.COMM_SELF, case, rubbing, lambda: None)
    assert outcome.status == "measured"
    assert not outcome.passed
    assert not outcome.failed


def test_a_failed_formula_fails_its_test_only(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*arguments: Any) -> Record:
        raise ArithmeticError("the heart loop's elastica was not found")

    monkeypatch.setitem(TESTS, "loop", replace(TESTS["loop"], measure=fails))
    outcome = textile_tests.run_case(MPI.COMM_SELF, cases_of("loop")[0], FABRIC, lambda: None)
    assert outcome.failed
    assert "elastica was not found" in outcome.record.stopped


@pytest.mark.parametrize(("stiffness", "cells"), [(1e-4, 24), (2e-6, 30), (2.5e-7, 60)])
def test_cells_of_the_drape_are_shorter_than_the_bending_length(stiffness: float, cells: int) -> None:
    """c = 37, 10.07 and 5.03 mm; cells along the diameter of 30 cm."""
    fabric = Fabric("fabric", FABRIC.block | {"bending": stiffness, "density": 0.2})
    assert textile_tests.cells_across(fabric) == cells


def test_the_drape_is_kept_and_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The run of the first of two starts, which end long before they are at rest."""
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(textile_tests, "STARTS", 2)
    monkeypatch.setattr(textile_tests, "cells_across", lambda fabric: 6)
    monkeypatch.setattr(drape, "STEPS", 2)
    (case,) = cases_of("cusick")
    outcome = textile_tests.run_case(MPI.COMM_SELF, case, FABRIC, lambda: None, tmp_path)
    assert outcome.status == "measured"
    run = lyra_petsc.Run(tmp_path / "cusick")
    np.testing.assert_allclose(run.positions[-1], outcome.record.drape, atol=1e-7)
    assert "disc" in run.scene.obstacles
    assert run.summary["outcome"] == "done"
    names = {drawing.name: drawing.png for drawing in pictures(outcome)}
    assert names.keys() == {"plots/cusick-drape", "plots/cusick-shadow"}
    assert all(png.startswith(b"\x89PNG") for png in names.values())


@pytest.mark.parametrize("count", [3, 6])
def test_folds_and_drape_coefficient_of_a_known_shadow(count: int) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    rim = 0.12 * (1.0 + 0.08 * np.cos(count * angle))
    vertices, faces = disc_mesh(angle)
    vertices[:-1] *= (rim / DISC)[:, None]
    dark = shadow(vertices, faces, 240)
    assert count_folds(dark) == count
    area = 0.5 * np.sum(rim[:-1] * rim[1:] * np.sin(np.diff(angle)))
    exact = (area - np.pi * DISC**2) / (np.pi * (0.15**2 - DISC**2))
    assert drape_coefficient(dark) == pytest.approx(exact, abs=0.005)
    assert count_folds(shadow(*disc_mesh(angle), 240)) == 0


@pytest.mark.parametrize(
    ("material", "settings", "words"),
    [
        ("gray-interlok", (), "gray-interlock"),
        ("no.yaml", (), "no.yaml"),
        ("gray-interlock", ("time.end=1",), "changes a scene"),
    ],
)
def test_invalid_materials_are_refused(material: str, settings: Any, words: str) -> None:
    with pytest.raises(InputError) as caught:
        fabric_of(material, settings)
    assert words in str(caught.value)
