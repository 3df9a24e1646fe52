"""A case of ``stress``: a scene that a user would call mad, and what physics says of it."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.experiments import case as experiments
from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.case import Verdict

if TYPE_CHECKING:
    from lyra_petsc.experiments.stress.record import Record

Array = NDArray[np.float64]
Content = dict[str, Any]


class Level(IntEnum):
    """How much is run: each includes those before."""

    QUICK = 0
    USUAL = 1
    FULL = 2


QUICK, USUAL, FULL = Level


@dataclass(frozen=True)
class Setting:
    """What the cases of one ``stress`` start from.

    Attributes
    ----------
    base : dict
        The scene whose changes the cases are, in the keys of a scene file.
    given : bool
        It is the user's; else the hanging sheet of `lyra_petsc.experiments.stress.base`.
    level : Level
    size : float
        Diagonal of the rest shape's bounding box [m].
    trust_mesh : bool
        Give gmsh the scene's scripts whatever they say.
    """

    base: Content
    given: bool
    level: Level
    size: float = math.sqrt(2.0)
    trust_mesh: bool = False

    def content(self) -> Content:
        """A copy of the base scene, to be changed."""
        return copy.deepcopy(self.base)

    def bench(self, comm: MPI.Comm, watch: Callable[[], None] | None) -> Bench:
        """Where its scenes run as a user's do."""
        return Bench(comm, watch, exact=False, trust_mesh=self.trust_mesh)

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
class Case(experiments.Case):
    """One scene and what is claimed of it.

    Attributes
    ----------
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
    family : str
        Name of the family it belongs to.
    """

    scene: Maker
    steps: int = 20
    step: float | None = None
    level: Level = Level.USUAL
    shape: Shaper | None = None
    own: bool = False
    swift: bool = False
    observe: Callable[[Trial], Any] | None = None
    judge: Judge | None = None
    family: str = ""

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
    """Cases that belong together."""

    name: str
    title: str
    cases: tuple[Case, ...]


def family(name: str, title: str, *cases: Case) -> Family:
    """The family of these cases."""
    return Family(name, title, tuple(replace(case, family=name) for case in cases))
