"""States shown by pictures and films."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from lyra_petsc.errors import InputError
from lyra_petsc.show.render.render_plan import (
    decimals,
    film_timing,
    pick_state,
    spread_states,
)


def run_of(times):
    return SimpleNamespace(times=times, scene=SimpleNamespace(time=SimpleNamespace(static=False)))


@pytest.mark.parametrize(
    ("every", "fps"),
    [(0.04, 25.0), (0.025, 40.0), (1 / 60, 60.0), (0.01, 50.0), (0.001, 1000 / 17), (0.2, 10.0), (0.3, 10.0)],
)
def test_a_film_lasts_as_long_as_the_motion(every, fps):
    times = every * np.arange(round(3.0 / every) + 1)
    timing = film_timing(times)
    assert timing.fps == pytest.approx(fps, rel=1e-4)
    assert len(timing.states) / timing.fps == pytest.approx(times[-1], abs=1.01 / timing.fps)
    assert timing.states[0] == 0
    assert timing.states[-1] >= len(times) - 1 - round(1.0 / (fps * every))


def test_a_given_number_of_frames_per_second():
    timing = film_timing(0.04 * np.arange(26), fps=50.0)
    assert timing.fps == 50.0
    # at 0.02 s two states are as near: the earlier
    assert timing.states[:5] == (0, 0, 1, 1, 2)
    assert len(timing.states) == 51


def test_irregular_states_are_shown_at_their_times():
    times = np.array([0.0, 0.1, 0.11, 0.12, 1.0])
    timing = film_timing(times, fps=10.0)
    assert timing.states == (0, 1, 3, 3, 3, 3, 4, 4, 4, 4, 4)


def test_gifs_have_delays_of_whole_hundredths():
    assert film_timing(0.025 * np.arange(81), gif=True).fps == 20.0
    assert film_timing(0.04 * np.arange(81), gif=True).fps == 25.0
    assert film_timing(0.04 * np.arange(81), gif=True, fps=200.0).fps == 50.0


def test_a_static_analysis_takes_three_seconds():
    timing = film_timing(np.linspace(0.0, 1.0, 5), static=True)
    assert len(timing.states) / timing.fps == pytest.approx(3.0, abs=0.11)
    assert sorted(set(timing.states)) == [0, 1, 2, 3, 4]


def test_a_single_state_is_a_film_of_one_frame():
    assert film_timing(np.array([0.0])).states == (0,)


def test_films_that_are_too_long_are_refused():
    with pytest.raises(InputError, match=r"--film: .* would have 1e.06 frames"):
        film_timing(np.linspace(0.0, 1e5, 1001))


@pytest.mark.parametrize("time", [-0.03, 1.03])
def test_times_outside_the_run_are_refused(time):
    with pytest.raises(InputError, match=r"--at: .* is outside the run, whose states go from 0 to 1 s"):
        pick_state(run_of(np.linspace(0.0, 1.0, 26)), time, "--at")


def test_states_of_a_contact_sheet_are_evenly_spaced():
    assert spread_states(0.1 * np.arange(11), 6) == (0, 2, 4, 6, 8, 10)
    assert spread_states(0.1 * np.arange(2), 6) == (0, 1)
    assert spread_states(np.array([0.0]), 6) == (0,)


@pytest.mark.parametrize(
    ("interval", "expected"), [(0.04, 2), (0.025, 3), (0.1, 1), (1.0, 0), (30.0, 0), (0.001, 3), (1 / 60, 3)]
)
def test_the_time_in_the_corner_distinguishes_states(interval, expected):
    times = np.cumsum(np.r_[0.0, np.full(9, interval)])
    assert decimals(times) == expected
    assert len({f"{time:.{expected}f}" for time in times}) == 10
