"""Choice of the state that is shown at a time."""

import math

import pytest
from written_run import Writer, written

from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.show.view import page_content as module
from lyra_petsc.show.view.page_content import Player, first_speed


@pytest.fixture
def clock(monkeypatch):
    """A clock that is set by hand [s]."""

    class Clock:
        now = 0.0

        def monotonic(self):
            return self.now

    clock = Clock()
    monkeypatch.setattr(module, "clock", clock)
    return clock


def test_states_are_played_at_their_times(tmp_path, clock):
    player = Player(StoredRun(written(tmp_path, states=6)))  # 0.1 s apart
    player.go(0)
    assert math.isinf(player.next_due())

    player.play()
    shown = []
    for clock.now in (0.0, 0.05, 0.101, 0.35, 0.49, 0.501, 7.0):
        shown.append(player.due())
    assert shown == [0, 0, 1, 3, 4, 5, 5]
    assert not player.playing


def test_a_change_of_speed_acts_from_then_on(tmp_path, clock):
    player = Player(StoredRun(written(tmp_path, states=6)))
    player.go(0)
    player.play()
    clock.now = 0.201
    assert player.due() == 2
    player.set_speed(0.1)
    assert player.next_due() == pytest.approx(1.0)
    clock.now += 0.9
    assert player.due() == 2
    clock.now += 0.11
    assert player.due() == 3


def test_the_slider_stays_within_the_states_and_playing_continues_there(tmp_path, clock):
    player = Player(StoredRun(written(tmp_path, states=6)))
    player.go(-3)
    assert player.due() == 0
    player.go(99)
    assert player.due() == 5
    player.go(3)
    player.play()
    clock.now = 0.101
    assert player.due() == 4
    player.pause()
    clock.now = 5.0
    assert player.due() == 4


def test_play_at_the_end_starts_again(tmp_path, clock):
    player = Player(StoredRun(written(tmp_path, states=3)))
    player.go(2)
    player.play()
    assert player.due() == 0
    assert player.playing


def test_new_states_are_followed_if_the_newest_is_shown(tmp_path, clock):
    writer = Writer(tmp_path)
    writer.write()
    writer.write()
    player = Player(StoredRun(tmp_path))
    assert player.due() == 1  # the newest state of an unfinished run
    assert not player.follow()
    writer.write()
    assert player.follow()
    assert player.due() == player.last == 2

    player.go(0)
    writer.write()
    assert player.follow()
    assert (player.due(), player.last) == (0, 3)


@pytest.mark.parametrize(
    ("end", "speed"), [(0.0, 1.0), (1.0, 1.0), (60.0, 1.0), (3600.0, 1000.0), (0.02, 0.001)]
)
def test_the_first_speed_depends_on_the_length_of_the_motion(end, speed):
    class Between:
        times = (0.0, end)

    assert first_speed(Between()) == pytest.approx(speed)
