"""Notes on ranks that wait for processors, and on a better number of ranks."""

from __future__ import annotations

import time

import pytest
from mpi4py import MPI

from lyra_petsc.api import waiting
from lyra_petsc.api.waiting import Share, Waiting, note_on

pytestmark = pytest.mark.parallel


def shares(*got: float, processors: int = 2, machine: str = "a") -> list[Share]:
    return [Share(machine, one, frozenset(range(processors))) for one in got]


@pytest.mark.parametrize(
    ("everyone", "words"),
    [
        (shares(1.0, 0.97), ""),
        (shares(0.8, 0.7), ""),
        (shares(1.0), ""),
        (shares(0.1), ""),
        (shares(0.5, 0.52), "49 % of the time (other programs use them) and waited for each other; 1 rank w"),
        (shares(0.03, 0.05), "; 1 rank would be faster"),
        (shares(0.66, 0.67, 0.66), "(there are 2) and waited for each other; 2 ranks would be faster"),
        (shares(0.5, 0.5, 0.5, 0.5), "4 ranks were without a processor for 50 % of the time (there are 2)"),
        (shares(0.3, 0.3, 0.3, 0.3), "; 1 rank would be faster"),
        (shares(0.5, 0.5, 0.5, 0.5, processors=4), "; 2 ranks would be faster"),
        (shares(1.0, 1.0) + shares(1.0, 1.0, machine="b"), ""),
        (shares(0.5, 0.5, 0.5, 0.5) + shares(1.0, 1.0, machine="b"), "(there are 4)"),
    ],
)
def test_content_of_the_note(everyone: list[Share], words: str) -> None:
    note = note_on(everyone)
    assert words in note
    assert bool(note) == bool(words)


def test_a_note_comes_once_and_not_for_one_rank(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(waiting, "MIN_SECONDS", 0.05)
    comm = MPI.COMM_WORLD
    counted, notes = Waiting(comm), []
    for step in range(20):
        with counted.step():
            time.sleep(0.01)  # as a rank that has no processor
        notes.append(counted.check(last=step == 19))
    noted = [step for step, note in enumerate(notes) if note]
    assert noted == ([] if comm.size == 1 else [7])
    assert comm.allgather(counted.note) == [counted.note] * comm.size
