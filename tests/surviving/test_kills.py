"""A short version of scripts/kill_test.py."""

from __future__ import annotations

import sys

import pytest
from launch import ROOT, environment
from patience import run_program


@pytest.mark.slow
@pytest.mark.parametrize(("ranks", "kills"), [(1, 1), (2, 2)])
def test_runs_killed_at_random_moments_reach_the_same_end(ranks: int, kills: int) -> None:
    words = [sys.executable, str(ROOT / "scripts/kill_test.py"), "--kills", str(kills), "--ranks", str(ranks)]
    left = run_program([*words, "--seed", "3"], env=environment(), seconds=600)
    assert left.returncode == 0, left.stdout + left.stderr
    last = left.stdout.splitlines()[-1]
    assert last.startswith(f"{kills} kills on {ranks} ranks")
    assert "runs resumed to the same end" in last
    assert ", 0 runs" not in last
    assert " 0 announced states" not in last
