"""What a case is: a scene that a user would call mad, and what physics says of it."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.verification.bench import Bench, Trial
from lyra_petsc.verification.claims import Verdict

if TYPE_CHECKING:
    from lyra_petsc.stress.record import Record

Array = NDArray[np.float64]
Content = dict[str, Any]


class Level(IntEnum):
    """How much is run: each includes those before."""

    QUICK = 0
    USUAL = 1
    FULL = 2


@dataclass(frozen=True)
class Setting:
    """What the cases of one ``stress`` start from.

    Attributes
    ----------
    base : dict
        The scene whose changes the cases are, in the keys of a scene file.
    given : bool
        It is the user's; else the hanging sheet of `lyra_petsc.stress.base`.
    level : Level
    size : float
        Diagonal of the rest shape's bounding box [m].
    """

    base: Content
    given: bool
    level: Level
    size: float = math.sqrt(2.0)

    def content(self) -> Content:
        """A copy of the base scene, to be changed."""
        return copy.deepcopy(self.base)

    @property
    def step(self) -> float:
        """The base scene's Δt [s]."""
        return float(self.base["time"]["step"])


class NotHere(Exception):
    """A case that makes no sense for the scene at hand; says why."""


Maker = Callable[[Setting, Bench], Content]
Shaper = Callable[[Array, float], Array]
Judge = Callable[[Setting, Bench, "Record"], Mapping[str, Verdict]]


@dataclass(frozen=True)
class Case:
    """One scene and what is claimed of it.

    Attributes
    ----------
    name : str
        Lower case with hyphens; unique.
    title : str
        What is done to the sheet, in a line.
    scene : callable (setting, bench) → scene content
        Raises `NotHere` where it makes no sense.
    steps : int
        Nominal number of steps.
    step : float or None
        Δt [s]; None: the base scene's.
    level : Level
        From which on it is run.
    shape : callable (start positions (V, 3) [m], mean edge length [m]) → positions, optional
        The shape to start from, where it differs from the scene's own.
    own : bool
        It brings its own scene and has nothing to do with the user's.
    swift : bool
        Its iterations and its wall time are judged, too.
    observe : callable (trial) → any, optional
        Called on all ranks at the start and after every step; collected in the record.
    judge : callable (setting, bench, record) → verdicts by name, optional
        What is claimed beside the balances; collective.
    """

    name: str
    title: str
    scene: Maker
    steps: int = 20
    step: float | None = None
    level: Level = Level.USUAL
    shape: Shaper | None = None
    own: bool = False
    swift: bool = False
    observe: Callable[[Trial], Any] | None = None
    judge: Judge | None = None

    def content(self, setting: Setting, bench: Bench) -> Content:
        """The scene, with its time block."""
        if self.own and setting.given:
            raise NotHere("has a scene of its own")
        content = self.scene(setting, bench)
        step = self.step if self.step is not None else float(content["time"]["step"])
        content["time"] = {**content["time"], "step": step, "end": self.steps * step}
        return content


@dataclass(frozen=True)
class Family:
    """Cases that belong together; one file under ``cases``.

    Attributes
    ----------
    name, title : str
    cases : sequence of Case
    """

    name: str
    title: str
    cases: Sequence[Case] = field(default_factory=tuple)
