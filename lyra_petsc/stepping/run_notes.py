"""Notes to the user on a run: each subject once, and a summary of the attempts that were repeated."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from lyra_petsc.stepping.stepper import Attempt
from lyra_petsc.terms.protocols import Event

if TYPE_CHECKING:
    from lyra_petsc.stepping.simulation import SteppedScene

DOUBTFUL = 0.1
"""Residual at round-off over the loads above which a note doubts an equilibrium."""


class RunNotes:
    """The notes of a run.

    Attributes
    ----------
    texts : list of str
    earlier : int
        How many of them come from the run that wrote the checkpoint.
    """

    def __init__(self) -> None:
        self.texts: list[str] = []
        self.earlier = 0
        self._subjects: set[str] = set()
        self._repeats: dict[str, int] = {}
        self._smallest_dt = math.inf

    def once(self, subject: str, text: str) -> None:
        """Add a note unless the run has one on this subject."""
        if subject not in self._subjects:
            self._subjects.add(subject)
            self.texts.append(text)

    def has(self, subject: str) -> bool:
        """Whether the run has a note on this subject."""
        return subject in self._subjects

    def count_repeat(self, why: str, dt: float) -> None:
        """Count an attempt that is repeated with a smaller step of dt [s], or increment."""
        self._repeats[why] = self._repeats.get(why, 0) + 1
        self._smallest_dt = min(self._smallest_dt, dt)

    def on_repeats(self, quantity: str, unit: str) -> str:
        """How many attempts so far were repeated with a smaller step, and why; empty if none was."""
        if not self._repeats:
            return ""
        times = sum(self._repeats.values())
        often = sorted(self._repeats.items(), key=lambda repeat: -repeat[1])
        reasons = "; ".join(f"{why}: {count} times" if count > 1 else f"{why}: once" for why, count in often)
        return (
            f"{times} {'attempt was' if times == 1 else 'attempts were'} repeated with a smaller {quantity}, "
            f"down to {self._smallest_dt:.3g}{unit} ({reasons})"
        )

    def saved_state(self) -> dict[str, Any]:
        """Entries of a checkpoint."""
        return {
            "repeated": dict(self._repeats),
            "least": self._smallest_dt if self._repeats else None,
            "notes": list(self.texts),
            "told": sorted(self._subjects),
        }

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Put the notes of a `saved_state` before those of the set-up."""
        self._repeats = dict(saved["repeated"])
        self._smallest_dt = math.inf if saved["least"] is None else saved["least"]
        self._subjects |= set(saved["told"])
        earlier = saved["notes"]
        self.earlier = len(earlier)
        self.texts[:] = [*earlier, *(note for note in self.texts if note not in earlier)]


def note_of_repeats(run: SteppedScene) -> str:
    """How many attempts of a run were repeated with a smaller step, and why; empty if none was."""
    moves = run.problem.equations.integrator.dynamic
    note = run.run_notes.on_repeats(*(("Δt", " s") if moves else ("increment", "")))
    if not note or run.scene.time.adaptive or not moves:
        return note
    planned = math.ceil(run.time / run.control.step * (1.0 - 1e-9))
    return f"{note}; {run.step_number} steps were taken where {planned} of the full Δt would do"


def events(run: SteppedScene) -> list[Event]:
    """What happens to elements of terms at the end of the step, by subject and size; collective."""
    equations = run.problem.equations
    told: list[list[Event]] = []
    for term in equations.active.telling:
        told += run.comm.allgather(term.events(equations.x, equations.step.frozen[term]))
    return sorted(chain(*told), key=lambda event: (event.subject, -event.size))


def note_step(run: SteppedScene, attempt: Attempt) -> bool:
    """Note what is remarkable about the step just accepted; returns whether it has `events`; collective."""
    when, notes = f"step {run.step_number} ({run.time_text()})", run.run_notes
    with run.phases("balance"):
        note = run.compression.check(when, reported=notes.has("compression"))
    if note:
        notes.once("compression", note)
    if attempt.at_roundoff and not notes.has("roundoff"):
        loads = float(np.sum(run.problem.equations.step.loads.force**2))
        driving = math.sqrt(run.comm.allreduce(loads))
        if attempt.residual > run.scene.solver.force_tolerance * driving > 0.0:
            times = attempt.residual / driving
            doubt = "; slender triangles or a stiffness that is too large for the loads may make it wrong"
            notes.once(
                "roundoff",
                f"{when} ended at round-off: double precision leaves a residual of {attempt.residual:.2g} N "
                f"at this stiffness, {times:.1g} times the loads"
                + (doubt if run.scene.time.static and times > DOUBTFUL else ""),
            )
    happened = events(run)
    for event in happened:
        notes.once(event.subject, f"{when}: {event.text}")
    if run.stepper.solver.stopped_by:
        notes.once(
            "option",
            f"{when}: {run.stepper.solver.stopped_by} stopped Newton's method at a residual of "
            f"{attempt.residual:.2g} N, short of solver.force_tolerance",
        )
    return bool(happened)
