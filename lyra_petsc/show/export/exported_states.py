"""The states that are exported, with the direction that is up and the frames a second; for all formats."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.output.read_run import StoredRun

if TYPE_CHECKING:
    from lyra_petsc.show.obstacle_surfaces import ObstacleSurface

Array = NDArray[np.float64]

SINGLE_RATE = 24.0
"""ExportedStates a second where there is a single state."""

SAME_TIME = 1e-6
"""A time of ``--times`` may be outside the run by this fraction of its length."""


@dataclass(frozen=True)
class ExportedStates:
    """Some states of a run.

    Attributes
    ----------
    run : StoredRun
    chosen : tuple of int
        Numbers of the states, ascending.
    displacement : bool
        Whether the displacement from the run's first state is among the fields, if it was not written.
    """

    run: StoredRun
    chosen: tuple[int, ...]
    displacement: bool = False

    def __len__(self) -> int:
        return len(self.chosen)

    @property
    def times(self) -> Array:
        """(n,) [s]."""
        return self.run.times[list(self.chosen)]

    @property
    def positions(self) -> Iterator[Array]:
        """(V, 3) positions [m] of each state."""
        return (self.run.positions[i] for i in self.chosen)

    @property
    def fields(self) -> tuple[str, ...]:
        """What is exported besides positions."""
        written = self.run.fields
        return (*written, "displacement") if self._adds_displacement else written

    @property
    def _adds_displacement(self) -> bool:
        return self.displacement and "displacement" not in self.run.fields

    def field_on(self, name: str) -> str:
        """``vertex`` or ``triangle``."""
        added = name == "displacement" and self._adds_displacement
        return "vertex" if added else self.run.field_on(name)

    def field(self, name: str) -> Iterator[NDArray[np.float64]]:
        """The values of a field in each state."""
        if name == "displacement" and self._adds_displacement:
            start = self.run.positions[0]
            return (position - start for position in self.positions)
        return (self.run.field(name)[i] for i in self.chosen)

    @cached_property
    def obstacles(self) -> dict[str, ObstacleSurface]:
        """The run's obstacles by unique names of letters, digits and underscores, none of them ``cloth``."""
        if not self.run.scene.obstacles:
            return {}
        from lyra_petsc.show.obstacle_surfaces import obstacle_surfaces

        boxes = [(x.min(axis=0), x.max(axis=0)) for x in self.positions]
        low, high = np.min([a for a, _ in boxes], axis=0), np.max([b for _, b in boxes], axis=0)
        named: dict[str, ObstacleSurface | None] = {"cloth": None}
        for surface in obstacle_surfaces(self.run, (low + high) / 2.0, float(np.linalg.norm(high - low))):
            label = re.sub(r"\W", "_", surface.name, flags=re.ASCII)
            label = f"_{label}" if label[:1].isdigit() else label
            while label in named:
                label += "_"
            named[label] = surface
        return {label: surface for label, surface in named.items() if surface is not None}

    def places(self, obstacle: ObstacleSurface) -> Iterator[Array]:
        """(n, 3) positions [m] of an obstacle's points in each state."""
        return (obstacle.positions(float(time)) for time in self.times)

    @property
    def up(self) -> tuple[int, int]:
        """Axis (0, 1, 2) and sign of the direction against gravity; +z without gravity."""
        gravity = np.asarray(self.run.scene.gravity or (0.0, 0.0, -1.0))
        axis = int(np.abs(gravity).argmax())
        if gravity[axis] == 0.0:
            return 2, 1
        return axis, -1 if gravity[axis] > 0.0 else 1

    @property
    def rate(self) -> float:
        """States a second, from the median of their intervals."""
        spacing = np.diff(self.times)
        return round(1.0 / float(np.median(spacing)), 6) if len(spacing) else SINGLE_RATE


def choose(run: StoredRun, times: str | None, every: int | None) -> ExportedStates:
    """The states nearest to some times, every nth state, or all.

    Parameters
    ----------
    run : StoredRun
    times : str or None
        ``--times``: numbers [s] with commas between.
    every : int or None
        ``--every``.

    Raises
    ------
    InputError
        If both are given, for text that is not a number, or a time outside the run.
    """
    if times is not None and every is not None:
        raise InputError("choose states either by --times or by --every", key="--every")
    if every is not None and every < 1:
        raise InputError(f"must be at least 1, not {every}", key="--every")
    if times is None:
        return ExportedStates(run, tuple(range(0, len(run), every or 1)))
    return ExportedStates(run, tuple(sorted({run.at(time) for time in _numbers(times, run)})))


def _numbers(text: str, run: StoredRun) -> list[float]:
    first, last = float(run.times[0]), float(run.times[-1])
    slack = SAME_TIME * (last - first)
    numbers = []
    for word in text.split(","):
        try:
            number = float(word)
        except ValueError:
            raise InputError(
                f"must be numbers [s] with commas between, not {word.strip()!r}", key="--times"
            ) from None
        if not first - slack <= number <= last + slack:
            raise InputError(f"the run goes from {first:g} to {last:g} s, not to {number:g}", key="--times")
        numbers.append(number)
    return numbers


def turned_up(up: tuple[int, int], target: int) -> tuple[float, float, float, float]:
    """Quaternion x, y, z, w of the rotation from the axis ``up``, with its sign, to the axis ``target``."""
    start, end = np.zeros(3), np.zeros(3)
    start[up[0]], end[target] = up[1], 1.0
    if start @ end < -0.5:  # half a turn about either of the other axes
        about = np.zeros(3)
        about[(target + 1) % 3] = 1.0
        return (*about.tolist(), 0.0)
    turn = np.append(np.cross(start, end), 1.0 + start @ end)
    x, y, z, w = (turn / np.linalg.norm(turn)).tolist()
    return x, y, z, w
