"""PETSc options work as in every PETSc program, and unused ones are reported."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from launch import SCENE, Left, done, lyra, read_csv, read_json, write_scene
from mpi4py import MPI
from petsc4py import PETSc


def ran(folder: Path, *options: str, scene: str = SCENE, ranks: int = 1, petsc_options: str = "") -> Left:
    extra = {"PETSC_OPTIONS": petsc_options} if petsc_options else {}
    return done(["run", write_scene(folder, scene), "--out", "out", *options], folder, ranks, extra)


def test_monitors_print_and_a_direct_solver_is_used(tmp_path: Path) -> None:
    left = ran(
        tmp_path, "-ts_monitor", "-snes_monitor", "-ksp_type", "cg", "-pc_type", "lu", "-ksp_rtol", "1e-6"
    )
    assert "1 TS dt 0.01 time 0.01" in left.out
    assert "0 SNES Function norm" in left.out
    assert left.ours == []
    # a factorisation leaves conjugate gradients a few iterations, point-block Jacobi tens
    for row in read_csv(tmp_path / "out" / "history.csv")[1:]:
        assert 0 < int(row["linear_iterations"]) <= 4 * int(row["newton_iterations"])


def test_unused_options_are_one_warning(tmp_path: Path) -> None:
    left = ran(tmp_path, "-ksp_typo", "3", "-nonsense", ranks=2)
    assert left.ours == ["lyra-petsc: warning: PETSc options that nothing used: -ksp_typo, -nonsense"]


def unknown_options(text: str) -> list[str]:
    return re.findall(r"note: -(\w+): PETSc has no option of this name(?:, did you mean -(\w+)\?)?", text)


def test_options_that_nothing_knows_are_noted_before_the_first_step(tmp_path: Path) -> None:
    """Those of the scene and of the command line; known ones that are used later, or never, are not."""
    scene = write_scene(tmp_path, SCENE + "petsc: {kps_rtol: 1e-3}\n")
    given = ["-snes_monitr", "-sub_pc_typ", "ilu", "-mg_level_ksp_type", "cg", "-Q7", "-pc_mg_w_from", "1",
             "-mg_levels_2_ksp_type", "cg", "-ksp_view", "-loads_ksp_rtol", "0.1", "-log_view"]  # fmt: skip
    expected = [
        ("Q7", ""),
        ("kps_rtol", "ksp_rtol"),
        ("mg_level_ksp_type", "mg_levels_ksp_type"),
        ("snes_monitr", "snes_monitor"),
        ("sub_pc_typ", "sub_pc_type"),
    ]
    assert unknown_options(done(["check", scene, *given], tmp_path, ranks=2).out) == expected
    left = done(["run", scene, "--out", "out", *given], tmp_path)
    assert unknown_options(left.err.partition("step 1")[0]) == expected
    assert set(read_json(tmp_path / "out" / "summary.json")["notes"]) >= {
        "-kps_rtol: PETSc has no option of this name, did you mean -ksp_rtol?"
    }


def test_petsc_prints_requested_output(tmp_path: Path) -> None:
    left = ran(tmp_path, "-options_left", "-options_view", "-log_view", "-ts_view", "-help")
    for words in (
        "There are no unused options", "-options_view", "PETSc Performance Summary", "TS Object", "-ksp_type"
    ):  # fmt: skip
        assert words in left.out
    assert left.ours == []


@pytest.mark.parametrize(
    ("options", "times"),
    [
        (["-ts_max_steps", "3"], [0, 0.01, 0.02, 0.03]),
        (["-ts_dt", "0.005", "-ts_max_time", "0.015"], [0, 0.005, 0.01, 0.015]),
        (["-ts_adapt_dt_max", "0.02", "-ts_dt", "0.04"], [0, 0.02, 0.04, 0.05]),
    ],
    ids=["max_steps", "dt and max_time", "adapt_dt_max"],
)
def test_times_follow_the_options(tmp_path: Path, options: list[str], times: list[float]) -> None:
    ran(tmp_path, *options)
    assert [float(row["time"]) for row in read_csv(tmp_path / "out" / "history.csv")] == pytest.approx(
        times, abs=1e-12
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["-ts_dt", "abc"], "-ts_dt: "),
        (["-ts_max_time", "-ts_dt"], "-ts_dt: needs a number after it"),
        (["-ts_adapt_dt_min", "q"], "-ts_adapt_dt_min: "),
        (["-snes_max_it", "1.5"], "-snes_max_it: "),
        (["-ksp_type", "nonsense"], "-ksp_type: "),
        (
            ["--set", "time.integrator=alpha2", "-ts_alpha_radius", "a"],
            "-ts_alpha_radius: must be a number, not 'a'",
        ),
    ],
    ids=lambda value: value[-2] if isinstance(value, list) else "",
)
def test_a_value_that_petsc_refuses_is_named(tmp_path: Path, options: list[str], words: str) -> None:
    left = lyra(["run", write_scene(tmp_path), "--out", "out", *options], tmp_path)
    assert left.code == 2, left.err
    (line,) = left.ours
    assert line.startswith(f"lyra-petsc: {words}")
    assert not (tmp_path / "out").exists()


def test_a_run_stopped_by_ts_max_steps_says_so_and_resumes(tmp_path: Path) -> None:
    left = ran(tmp_path, "-ts_max_steps", "1")
    assert left.out.splitlines()[-1].startswith(
        "outcome      stopped at step 1, t = 0.01 of 0.05 s, by -ts_max_steps"
    )
    assert read_json(tmp_path / "out" / "summary.json")["outcome"] == "stopped"
    left = done(["run", "--out", "out", "--resume"], tmp_path)
    assert left.out.splitlines()[-1] == "outcome      done"
    assert read_json(tmp_path / "out" / "summary.json")["outcome"] == "done"
    assert len(read_csv(tmp_path / "out" / "history.csv")) == 6
    left = ran(tmp_path, "-ts_max_steps", "5", "--force")  # which is the end
    assert read_json(tmp_path / "out" / "summary.json")["outcome"] == "done"


@pytest.mark.parametrize("settings", [[], ["--set", "time.analysis=static", "--set", "time.end=1"]])
def test_an_absolute_tolerance_does_not_replace_that_of_the_scene(
    tmp_path: Path, settings: list[str]
) -> None:
    scene = write_scene(tmp_path)
    left = lyra(["run", scene, "--out", "out", *settings, "-snes_atol", "1e30"], tmp_path)
    assert left.code == 3
    assert "-snes_atol stopped Newton's method short of solver.force_tolerance" in left.ours[0]
    assert "try a smaller -snes_atol" in left.ours[0]
    ran(tmp_path, "-snes_atol", "1e-12", "--force")


def test_a_loose_relative_tolerance_is_noted(tmp_path: Path) -> None:
    left = ran(tmp_path, "-snes_rtol", "0.5")
    assert "note: step 1 (t = 0.01 s): -snes_rtol stopped Newton's method at a residual of" in left.err


def test_a_failed_line_search_does_not_end_a_step(tmp_path: Path) -> None:
    """PETSc takes a short direction, here one by Richardson's method, for convergence."""
    scene = SCENE.replace("nx: 4, ny: 4", "nx: 8, ny: 8").replace("800", "100").replace("160", "0")
    ran(tmp_path, "-ksp_type", "richardson", scene=scene.replace("2.0e-5, damping: 0.005", "1.0e-4"))
    assert (
        max(float(row["residual"]) for row in read_csv(tmp_path / "out" / "history.csv")) < 1e-5
    )  # [N]; it weighs 1.5 N


