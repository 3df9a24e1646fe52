"""The command ``verify``: tables, folder, exit codes."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from launch import PICTURES, PLAIN, done, finish, lyra, read_csv, read_json, start, wait_until, without

from lyra_petsc.experiments.verification.cases import CASES


def test_list_names_every_case(tmp_path: Path) -> None:
    left = done(["verify", "--list"], tmp_path)
    assert [line.split()[0] for line in left.out.splitlines()] == list(CASES.entries)
    assert f"{len(CASES.entries)} cases" in left.err


def test_a_case_passes(tmp_path: Path) -> None:
    left = done(["verify", "free-fall", "patch-states", "--quick", "--out", "out"], tmp_path, 2)
    assert f"2 of {len(CASES.entries)} cases\n" in left.out
    assert "2 of 2 cases passed" in left.out
    assert "order 1.00, as expected 1" in left.out
    assert "exact [m]" in left.out
    rows = read_csv(tmp_path / "out" / "verify.csv")
    fall = [row for row in rows if row["case"] == "free-fall" and row["quantity"].startswith("mean z")]
    assert [float(row["n"]) for row in fall] == [10, 100]
    assert float(fall[1]["error"]) == pytest.approx(0.1)
    assert {row["passed"] for row in rows} == {"True"}
    content = read_json(tmp_path / "out" / "verify.json")
    assert content["passed"] is True
    assert content["ranks"] == 2
    assert [case["name"] for case in content["cases"]] == ["free-fall", "patch-states"]
    report = (tmp_path / "out" / "report.md").read_text()
    assert "2 of 2 cases passed" in report
    assert "verify free-fall patch-states --quick" in report


def test_the_page_has_plots_and_unused_petsc_options_are_reported(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("jinja2")
    left = done(["verify", "free-fall", "--quick", "--out", "out", "-snes_typo", "1"], tmp_path)
    assert left.ours == ["lyra-petsc: warning: PETSc options that nothing used: -snes_typo"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("data:image/svg+xml;base64,") == 1
    assert (tmp_path / "out" / "plots" / "free-fall-convergence.png").stat().st_size > 1000


@pytest.mark.parametrize("words", [["verify", "free-fall"], ["stress", "--only", "free"]])
def test_tables_without_the_packages_for_pictures(tmp_path: Path, words: list[str]) -> None:
    (tmp_path / "out").mkdir()
    left = without(PICTURES, [*words, "--quick", "--out", "out", "--force"], tmp_path)
    assert left.code == 0, left.err
    assert "1 of 1 cases passed" in left.out
    assert "pip install 'lyra-petsc[study]'" in left.out
    expected = ["report.md", f"{words[0]}.csv", f"{words[0]}.json"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == expected


def test_a_wrong_answer_is_exit_code_1(tmp_path: Path) -> None:
    # stopped after two steps the sheet has not fallen as far as it should
    arguments = ["verify", "free-fall", "patch-states", "--quick", "--out", "out", "-ts_max_steps", "2"]
    left = lyra(arguments, tmp_path, extra=PLAIN)
    assert left.code == 1, left.err
    assert "1 of 2 cases passed" in left.out
    assert "FAILED" in left.out
    content = read_json(tmp_path / "out" / "verify.json")
    assert content["passed"] is False
    assert [case["passed"] for case in content["cases"]] == [False, True]


def test_a_failed_simulation_is_a_row_and_exit_code_1(tmp_path: Path) -> None:
    arguments = ["verify", "oscillator", "patch-states", "--quick", "-snes_max_it", "0"]
    left = lyra(arguments, tmp_path, extra=PLAIN)
    assert left.code == 1, left.err
    assert "could not run" in left.out
    assert "patch-states  passed" in left.out
    assert left.ours == []


def test_a_signal_ends_the_command_after_a_case(tmp_path: Path) -> None:
    process = start(["verify", "free-fall", "circular-membrane", "--out", "out"], tmp_path)
    wait_until((tmp_path / "out" / "verify.json").exists, process)
    process.send_signal(signal.SIGINT)
    left = finish(process)
    assert left.code == 130, left.err
    assert "stopped by SIGINT" in left.err
    content = read_json(tmp_path / "out" / "verify.json")
    assert [case["name"] for case in content["cases"]] == ["free-fall"]
