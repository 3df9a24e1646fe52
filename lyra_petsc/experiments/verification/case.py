"""A case of ``verify``: a question with a known answer, asked at several resolutions."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.experiments import case as experiments
from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.verification.claims import Claim


@dataclass(frozen=True)
class Measured:
    """One quantity at one resolution.

    Attributes
    ----------
    quantity : str
    value, exact : float
        In ``unit``.
    unit : str
        ``1`` for a pure number.
    scale : float or None
        What the error is relative to, in ``unit``; None: the size of ``exact``.
    """

    quantity: str
    value: float
    exact: float
    unit: str = "1"
    scale: float | None = None

    @property
    def error(self) -> float:
        """|value − exact| over the scale."""
        scale = abs(self.exact) if self.scale is None else self.scale
        return abs(self.value - self.exact) / scale


Measure = Callable[[Bench, float], Iterable[Measured]]


@dataclass(frozen=True)
class Case(experiments.Case):
    """A question with a known answer; `case` makes one of a function that measures.

    Attributes
    ----------
    measure : callable (bench, n) → Measured, one by one
        Collective; the same result on every rank. A generator that yields what a simulation gave as soon
        as that has ended has its steps and run time charged to it, any other iterable those of all its
        simulations.
    source : str
        Where the answer comes from.
    resolutions : sequence of float
        n, ascending: the higher, the finer.
    claim : Claim
        What every quantity must satisfy.
    claims : mapping of quantity → Claim
        For quantities of which something else is claimed.
    quick : int
        How many of the resolutions ``--quick`` takes, from the coarsest.
    counts : str
        What n counts.
    size : callable n → h
        The length or time that shrinks; orders are with respect to it.
    """

    measure: Measure
    source: str
    resolutions: Sequence[float]
    claim: Claim
    claims: Mapping[str, Claim] = field(default_factory=dict)
    quick: int = 2
    counts: str = "cells along the side"
    size: Callable[[float], float] = lambda n: 1.0 / n

    def claim_of(self, quantity: str) -> Claim:
        """What is claimed of a quantity."""
        return self.claims.get(quantity, self.claim)


def case(title: str, **more: Any) -> Callable[[Measure], Case]:
    """A decorator: the case that is named as the function which measures it; ``more`` as in `Case`."""
    return lambda measure: Case(measure.__name__.replace("_", "-"), title, measure, **more)


def data(name: str) -> dict[str, Any]:
    """A file of ``verification/data``, without ``.json``."""
    path = files("lyra_petsc.experiments.verification").joinpath("data", f"{name}.json")
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return content


def isotropic(stiffness: float, poisson: float = 0.0) -> dict[str, float]:
    """The membrane block [N/m] of a material with c11 = ``stiffness`` in all directions."""
    shear = 0.5 * (1.0 - poisson) * stiffness
    return {"c11": stiffness, "c22": stiffness, "c12": poisson * stiffness, "c33": shear}


def farthest(values: NDArray[np.float64], exact: float) -> float:
    """The one of the values that differs most from the exact one."""
    return float(values[np.argmax(np.abs(values - exact))])
