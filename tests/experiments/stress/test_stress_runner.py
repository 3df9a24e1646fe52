"""Cases run on any number of ranks, and always end with a record."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from lyra_petsc.experiments.case import OUTCOME_FILE, load_record, save_record
from lyra_petsc.experiments.stress import stress_runner
from lyra_petsc.experiments.stress.cases import selected
from lyra_petsc.experiments.stress.stress_runner import (
    BaseClock,
    SavedOutcome,
    StressOutcome,
    StressView,
    csv_row,
    run_case,
)
from lyra_petsc.experiments.stress.stress_scenes import (
    Scope,
    Setting,
    StressCase,
    base_scene,
    hanging_sheet,
    setting_of,
)

SMALL = Setting(hanging_sheet(6), False, Scope.QUICK)


def run(comm: MPI.Comm, name: str) -> StressOutcome:
    [case] = selected([name], Scope.QUICK)
    return run_case(comm, case, SMALL)


@pytest.mark.parallel(2)
@pytest.mark.parametrize("name", ["chain-1e6", "stiff-1e6-40ms", "one-triangle", "jump", "folded"])
def test_a_case_passes_on_any_number_of_ranks(comm: MPI.Comm, name: str) -> None:
    outcome = run(comm, name)
    assert outcome.failures == {}
    assert outcome.passed
    assert outcome.record.balances
    outcomes = comm.allgather((outcome.verdicts, outcome.record.newton, outcome.seconds))
    assert all(one == outcomes[0] for one in outcomes)


@pytest.mark.parallel(2)
def test_the_start_shape_is_used(comm: MPI.Comm) -> None:
    case = StressCase(
        "a", "b", base_scene, steps=1, shape=lambda x, h: 0.5 * x + h, observe=lambda trial: trial.x
    )
    record = run_case(comm, case, SMALL).record
    assert record.observed[0].min() == pytest.approx(record.observed[0][0, 0])
    assert np.ptp(record.observed[0], axis=0) == pytest.approx([0.5, 0.5, 0.0])


@pytest.mark.parallel(2)
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"petsc": {"snes_max_it": 0}}, "did not converge"),
        ({"petsc": {"snes_atol": 1e9}}, "-snes_atol stopped Newton's method"),
        ({"handles": [{"group": "nowhere"}]}, "nowhere"),
    ],
)
def test_a_case_that_fails_has_a_verdict(comm: MPI.Comm, change: dict[str, Any], message: str) -> None:
    setting = Setting(hanging_sheet(6) | change, False, Scope.QUICK)
    outcome = run_case(comm, StressCase("a", "b", base_scene), setting)
    assert message in outcome.failures["converged"].message
    assert not csv_row(outcome)["converged"]


@pytest.mark.parallel(2)
@pytest.mark.parametrize("scale", [1e9, 1e16])
def test_a_sheet_that_round_off_keeps_from_falling_fails(comm: MPI.Comm, scale: float) -> None:
    content = hanging_sheet(6)
    content["material"]["stretching_scale"] = scale
    outcome = run_case(comm, StressCase("a", "b", base_scene), Setting(content, False, Scope.QUICK))
    assert outcome.passed
    assert min(report.newton_iterations for report in outcome.record.reports) > 1


@pytest.mark.parallel(2)
def test_a_case_ends_at_its_time_limit(comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(stress_runner.TIME_LIMIT, Scope.QUICK, 0.0)
    outcome = run_case(comm, StressCase("a", "b", base_scene), SMALL)
    assert "has had its time" in outcome.failures["converged"].message


def test_a_case_of_the_base_is_left_out_for_another_scene(comm: MPI.Comm) -> None:
    [case] = selected(["slivers"], Scope.QUICK)
    outcome = run_case(comm, case, Setting(hanging_sheet(4), True, Scope.QUICK))
    assert outcome.left_out
    assert outcome.passed
    assert outcome.record.reports == []


@pytest.mark.parallel(2)
def test_times_are_relative_to_the_base_scene(comm: MPI.Comm) -> None:
    clock = BaseClock(comm, SMALL)
    assert np.all(clock.latest > 0.0)
    assert clock.size == pytest.approx(np.sqrt(2.0))
    outcome = run_case(comm, StressCase("same", "the base itself", base_scene), SMALL, clock)
    # about 1 on a machine that does nothing else
    assert 0.0 < outcome.wall_ratio < 1e3
    assert 0.0 < outcome.cpu_ratio < 1e3


def test_an_outcome_is_read_from_its_file(comm: MPI.Comm, tmp_path: Path) -> None:
    outcome = run(comm, "pressed")
    save_record(tmp_path / OUTCOME_FILE, outcome.saved())
    back = StressOutcome(outcome.case, **vars(load_record(tmp_path / OUTCOME_FILE, SavedOutcome)))
    assert back.verdicts == outcome.verdicts
    mine, theirs = csv_row(outcome), csv_row(back)
    assert tuple(mine) == tuple(theirs) == StressView.columns
    np.testing.assert_equal(list(theirs.values()), list(mine.values()))


def test_library_cloth_in_a_given_scene(comm: MPI.Comm, tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(
        "mesh: {grid: {width: 0.5, height: 0.5, nx: 4, ny: 4}}\n"
        "material: {cloth: gray-interlock}\ngravity: [0, 0, -9.81]\nhandles: [{nodes: [0]}]\n"
        "time: {end: 1, step: 0.01}\n",
        encoding="utf-8",
    )
    setting = setting_of(path, (), Scope.QUICK)
    for name in ("membrane-1e9", "bending-0", "stiff-warp", "wind-200", "jump", "folded"):
        [case] = selected([name], Scope.QUICK)
        assert run_case(comm, case, setting).failures == {}, name
