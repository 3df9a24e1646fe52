"""``check`` of a run's folder: triangles that cross in its states."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mpi4py import MPI

from lyra_petsc.output.agreement import on_each
from lyra_petsc.output.crossings import state_crossings
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.parallel import on_root

NAMED = 3
"""Pairs of a state that are named."""

ROW = "{:>5} {:>11} {:>16} {:>17}  {}"


def check_run(comm: MPI.Comm, folder: Path, *, crossings: bool = False) -> int:
    """Print on rank 0 what crosses in each state of a run; collective. Each rank looks at some of the states.

    Parameters
    ----------
    comm : MPI.Comm
    folder : Path
        Of the run, which may go on.
    crossings : bool
        Crossings are a failure also without contact in the scene.

    Returns
    -------
    int
        Exit code: 1 if anything crosses in a run with contact, or with ``crossings``.

    Raises
    ------
    InputError
        If it is not the folder of a run, or is damaged.
    """
    run = on_root(comm, lambda: StoredRun(folder))
    time, contact = on_root(comm, lambda: _kind(run))
    _say(comm, f"{folder}: {len(run)} states; pairs of triangles that cross, with")
    _say(comm, ROW.format("state", time, "no common vertex", "one common vertex", "first pairs"))
    counts: list[int] = []
    for begin in range(0, len(run), comm.size):
        found = on_each(comm, partial(_of_state, run, begin + comm.rank))
        for state, one in enumerate(comm.allgather(found), start=begin):
            if one is not None:
                counts.append(one.pairs + one.corner_pairs)
                times = f"{run.times[state]:g}"
                _say(comm, ROW.format(state, times, one.pairs, one.corner_pairs, one.first))
    crossed = sum(count > 0 for count in counts)
    if crossed:
        most = f"most in state {int(np.argmax(counts))}: {max(counts)} pairs"
        _say(comm, f"crossings in {crossed} of {len(run)} states, {most}")
    else:
        _say(comm, f"no crossings in {len(run)} states")
    if not contact:
        remedy = "" if crossings else "; --crossings makes a crossing exit code 1"
        _say(comm, f"the scene has no contact{remedy}")
    return int(crossed > 0 and (contact or crossings))


class _Found(NamedTuple):
    """What is told of a state: how many pairs cross without and with a common vertex, and the first."""

    pairs: int
    corner_pairs: int
    first: str


def _kind(run: StoredRun) -> tuple[str, bool]:
    """What the times of a run's states are, and whether its scene has contact."""
    static = run.scene.time.analysis == "static"
    return "load factor" if static else "time [s]", getattr(run.scene, "contact", None) is not None


def _of_state(run: StoredRun, state: int) -> _Found | None:
    """What crosses in a state; None beyond the last one."""
    if state >= len(run):
        return None
    found = state_crossings(run, state)
    first = np.concatenate([found.pairs[:NAMED], found.corner_pairs[:NAMED]])[:NAMED]
    named = ", ".join(f"{one}-{other}" for one, other in first.tolist())
    return _Found(len(found.pairs), len(found.corner_pairs), named)


def _say(comm: MPI.Comm, line: str) -> None:
    if comm.rank == 0:
        print(line.rstrip(), flush=True)
