"""The command ``stress``: table, folder, exit codes."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from launch import (
    PLAIN,
    REDUNDANT,
    done,
    finish,
    lyra,
    read_csv,
    read_json,
    start,
    wait_until,
    write_scene,
)

from lyra_petsc.experiments.stress.cases import FAMILIES
from lyra_petsc.experiments.stress.stress_runner import StressView

TWO = ["--only", "one-triangle,chain-1e6"]


def test_list_names_families_and_cases(tmp_path: Path) -> None:
    left = done(["stress", "--full", "--list"], tmp_path)
    words = [line.split()[0].rstrip(":") for line in left.out.splitlines()]
    assert words == [name for f in FAMILIES.all() for name in (f.name, *(case.name for case in f.cases))]
    count = sum(len(family.cases) for family in FAMILIES.all())
    assert f"{count} of {count} cases" in left.err
    usual = lyra(["stress", "--list"], tmp_path).out.splitlines()
    quick = lyra(["stress", "--quick", "--list"], tmp_path).out.splitlines()
    assert len(quick) < len(usual) < len(words)
    assert list(tmp_path.iterdir()) == []


def test_cases_pass_and_tables_and_a_page_are_written(tmp_path: Path) -> None:
    pytest.importorskip("jinja2")
    left = done(["stress", "--quick", *TWO], tmp_path)
    assert "2 of 2 cases passed" in left.out
    folder = tmp_path / "stress" / "sheet"
    rows = read_csv(folder / "stress.csv")
    assert tuple(rows[0]) == StressView.columns
    assert [row["case"] for row in rows] == ["one-triangle", "chain-1e6"]
    assert {row["passed"] for row in rows} == {"True"}
    assert [int(row["steps"]) for row in rows] == [40, 40]
    assert all(0.0 < float(row["energy_defect"]) < float(row["energy_tolerance"]) for row in rows)
    assert all(float(row["step_over_base"]) > 0.0 for row in rows)
    content = read_json(folder / "stress.json")
    assert content["passed"] is content["complete"] is True
    assert content["ranks"] == 1
    assert set(content["cases"][1]["verdicts"]) == {
        "converged", "equations", "resolved", "energy", "no gain", "momentum", "softening", "stiff limit",
        "whole run"
    }  # fmt: skip
    report = (folder / "report.md").read_text()
    assert "2 of 2 cases passed" in report
    assert "stress --quick --only one-triangle,chain-1e6" in report
    assert "stiff limit" in (folder / "report.html").read_text()


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_given_scene_runs_the_cases_that_apply_to_it(tmp_path: Path, ranks: int) -> None:
    scene = write_scene(tmp_path)
    names = "bending-1e6,jump,slivers"
    words = ["stress", scene, "--quick", "--only", names, "--set", "gravity=[0, 0, -5]"]
    left = done([*words, *REDUNDANT], tmp_path, ranks, PLAIN)
    assert "slivers: left out" in left.out
    assert "2 of 2 cases passed" in left.out
    content = read_json(tmp_path / "stress" / "scene" / "stress.json")
    assert [case["name"] for case in content["cases"]] == ["bending-1e6", "jump"]
    assert list(content["left_out"]) == ["slivers"]


def test_a_failed_verdict_is_exit_code_1(tmp_path: Path) -> None:
    # steps that stop at a tenth of their first residual violate the scene's tolerances
    left = lyra(["stress", "--quick", *TWO, "--out", "out", "-snes_rtol", "0.1"], tmp_path, extra=PLAIN)
    assert left.code == 1, left.err + left.out
    assert "equations: worst in step" in left.out
    assert left.ours == []
    content = read_json(tmp_path / "out" / "stress.json")
    assert content["passed"] is False
    assert content["cases"][0]["failures"].startswith("equations: ")
    assert "What failed" in (tmp_path / "out" / "report.md").read_text()


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_base_scene_that_fails_is_exit_code_3(tmp_path: Path, ranks: int) -> None:
    left = lyra(["stress", "--quick", "--out", "out", "-snes_max_it", "0"], tmp_path, ranks)
    assert left.code == 3, left.err + left.out
    [line] = left.ours
    assert "did not converge" in line
    assert list(tmp_path.iterdir()) == []


def test_ranks_option_starts_mpirun(tmp_path: Path) -> None:
    """One mpirun per case, as for ``study``."""
    scene = write_scene(tmp_path)
    words = ["stress", scene, "--quick", "--only", "membrane-1e-3", "--ranks", "2", "--out", "out"]
    left = lyra([*words, *REDUNDANT], tmp_path, extra=PLAIN)
    if "not found" in left.err:
        pytest.skip("needs mpirun")
    assert left.code == 0, left.err + left.out
    content = read_json(tmp_path / "out" / "stress.json")
    assert content["ranks"] == 2
    assert [case["passed"] for case in content["cases"]] == [True]
    assert [len(case["newton_iterations"]) for case in content["cases"]] == [20]


def test_a_signal_ends_the_command_between_cases(tmp_path: Path) -> None:  # SIGINT: see the tests of verify
    process = start(["stress", "--only", "one-triangle,rigid-plate", "--out", "out"], tmp_path)
    wait_until((tmp_path / "out" / "stress.json").exists, process)
    process.send_signal(signal.SIGTERM)
    left = finish(process)
    assert left.code == 143, left.err
    assert "stopped by SIGTERM" in left.err
    content = read_json(tmp_path / "out" / "stress.json")
    assert content["complete"] is False
    assert [case["name"] for case in content["cases"]] == ["one-triangle"]
    assert "one-triangle" in (tmp_path / "out" / "report.md").read_text()
