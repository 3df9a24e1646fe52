"""Progress output of runs, films and studies."""

import io
from pathlib import Path
from types import SimpleNamespace

import pytest

from lyra_petsc.cli.progress import ProgressBar, StudyProgress, closing_table, duration


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


FIRST, SECOND = SimpleNamespace(rank=0), SimpleNamespace(rank=1)


def shown(stream, seconds_per_step, steps=100, comm=FIRST, **options):
    """All that a bar prints for steps of equal length, with a message [in brackets] before the last."""
    clock = Clock()
    with ProgressBar(comm, stream=stream, clock=clock, **options) as progress:
        for step in range(1, steps + 1):
            clock.now += seconds_per_step
            if step == steps:
                progress.say("a message [in brackets]")
            progress.show(step / steps, f"step {step}")
    return stream.getvalue()


def test_plain_lines_have_the_time_left():
    lines = shown(io.StringIO(), 0.5).splitlines()
    assert lines[:2] == ["  1%  step 1", "  6%  step 6  0:00:47 left"]
    assert lines[-2:] == ["a message [in brackets]", "100%  step 100  0:00:00 left"]


@pytest.mark.parametrize(
    ("seconds_per_step", "expected"),
    [
        (0.001, 2),  # over before two seconds have passed: first and last
        (0.5, 21),  # each 5 %, first, last
        (120.0, 100),  # slow: each step after a minute
    ],
)
def test_the_number_of_plain_lines_depends_little_on_the_speed(seconds_per_step, expected):
    assert len(shown(io.StringIO(), seconds_per_step).splitlines()) == expected + 1


def test_a_bar_on_a_terminal_of_the_first_rank_only():
    drawn = shown(Terminal(), 0.5)
    for words in ("\x1b[", "━", "100%", "step 100", "a message [in brackets]"):
        assert words in drawn
    assert "\x1b[" not in shown(Terminal(), 0.5, plain=True)
    assert shown(Terminal(), 0.5, comm=SECOND) == shown(io.StringIO(), 0.5, comm=SECOND) == ""


def test_the_time_left_does_not_count_what_was_done_before():
    stream, clock = io.StringIO(), Clock()
    with ProgressBar(FIRST, stream=stream, clock=clock) as progress:
        for step in range(6):
            clock.now += 10.0
            progress.show(0.25 + 0.05 * step, "")
    first, *_, last = stream.getvalue().splitlines()
    assert first.startswith(" 25%")
    assert (last[:4], last[-12:]) == (" 50%", "0:01:40 left")


def test_the_closing_table(capsys):
    folder = Path("runs/" + "a-long-name-" * 12)
    closing_table({"mesh": 0.5, "solve": 1.5, "other": 0.001}, folder, "done: 4 s in 100 steps")
    text = capsys.readouterr().out
    for words in ("25%", "75%", "2.00 s", "done: 4 s in 100 steps", f"paraview {folder}/states.xdmf"):
        assert words in text
    assert "other" not in text
    assert [duration(s) for s in (65.4, 3909, float("nan"))] == ["0:01:05", "1:05:09", "?"]


def test_lines_of_a_study_name_each_case_and_the_time_left():
    stream, clock = io.StringIO(), Clock()
    with StudyProgress(FIRST, lambda: None, 2, stream=stream, clock=clock) as progress:
        progress.case("bdf2, Δt 10 ms", resumed=True)
        progress.progress(10.0, 40.0)
        progress.case("bdf2, Δt 5 ms", resumed=False)
        for second in range(200):
            clock.now = float(second)
            progress.progress(10.0 + 0.1 * second, 40.0)
        progress.case("reference: bdf2, Δt 1.25 ms", resumed=False)
        progress.note("something")
    lines = stream.getvalue().splitlines()
    assert lines[:2] == ["1/2 bdf2, Δt 10 ms: finished before", " 25%  1/2 bdf2, Δt 10 ms"]
    assert lines[2] == "2/2 bdf2, Δt 5 ms"
    # after 20 s for 2 of 30 units, fourteen times as long remains
    assert lines[3] == " 30%  2/2 bdf2, Δt 5 ms  0:04:40 left"
    assert len(lines) < 20
    assert lines[-3:-1] == ["reference: bdf2, Δt 1.25 ms", "note: something"]
