"""What a study shows while it runs."""

from __future__ import annotations

import io

import pytest
from mpi4py import MPI

from lyra_petsc.cli.progress import StudyProgress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Clock:
    """Seconds that pass when told."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_plain_lines_name_each_case_and_the_time_left() -> None:
    stream, clock = io.StringIO(), Clock()
    with StudyProgress(MPI.COMM_SELF, lambda: None, 2, stream=stream, clock=clock) as progress:
        progress.case("bdf2, Δt 10 ms", resumed=True)
        progress.progress(10.0, 40.0)
        progress.case("bdf2, Δt 5 ms", resumed=False)
        for second in range(200):
            clock.now = float(second)
            progress.progress(10.0 + 0.1 * second, 40.0)
        progress.case("reference: bdf2, Δt 1.25 ms", resumed=False)
        progress.note("something")
    lines = stream.getvalue().splitlines()
    assert lines[0] == "1/2 bdf2, Δt 10 ms: finished before"
    assert lines[1] == "2/2 bdf2, Δt 5 ms"
    # after 60 s of what took no time before: 6 of 30 units, four times as long to go
    assert lines[2] == " 40%  2/2 bdf2, Δt 5 ms  4:00 left"
    assert len(lines) == 7
    assert lines[-2:] == ["reference: bdf2, Δt 1.25 ms", "note: something"]


def test_a_bar_on_a_terminal() -> None:
    stream, clock = Terminal(), Clock()
    with StudyProgress(MPI.COMM_SELF, lambda: None, 1, stream=stream, clock=clock) as progress:
        progress.case("[b]Δt 10 ms", resumed=False)
        progress.progress(0.0, 4.0)
        clock.now = 30.0
        progress.progress(1.0, 4.0)
    assert "1/1 [b]Δt 10 ms  1:30 left" in stream.getvalue()


def test_a_stop_comes_through() -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    with (
        pytest.raises(KeyboardInterrupt),
        StudyProgress(MPI.COMM_SELF, stop, 1, stream=io.StringIO()) as progress,
    ):
        progress.progress(0.0, 1.0)
