"""Progress output of runs, films and studies."""

import io
from types import SimpleNamespace

import pytest

from lyra_petsc.cli.progress import Progress, ProgressBar, StudyProgress, closing_table, duration


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


FIRST, SECOND = SimpleNamespace(rank=0), SimpleNamespace(rank=1)


def run(stream, seconds_per_step, steps=100, comm=FIRST, **options):
    clock = Clock()
    with Progress(comm, 4.0, stream=stream, clock=clock, **options) as progress:
        for step in range(1, steps + 1):
            clock.now += seconds_per_step
            progress.update(step, 4.0 * step / steps, 3, 17, 0.25)
    return stream.getvalue()


def test_plain_lines_have_all_quantities():
    lines = run(io.StringIO(), 0.5).splitlines()
    assert lines[0] == "  1%  t 0.04 of 4 s  step 1  Newton 3  linear 17  energy 0.25 J"
    assert lines[1] == "  6%  t 0.24 of 4 s  step 6  Newton 3  linear 17  energy 0.25 J  0:47 left"
    assert lines[-1].startswith("100%  t 4 of 4 s  step 100")
    assert lines[-1].endswith("0:00 left")


@pytest.mark.parametrize(
    ("seconds_per_step", "expected"),
    [
        (0.001, 2),  # over before two seconds have passed: first and last
        (0.5, 21),  # each 5 %, first, last
        (120.0, 100),  # slow: each step after a minute
    ],
)
def test_the_number_of_plain_lines_depends_little_on_the_speed(seconds_per_step, expected):
    assert len(run(io.StringIO(), seconds_per_step).splitlines()) == expected


def test_a_bar_on_a_terminal_and_lines_with_petsc_monitors():
    drawn = run(Terminal(), 0.5)
    assert "\x1b[" in drawn
    assert "100%" in drawn
    assert "\x1b[" not in run(Terminal(), 0.5, plain=True)


def test_a_message_between_steps_is_printed_unchanged():
    for stream in (io.StringIO(), Terminal()):
        with Progress(FIRST, 1.0, stream=stream) as progress:
            progress.update(1, 0.5, 1, 1, 0.0)
            progress.say("step [1] retried")
        assert "step [1] retried" in stream.getvalue()


def test_other_ranks_are_silent(capsys):
    for stream in (io.StringIO(), Terminal()):
        assert run(stream, 0.5, comm=SECOND) == ""
        Progress(SECOND, 1.0, stream=stream).say("hello")
        assert stream.getvalue() == ""
    closing_table(SECOND, {"solve": 1.0}, "runs/flag", "done")
    assert capsys.readouterr().out == ""


def test_remaining_time_is_shown_after_some_steps_without_the_first():
    stream, clock = io.StringIO(), Clock()
    with Progress(FIRST, 10.0, stream=stream, clock=clock) as progress:
        for now, time in ((60.0, 1.0), (70.0, 2.0), (80.0, 3.0), (90.0, 4.0), (100.0, 5.0)):
            clock.now = now
            progress.update(1, time, 1, 1, 0.0)
    endings = [line.split("  ")[-1] for line in stream.getvalue().splitlines()]
    assert endings == ["energy 0 J"] * 3 + ["1:00 left", "0:50 left"]


def test_remaining_time_of_a_resumed_run_counts_from_its_start():
    stream, clock = io.StringIO(), Clock()
    with Progress(FIRST, 4.0, start=3.0, stream=stream, clock=clock) as progress:
        for step in range(6):
            clock.now += 10.0
            progress.update(90 + step, 3.25 + 0.05 * step, 1, 1, 0.0)
    lines = stream.getvalue().splitlines()
    assert lines[0].startswith(" 25%")
    assert lines[-1].startswith(" 50%")
    assert lines[-1].endswith("1:40 left")


def test_closing_table(capsys):
    folder = "runs/" + "a-long-name-" * 12
    closing_table(FIRST, {"mesh": 0.5, "solve": 1.5, "other": 0.001}, folder, "done: 4 s in 100 steps")
    text = capsys.readouterr().out
    assert "25%" in text
    assert "75%" in text
    assert "2.00 s" in text
    assert "other" not in text
    assert "done: 4 s in 100 steps" in text
    assert f"paraview {folder}/states.xdmf" in text


def test_durations_as_text():
    assert [duration(s) for s in (0, 65.4, 3909, float("nan"))] == ["0:00", "1:05", "1:05:09", "?"]


@pytest.mark.parametrize("stream", [io.StringIO(), Terminal()], ids=["file", "terminal"])
def test_work_without_steps_has_a_bar_on_a_terminal_and_lines_elsewhere(stream):
    with ProgressBar(FIRST, stream=stream) as progress:
        progress.show(0.0, "0 of 100 states drawn")
        progress.show(0.5, "50 of 100 states drawn")
    assert "50 of 100 states drawn" in stream.getvalue()
    assert ("━" in stream.getvalue()) == stream.isatty()


def test_lines_of_a_study_name_each_case_and_the_remaining_time():
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
    assert lines[3] == " 30%  2/2 bdf2, Δt 5 ms  4:40 left"
    assert len(lines) < 20
    assert lines[-3:-1] == ["reference: bdf2, Δt 1.25 ms", "note: something"]


def test_the_bar_of_a_study():
    stream, clock = Terminal(), Clock()
    with StudyProgress(FIRST, lambda: None, 1, stream=stream, clock=clock) as progress:
        progress.case("[b]Δt 10 ms", resumed=False)
        for second in (0, 10, 20, 30):
            clock.now = float(second)
            progress.progress(second / 30.0, 4.0)
    assert "1/1 [b]Δt 10 ms  1:30 left" in stream.getvalue()


def test_an_interrupt_of_a_study_is_passed_on():
    def stop():
        raise KeyboardInterrupt

    with (
        pytest.raises(KeyboardInterrupt),
        StudyProgress(FIRST, stop, 1, stream=io.StringIO()) as progress,
    ):
        progress.progress(0.0, 1.0)
