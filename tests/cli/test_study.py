"""The command ``study``: files, signals, resumption, refusals."""

from __future__ import annotations

import fcntl
import math
import re
import signal
from pathlib import Path

import pytest
from launch import done, finish, lyra, read_csv, read_json, refused, start, wait_until, write_scene

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")
pytest.importorskip("scipy")

HANGING = """\
title: Hanging square
mesh: {grid: {width: 1.0, height: 1.0, nx: 4, ny: 4}}
material: {density: 0.15, membrane: {c11: 800, c22: 800, c12: 160, c33: 240}, bending: 2.0e-5, damping: 0.005}
gravity: [0, 0, -9.81]
handles: [{group: corners}]
time: {end: 0.08, step: 0.01}
output: {every: 0.04, fields: [velocity]}
probes: {middle: {nodes: [12]}}
"""

FALLING = """\
mesh: {grid: {width: 0.6, height: 0.4, nx: 3, ny: 2}}
material: {density: 0.2, membrane: {c11: 800, c22: 800, c12: 160, c33: 240}}
gravity: [0, 0, -9.81]
wind: {velocity: [0, 0, 0], density: 1.0}
time: {end: 0.1, step: 0.01}
output: {every: 0.05}
"""


def results(folder: Path) -> dict[str, float]:
    """Times at which the finished cases were finished."""
    return {path.parent.name: path.stat().st_mtime for path in folder.glob("cases/*/result.json")}


def test_a_study_writes_all_files(tmp_path: Path) -> None:
    write_scene(tmp_path, HANGING)
    words = ["study", "scene.yaml", "--vary", "integrator=beuler,bdf2", "--vary", "dt=0.02,0.01,0.005",
             "--repeats", "2", "-ksp_rtol", "1e-3"]  # fmt: skip
    left = done(words, tmp_path)
    folder = tmp_path / "studies" / "scene"
    assert "6 of 6 combinations done, 0 failed" in left.out
    assert "For 1 % choose" in left.out
    rows = read_csv(folder / "study.csv")
    assert [row["combination"] for row in rows][:2] == ["beuler-dt0.02", "beuler-dt0.01"]
    for row in rows:
        assert row["status"] == "done"
        assert float(row["dt"]) == pytest.approx(float(row["dt_mean"]))
        assert int(row["steps"]) == round(0.08 / float(row["dt"]))
        assert float(row["run_seconds_min"]) <= float(row["run_seconds"]) <= float(row["run_seconds_max"])
        assert float(row["total_seconds"]) > float(row["run_seconds"])
        assert float(row["seconds_solve"]) > 0.0
        assert int(row["newton_iterations"]) >= int(row["steps"])
        assert row["repeats"] == "2"
    euler = [float(row["error_position_max"]) for row in rows[:3]]
    assert euler == sorted(euler, reverse=True)
    assert float(rows[2]["order_dt_position_max"]) == pytest.approx(1.0, abs=0.25)
    assert {row["recommended"] for row in rows} == {"yes", "no"}
    whole = read_json(folder / "study.json")
    assert whole["references"][0]["kind"] == "finer"
    assert whole["references"][0]["own_error"]["position_max"]["error"] > 0.0
    assert len(whole["combinations"][0]["timings"]) == 2
    assert "probe_middle" in whole["quantities"]
    names = {path.name for path in folder.iterdir()}
    assert {"work-precision.png", "work-precision.svg", "report.md", "report.html"} <= names
    assert "convergence-dt-position-max.png" in names
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert not re.search(r"https?://", page)
    assert str(tmp_path) not in page
    text = (folder / "report.md").read_text(encoding="utf-8")
    assert (
        "python -m lyra_petsc study scene.yaml --vary integrator=beuler,bdf2 --vary dt=0.02,0.01,0.005 "
        "--reference auto --repeats 2 -ksp_rtol 1e-3"
    ) in text
    for word in ("Recommendation", "Reference", "numpy", "Pareto"):
        assert word in text
    assert text.count("★") == 2  # in the table and below it