@pytest.mark.parametrize("step", ["1e30", "1e3"])
def test_a_step_longer_than_the_run_is_the_whole_run(tmp_path: Path, step: str) -> None:
    ran(tmp_path, "-ts_dt", step, scene=SCENE.replace("every: 0.02", "every: 0.05"))
    assert [float(row["time"]) for row in read_csv(tmp_path / "out" / "history.csv")] == [0.0, 0.05]


@pytest.mark.parametrize("ranks", [1, 2])
def test_views_show_the_solvers(tmp_path: Path, ranks: int) -> None:
    scene = SCENE.replace("nx: 4, ny: 4", "nx: 12, ny: 12").replace("end: 0.05", "end: 0.01")
    options = ["-pc_type", "mg", "-snes_view", "-ksp_view_mat", "binary:matrix", "-log_view"]
    out = ran(tmp_path, *options, scene=scene, ranks=ranks).out
    assert re.search(r"tolerances: relative=1e-06, absolute=[1-9].*, solution=1e-06", out)
    for words in ("levels=2 cycles=V", "operator complexity = 1.", "backward sweep of block Gauss-Seidel"):
        assert words in out
    assert "level 0: rows=507, cols=507" in out
    assert "KSP Object: (mg_coarse_)" in out
    for event in ("MGSweep", "MGTransfer", "MGGalerkin"):
        flops = re.search(rf"^{event} +(\d+) \S+ \S+ \S+ (\S+)", out, re.MULTILINE)
        assert flops, event
        assert float(flops[2]) > 0.0
    matrix = PETSc.Mat().load(PETSc.Viewer().createBinary(str(tmp_path / "matrix"), "r", MPI.COMM_SELF))
    assert matrix.size == (507, 507)
    assert matrix.isSymmetric(1e-9)
    assert matrix.getInfo()["nz_used"] > 10_000


def test_the_command_line_overrides_the_environment_which_overrides_the_scene(tmp_path: Path) -> None:
    scene = SCENE + "petsc: {ts_max_steps: 1, ts_dt: 0.001}\n"

    def steps(name: str, *options: str, petsc_options: str = "") -> tuple[int, float]:
        folder = tmp_path / name
        folder.mkdir()
        ran(folder, *options, scene=scene, petsc_options=petsc_options)
        rows = read_csv(folder / "out" / "history.csv")
        return len(rows) - 1, float(rows[1]["dt"])

    assert steps("scene") == (1, pytest.approx(0.001))
    assert steps("environment", petsc_options="-ts_max_steps 2") == (2, pytest.approx(0.001))
    assert steps("line", "-ts_max_steps", "3", petsc_options="-ts_max_steps 2 -ts_dt 0.002") == (
        3,
        pytest.approx(0.002),
    )
