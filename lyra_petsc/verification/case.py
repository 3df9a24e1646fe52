"""What a case is: a question with a known answer, asked at several resolutions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from lyra_petsc.verification.claims import Claim

if TYPE_CHECKING:
    from lyra_petsc.verification.bench import Bench


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


def _cells(n: float) -> float:
    return 1.0 / n


@dataclass(frozen=True)
class Case:
    """A question with a known answer.

    Attributes
    ----------
    name : str
        As in the registry: lower case with hyphens.
    title : str
        What is compared, with what, in one line.
    source : str
        Where the answer comes from.
    resolutions : sequence of float
        n, ascending: the higher, the finer.
    measure : callable (bench, n) → Measured, one by one
        Collective; the same result on every rank. A generator that yields what a simulation gave as soon
        as that has ended has its steps and run time charged to it, any other iterable those of all its
        simulations. `simulated` makes one from a scene.
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

    name: str
    title: str
    source: str
    resolutions: Sequence[float]
    measure: Callable[[Bench, float], Iterable[Measured]]
    claim: Claim
    claims: Mapping[str, Claim] = field(default_factory=dict)
    quick: int = 2
    counts: str = "cells along the side"
    size: Callable[[float], float] = _cells

    def claim_of(self, quantity: str) -> Claim:
        """What is claimed of a quantity."""
        return self.claims.get(quantity, self.claim)