def test_exact_answers_on_two_ranks(tmp_path: Path) -> None:
    write_scene(tmp_path, FALLING)
    words = ["study", "scene.yaml", "--vary", "integrator=beuler,midpoint", "--vary", "dt=0.025,0.0125"]
    done([*words, "--repeats", "1", "--out", "two", "--quantities", "position"], tmp_path, ranks=2)
    rows = read_csv(tmp_path / "two" / "study.csv")
    assert read_json(tmp_path / "two" / "study.json")["references"][0]["kind"] == "exact"
    assert float(rows[1]["order_dt_position_max"]) == pytest.approx(1.0, abs=0.1)
    assert float(rows[3]["order_dt_position_max"]) == pytest.approx(2.0, abs=0.1)
    assert rows[0]["ranks"] == "2"
    assert all(row["not_resolved"] == "" for row in rows)
    assert float(rows[0]["error_position_max"]) == pytest.approx(backward_euler_error(0.025), rel=1e-6)


def backward_euler_error(dt: float) -> float:
    """Error of a level sheet falling in still air, at 0.05 and 0.1 s, over its diagonal."""
    g, terminal = 9.81, math.sqrt(0.2 * 9.81 / 1.0)
    v = z = worst = 0.0
    for step in range(1, round(0.1 / dt) + 1):
        drag = dt * g / terminal**2  # v = v_before + g Δt - drag v²
        v = (math.sqrt(1.0 + 4.0 * drag * (v + g * dt)) - 1.0) / (2.0 * drag)
        z += dt * v
        exact = terminal**2 / g * math.log(math.cosh(g * step * dt / terminal))
        if step * dt in (0.05, 0.1):
            worst = max(worst, z - exact)
    return worst / math.hypot(0.6, 0.4)


def test_a_failed_combination_is_a_row_and_the_study_continues(tmp_path: Path) -> None:
    write_scene(tmp_path, HANGING)
    words = ["study", "scene.yaml", "--vary", "max_iterations=1,50", "--vary", "pc_type=pbjacobi,bogus,lu"]
    left = done(
        [*words, "--repeats", "1", "--out", "out", "--quantities", "energy", "-ts_adapt_dt_min", "0.004"],
        tmp_path,
    )
    rows = read_csv(tmp_path / "out" / "study.csv")
    assert [row["status"] for row in rows] == ["failed"] * 3 + ["done", "failed", "done"]
    assert "did not converge" in rows[0]["reason"]
    assert "bogus" in rows[4]["reason"]
    assert rows[0]["error_energy"] == ""
    assert float(rows[3]["error_energy"]) > 0.0
    assert "2 of 6 combinations done, 4 failed" in left.out
    report = (tmp_path / "out" / "report.md").read_text(encoding="utf-8")
    assert "What failed" in report


def test_if_all_combinations_fail_the_exit_code_is_3(tmp_path: Path) -> None:
    write_scene(tmp_path, HANGING.replace("step: 0.01", "step: 0.04"))
    left = lyra(
        ["study", "scene.yaml", "--vary", "max_iterations=1", "--repeats", "1", "--out", "out"], tmp_path
    )
    assert left.code == 3
    assert len(left.ours) == 1
    assert "all 1 combinations failed" in left.ours[0]
    assert read_csv(tmp_path / "out" / "study.csv")[0]["status"] == "failed"
    assert (tmp_path / "out" / "report.html").exists()
    assert "★" not in (tmp_path / "out" / "report.md").read_text(encoding="utf-8")


LONG = ["study", "scene.yaml", "--vary", "dt=0.02,0.002", "--repeats", "1", "--out", "out",
        "--quantities", "energy"]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGKILL, -9)])
def test_a_stopped_study_resumes_without_repeating(tmp_path: Path, number: int, code: int) -> None:
    write_scene(tmp_path, HANGING)
    process = start(LONG, tmp_path)
    wait_until((tmp_path / "out" / "cases" / "dt0.02" / "result.json").exists, process)
    wait_until((tmp_path / "out" / "cases" / "dt0.002" / "history.csv").exists, process)
    process.send_signal(number)
    stopped = finish(process)
    assert stopped.code == code
    if code > 0:
        assert "--resume goes on" in stopped.ours[0]
    before = results(tmp_path / "out")
    assert "dt0.02" in before
    assert not (tmp_path / "out" / "study.csv").exists()
    left = done(["study", "--out", "out", "--resume"], tmp_path)
    assert "2 of 2 combinations done" in left.out
    assert "1/2 Δt 20 ms: finished before" in left.err
    after = results(tmp_path / "out")
    assert {name: after[name] for name in before} == before
    if number == signal.SIGKILL:
        return
    # a second time nothing is left to run, and all is written anew
    (tmp_path / "out" / "study.csv").unlink()
    done(["study", "scene.yaml", "--out", "out", "--resume"], tmp_path)
    assert results(tmp_path / "out") == after
    assert len(read_csv(tmp_path / "out" / "study.csv")) == 2
    # a wider sweep runs new combinations only
    done(["study", "--out", "out", "--resume", "--vary", "dt=0.01,0.02,0.002"], tmp_path)
    wider = results(tmp_path / "out")
    assert {name: wider[name] for name in after} == after
    assert len(read_csv(tmp_path / "out" / "study.csv")) == 3


