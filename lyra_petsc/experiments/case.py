"""What every experiment is made of: a case, what came of it, and the verdicts on that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar


@dataclass(frozen=True)
class Verdict:
    """Whether a claim holds, and why or why not, in words."""

    passed: bool
    words: str


@dataclass(frozen=True)
class Case:
    """One experiment; the verbs add the scene, what is varied and what is expected.

    Attributes
    ----------
    name : str
        Lower case with hyphens; unique among the cases of a verb.
    title : str
        What is done or compared, in one line.
    """

    name: str
    title: str


C = TypeVar("C", bound=Case)


@dataclass
class Outcome(Generic[C]):
    """What came of a case.

    Attributes
    ----------
    case : Case
    verdicts : dict of name → Verdict
        Empty where the case was left out.
    seconds : float
        Wall time of the whole case [s].
    left_out : str
        Why the case makes no sense here; empty if it was run.
    """

    case: C
    verdicts: dict[str, Verdict] = field(default_factory=dict)
    seconds: float = 0.0
    left_out: str = ""

    @property
    def passed(self) -> bool:
        """Whether every verdict is good, or the case was left out; without verdicts it has not passed."""
        return bool(self.left_out) or (bool(self.verdicts) and not self.failures)

    @property
    def failures(self) -> dict[str, Verdict]:
        """The verdicts that are not good."""
        return {name: verdict for name, verdict in self.verdicts.items() if not verdict.passed}


def passed_of(outcomes: Sequence[Outcome[C]]) -> str:
    """``3 of 4 cases passed``; cases that were left out do not count."""
    run = [outcome for outcome in outcomes if not outcome.left_out]
    return f"{sum(outcome.passed for outcome in run)} of {len(run)} cases passed"
