"""PETSc's TS options choose the integrator and fixed or adaptive steps."""

from __future__ import annotations

from pathlib import Path

import pytest
from launch import done, refused, write_scene

from lyra_petsc.scene.load import load_scene

HANGING = """
mesh: {grid: {width: 1, height: 1, nx: 4, ny: 4}}
material: {density: 0.1, membrane: {c11: 100, c22: 100, c12: 0, c33: 50}, bending: 1e-4}
gravity: [0, 0, -9.81]
handles: [{nodes: [20, 24]}]
time: {end: 0.02, step: 0.005, integrator: semi-implicit}
"""


@pytest.mark.parametrize(
    ("options", "integrator"),
    [
        ("", "semi-implicit"),
        ("-ts_type beuler", "beuler"),
        ("-ts_type theta", "midpoint"),
        ("-ts_type theta -ts_theta_theta 1", "beuler"),
        ("-ts_type bdf -ts_bdf_order 2", "bdf2"),
        ("-ts_type alpha2 -ts_alpha_radius 0.5", "alpha2"),
    ],
)
def test_the_command_line_chooses_the_integrator(tmp_path: Path, options: str, integrator: str) -> None:
    write_scene(tmp_path, HANGING)
    left = done(["run", "scene.yaml", "--out", "out", *options.split(), "-options_left"], tmp_path)
    assert load_scene(tmp_path / "out" / "scene.yaml").time.integrator == integrator
    assert "unused" not in left.err


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ("-ts_type cn", "-ts_type"),
        ("-ts_type bdf -ts_bdf_order 3", "-ts_bdf_order"),
        ("-ts_type theta -ts_theta_theta 0.7", "-ts_theta_theta"),
        ("-ts_theta_theta 0.5", "-ts_theta_theta"),
        ("-ts_type theta -ts_theta_endpoint", "-ts_theta_endpoint"),
        ("-ts_adapt_type glee", "-ts_adapt_type"),
    ],
)
def test_unavailable_integrators_are_refused(tmp_path: Path, options: str, key: str) -> None:
    write_scene(tmp_path, HANGING)
    refused(["run", "scene.yaml", "--out", "out", *options.split()], tmp_path, f"lyra-petsc: {key}: ")
    assert not (tmp_path / "out").exists()


def test_fixed_and_automatic_steps(tmp_path: Path) -> None:
    write_scene(tmp_path, HANGING)
    done(["run", "scene.yaml", "--out", "auto", "-ts_type", "bdf", "-ts_adapt_type", "basic"], tmp_path)
    time = load_scene(tmp_path / "auto" / "scene.yaml").time
    assert (time.step, time.tolerance) == ("auto", 1e-3)
    adaptive = ["--set", "time.step=auto", "--set", "time.integrator=bdf2", "-ts_adapt_type", "none"]
    done(["run", "scene.yaml", "--out", "fixed", *adaptive, "-ts_dt", "0.01"], tmp_path)
    rows = (tmp_path / "fixed" / "history.csv").read_text().splitlines()
    assert [row.split(",")[1] for row in rows[2:]] == ["0.01", "0.02"]
    refused(["run", "scene.yaml", "--out", "none", *adaptive], tmp_path, "give -ts_dt")


def test_the_monitor_shows_the_simulated_time(tmp_path: Path) -> None:
    write_scene(tmp_path, HANGING)
    left = done(["run", "scene.yaml", "--out", "out", "-ts_type", "alpha2", "-ts_monitor"], tmp_path)
    shown = [line.split() for line in left.out.splitlines() if " TS dt " in line]
    assert [line[0] for line in shown] == ["0", "1", "2", "3", "4"]
    assert [float(line[-1]) for line in shown] == pytest.approx([0.0, 0.005, 0.01, 0.015, 0.02])
    assert float(shown[-1][3]) == pytest.approx(0.005)