@pytest.mark.slow
def test_ranks_option_starts_an_mpirun_for_each_case(tmp_path: Path) -> None:
    write_scene(tmp_path, FALLING)
    words = ["study", "scene.yaml", "--vary", "dt=0.025,0.0125", "--repeats", "1", "--ranks", "2",
             "--quantities", "position"]  # fmt: skip
    done([*words, "--vary", "integrator=beuler", "--out", "two", "-ksp_rtol", "1e-4"], tmp_path)
    rows = read_csv(tmp_path / "two" / "study.csv")
    assert [row["ranks"] for row in rows] == ["2", "2"]
    assert float(rows[1]["order_dt_position_max"]) == pytest.approx(1.0, abs=0.1)
    assert not list(tmp_path.glob("two/cases/*.json"))
    refused([*words, "--out", "inside"], tmp_path, "--ranks: starts one mpirun per case", ranks=2)
    assert not (tmp_path / "inside").exists()


@pytest.mark.slow
def test_a_signal_stops_all_ranks(tmp_path: Path) -> None:
    write_scene(tmp_path, HANGING)
    # 80,000 steps, so that the signal comes before the end
    process = start([*LONG[:3], "dt=0.000001", *LONG[4:], "--ranks", "2"], tmp_path)
    wait_until(lambda: list(tmp_path.glob("out/cases/*/history.csv")), process)
    process.send_signal(signal.SIGTERM)
    left = finish(process)
    assert left.code == 143
    assert len(left.ours) == 1
    assert results(tmp_path / "out") == {}


@pytest.mark.slow
def test_two_studies_in_one_folder_are_refused(tmp_path: Path) -> None:
    write_scene(tmp_path, FALLING)
    words = [*LONG[:3], "dt=0.05", *LONG[4:]]
    done(words, tmp_path)
    with (tmp_path / "out" / "study.lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        for more in ("--resume", "--force"):
            refused([*words, more], tmp_path, "another study is at work")
    before = results(tmp_path / "out")
    (tmp_path / "out" / "mine.txt").write_text("kept")
    done([*words, "--force"], tmp_path)
    assert results(tmp_path / "out") != before
    assert (tmp_path / "out" / "mine.txt").read_text() == "kept"


@pytest.mark.slow
def test_an_existing_run_as_reference(tmp_path: Path) -> None:
    write_scene(tmp_path, HANGING)
    fine = ["run", "scene.yaml", "--set", "time.step=0.001", "--out", "fine"]
    done(fine, tmp_path)
    words = ["study", "scene.yaml", "--vary", "dt=0.01", "--repeats", "1", "--quantities", "position",
             "--out", "out"]  # fmt: skip
    done([*words, "--reference", "run:fine"], tmp_path)
    whole = read_json(tmp_path / "out" / "study.json")
    assert whole["references"][0]["kind"] == "run"
    assert float(read_csv(tmp_path / "out" / "study.csv")[0]["error_position_max"]) > 1e-4
    for change, words_of_it in (
        ("mesh.grid.nx=5", "is a run of another mesh"),
        ("output.every=0.02", "has no state at t = 0.02 s"),
        ("time.end=0.12", "has no state at t = 0.12 s"),
    ):
        refused([*words[:-1], "new", "--reference", "run:fine", "--set", change], tmp_path, words_of_it)


@pytest.mark.parametrize(
    ("words", "because"),
    [
        (["--vary", "dt="], "no values"),
        (["--vary", "steps=0.01"], "unknown key"),
        (["--vary", "ksp_rtol=1e-3", "-ksp_rtol", "1e-4"], "would fix what varies"),
        (["--quantities", "positon"], "did you mean 'position'"),
        (["--reference", "exact:free-fall"], "which has handles"),
        (["--resume"], "no study of scene"),
        (["--resume", "--force"], "give one of them"),
    ],
)
def test_bad_input_is_one_line_without_files(tmp_path: Path, words: list[str], because: str) -> None:
    write_scene(tmp_path, HANGING)
    refused(["study", "scene.yaml", *words], tmp_path, because)
