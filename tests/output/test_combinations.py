"""Each feature with every integrator: a run that is stopped and resumed, on other ranks too, is the same."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from combinations import EXCEPT, FEATURES, scene_with, write_files
from mpi4py import MPI
from resumed_runs import kept, same_tables, simulate_until, summary

from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.scene.schema import INTEGRATORS

MODELS = "hinge", "midedge"


@pytest.fixture
def folder(comm: MPI.Comm, shared_tmp: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, with the files that features name."""
    if comm.rank == 0:
        write_files(shared_tmp)
    comm.Barrier()
    monkeypatch.chdir(shared_tmp)
    return shared_tmp


def same(one: Path, other: Path) -> None:
    """Check that two runs have the same end, tables, states and notes, to the tolerance of the solvers."""
    mine, theirs = kept(one), kept(other)
    for name, tolerance in (("position", 1e-8), ("velocity", 1e-6)):
        np.testing.assert_allclose(mine[name], theirs[name], rtol=0, atol=tolerance, err_msg=name)
    same_tables(one, other, 1e-5)
    notes = [[n for n in summary(run)["notes"] if "round-off" not in n] for run in (one, other)]
    assert sorted(notes[0]) == sorted(notes[1])
    states, others = StoredRun(one).positions, StoredRun(other).positions
    np.testing.assert_allclose(np.asarray(states), np.asarray(others), rtol=0, atol=1e-8)


SCHEMES = (*INTEGRATORS, "static")
PAIRS = [pair for pair in product(FEATURES, SCHEMES) if pair not in EXCEPT]


def scene_of_pair(name: str, scheme: str) -> dict[str, Any]:
    return scene_with(FEATURES[name], scheme, ("hinge", "midedge")[PAIRS.index((name, scheme)) % 2])


@pytest.mark.parametrize(
    ("name", "scheme"),
    [pytest.param(*pair, marks=[pytest.mark.slow] * (n % 3 > 0)) for n, pair in enumerate(PAIRS)],
)
def test_a_run_goes_on_as_if_it_had_not_stopped(name: str, scheme: str, folder: Path) -> None:
    scene, stops = scene_of_pair(name, scheme), (1, 2 if scheme == "static" else 4)
    end = simulate_until(MPI.COMM_SELF, scene, folder / "straight", None)
    for stop in stops:
        reached = simulate_until(MPI.COMM_SELF, scene, folder / "halted", stop, resume=stop > stops[0])
        assert reached[0] == stop < end[0]
    assert simulate_until(MPI.COMM_SELF, scene, folder / "halted", None, resume=True) == end
    same(folder / "halted", folder / "straight")


@pytest.mark.parametrize(
    ("name", "scheme"),
    [
        pytest.param(*PAIRS[n], marks=pytest.mark.parallel(2 + n % 2, alone=False))
        for n in range(0, len(PAIRS), 5)
    ],
)
def test_it_goes_on_alike_on_other_ranks(comm: MPI.Comm, name: str, scheme: str, folder: Path) -> None:
    scene, stop = scene_of_pair(name, scheme), 2 if scheme == "static" else 3
    together, alone = folder / "together", folder / "alone"
    end = simulate_until(comm, scene, folder / "straight", None)
    assert simulate_until(comm, scene, together, stop)[0] == stop
    if comm.rank == 0:
        simulate_until(MPI.COMM_SELF, scene, together, None, resume=True)
        simulate_until(MPI.COMM_SELF, scene, alone, stop)
    comm.Barrier()
    assert simulate_until(comm, scene, alone, None, resume=True) == end
    if comm.rank == 0:
        same(together, folder / "straight")
        same(alone, folder / "straight")
