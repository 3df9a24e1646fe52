"""The patience of tests with programs on busy machines."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import patience
import pytest
from patience import Patience, run_program, share

pytestmark = pytest.mark.quick


@pytest.mark.parametrize(("wanting", "seconds"), [(1, 10.0), (30, 10.0 * 30)])
def test_it_lasts_as_long_as_a_process_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wanting: int, seconds: float
) -> None:
    (tmp_path / "stat").write_text(
        f"cpu 1 2 3\nprocs_running {wanting * (os.cpu_count() or 1)}\nprocs_blocked 0\n"
    )
    monkeypatch.setattr(patience, "LOAD", tmp_path / "stat")
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(patience, "time", SimpleNamespace(monotonic=lambda: clock.now))
    assert share() == pytest.approx(1.0 / wanting)
    waiting = Patience(10.0)
    for clock.now in (0.5 * seconds, 0.99 * seconds):
        assert not waiting.over
    clock.now = 1.1 * seconds
    assert waiting.over


def test_a_program_that_hangs_is_ended() -> None:
    assert run_program([sys.executable, "-c", "print(3)"]).stdout == "3\n"
    with pytest.raises(subprocess.TimeoutExpired):
        run_program([sys.executable, "-c", "import time; time.sleep(600)"], 0.5)
