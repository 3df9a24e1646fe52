"""Which state every picture and every frame of a film shows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError

Array = NDArray[np.float64]

SLOWEST, FASTEST = 10.0, 60.0
"""Frames a second of a film for which none were asked."""
GIF_FASTEST = 25.0
STATIC_SECONDS = 3.0
"""A film of a static analysis takes this long to show the whole load."""
MOST_FRAMES = 20_000


@dataclass(frozen=True)
class Timing:
    """A film's frames.

    Attributes
    ----------
    fps : float
        Frames a second.
    states : tuple of int
        Number of the state that each frame shows, ascending.
    """

    fps: float
    states: tuple[int, ...]


def film_timing(
    times: Array,
    *,
    fps: float | None = None,
    speed: float | None = None,
    static: bool = False,
    gif: bool = False,
) -> Timing:
    """Frames at equal intervals, each showing the state nearest to its time.

    Parameters
    ----------
    times : (n,) float64
        Of the states, ascending [s] (static: load factors).
    fps : float, optional
        Frames a second; by default one for each state, as far as that makes 10 to 60 (GIF: 25).
    speed : float, optional
        Simulated seconds that a second of the film shows; 1 by default (static: a third of the load).
    static, gif : bool

    Raises
    ------
    InputError
        If the film would be far too long.
    """
    speed = speed if speed is not None else 1.0 / STATIC_SECONDS if static else 1.0
    rate = fps if fps is not None else _natural_rate(times, speed, GIF_FASTEST if gif else FASTEST)
    if gif:  # whose delays are hundredths of a second, and shorter ones than two are not obeyed
        rate = 100.0 / max(2, round(100.0 / rate))
    span = float(times[-1] - times[0])
    count = span * rate / speed + 1.0
    if not count <= MOST_FRAMES:
        raise InputError(
            f"a film of {span:g} s at {rate:g} frames a second and speed {speed:g} would have {count:.3g} "
            f"frames, more than {MOST_FRAMES}; give a larger --speed",
            key="--film",
        )
    at = times[0] + np.arange(math.floor(count + 1e-6)) * (speed / rate)
    return Timing(rate, tuple(int(i) for i in nearest_states(times, at)))


def _natural_rate(times: Array, speed: float, fastest: float) -> float:
    """One frame a state, or one every few, or each state several times."""
    intervals = np.diff(times)
    if len(intervals) == 0:
        return SLOWEST
    rate = speed / float(np.median(intervals))
    if rate > fastest:
        rate /= math.ceil(rate / fastest * (1.0 - 1e-6))
    elif rate < SLOWEST:
        rate *= math.ceil(min(SLOWEST / rate, 1e6) * (1.0 - 1e-6))
    return float(f"{rate:.6g}")


def nearest_states(times: Array, at: Array) -> NDArray[np.int64]:
    """Numbers of the states nearest to times ``at`` [s]; of two as near, the earlier."""
    if len(times) == 1:
        return np.zeros(len(at), dtype=np.int64)
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    nearer_before = at - times[after - 1] <= times[after] - at + 1e-9 * (times[after] - times[after - 1])
    return np.asarray(after - nearer_before, dtype=np.int64)


def pick_state(times: Array, time: float, unit: str) -> int:
    """The state nearest to a time that was asked for.

    Raises
    ------
    InputError
        If no state was written near it.
    """
    first, last = float(times[0]), float(times[-1])
    slack = 1e-6 * max(last - first, abs(last)) + 0.5 * _largest_interval(times)
    if not first - slack <= time <= last + slack:
        raise InputError(
            f"{time:g}{unit} is outside the run, whose states go from {first:g} to {last:g}{unit}", key="--at"
        )
    return int(nearest_states(times, np.array([time]))[0])


def _largest_interval(times: Array) -> float:
    return float(np.diff(times).max(initial=0.0))


def spread_states(times: Array, count: int) -> tuple[int, ...]:
    """Up to ``count`` different states, at equal intervals from the first to the last."""
    wanted = np.linspace(times[0], times[-1], count)
    return tuple(int(i) for i in np.unique(nearest_states(times, wanted)))


def decimals(times: Array) -> int:
    """How many tell the states apart: those of their interval where that is a short number."""
    if len(times) == 1:
        return 2
    interval = float(np.median(np.diff(times)))
    least = max(0, math.ceil(-math.log10(interval) - 1e-9))
    short = abs(round(interval, least) - interval) < 1e-3 * interval
    return least if short else least + 1
