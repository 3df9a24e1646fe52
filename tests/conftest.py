"""Fixtures for all tests; agreement of ranks, so that parallel runs of pytest do not hang.

``tests/NAME`` has the tests of the package ``lyra_petsc/NAME``; run them first after a change of it:
``bash scripts/test.sh tests/NAME``. In addition, ``scenes`` tests whole scenes, ``surviving`` kills runs and
fills disks, ``fuzz`` generates damaged input, ``docs`` runs the commands of the documentation, ``scripts``
tests the scripts, and ``test_house.py`` the order of imports. ``physics.py`` builds and steps small scenes in
the test's process, ``cli/launch.py`` starts the program, ``written_run.py`` writes a run without simulating.

Tests marked ``parallel`` run under ``mpirun -n N python -m pytest -m parallel``: every rank runs the same
test at the same time on ``COMM_WORLD``. Without mpirun they run on one rank. ``parallel(2)`` limits a test to
two ranks if three show nothing more, ``parallel(3)`` to three if it is about data on several ranks, and
``parallel(1)`` to one in a module that is marked as a whole. ``parallel(alone=False)`` omits one rank for a
test that compares ranks, or that repeats there what others show. After each such test the ranks agree on its
outcome: a failure on any rank is a failure on all, and is shown by rank 0; a rank whose partners never reach
this agreement ends the whole job.
"""

from __future__ import annotations

import faulthandler
import gc
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import numpy as np
import pytest
from compile_once import compile_once
from mpi4py import MPI
from patience import Patience

WAIT_FOR_OTHERS = 20.0  # s that a failed rank gives the others to finish the test
LONGEST_TEST = 300.0  # s of CPU time after which a rank prints its stack and the job ends; who waits computes

WORLD = MPI.COMM_WORLD
FAILURE = pytest.StashKey[str]()
FAILURE_ELSEWHERE = pytest.StashKey[str]()
TERMINAL = pytest.StashKey[TextIO]()


@pytest.fixture
def comm() -> MPI.Comm:
    """COMM_WORLD."""
    return WORLD


@pytest.fixture(autouse=True)
def petsc_options() -> Iterator[None]:
    """Remove the PETSc options that a test has set, so that tests do not affect each other."""
    from petsc4py import PETSc

    database = PETSc.Options()
    before = set(database.getAll())
    yield
    for name in set(database.getAll()) - before:
        database.delValue(name)


@pytest.fixture
def shared_tmp(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An empty folder of this test, the same on every rank."""
    return Path(WORLD.bcast(tmp_path_factory.mktemp("shared") if WORLD.rank == 0 else None, root=0))


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 300 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(words, capture_output=True).returncode != 0:
        pytest.skip("mounting a tmpfs is not permitted here")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.hookimpl(trylast=True)  # the terminal exists by then
def pytest_configure(config: pytest.Config) -> None:
    import petsc4py.PETSc  # noqa: F401

    from lyra_petsc.parallel import restore_signal_handlers

    # or a pipe that is closed, as by a film that cannot be written, ends pytest
    restore_signal_handlers()
    if WORLD.size == 1:
        compile_once()
        return
    capture = config.pluginmanager.getplugin("capturemanager")
    if capture is not None:
        with capture.global_and_fixture_disabled():
            terminal = os.dup(2)
    else:
        terminal = os.dup(2)
    config.stash[TERMINAL] = os.fdopen(terminal, "w")
    signal.signal(signal.SIGPROF, signal.SIG_DFL)  # ends the process, after the stack is printed
    faulthandler.register(signal.SIGPROF, file=config.stash[TERMINAL], all_threads=True, chain=True)
    if WORLD.rank > 0:  # rank 0 speaks for all
        config.get_terminal_writer()._file = open(os.devnull, "w")  # noqa: SIM115


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect tests that are meant for other numbers of ranks."""
    chosen = [
        item
        for item in items
        if not (mark := item.get_closest_marker("parallel")) or runs_here(*mark.args, **mark.kwargs)
    ]
    config.hook.pytest_deselected(items=[item for item in items if item not in chosen])
    items[:] = chosen


def runs_here(*ranks: int, alone: bool = True) -> bool:
    """Whether a test with this mark runs on the present number of ranks."""
    return alone if WORLD.size == 1 else WORLD.size in (ranks or (WORLD.size,))


def pytest_collection_finish() -> None:
    """Exclude objects of imports from garbage collections, of which each parallel test ends with one."""
    gc.collect()
    gc.freeze()


def together(item: pytest.Item) -> bool:
    return WORLD.size > 1 and item.get_closest_marker("parallel") is not None


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    if together(item):
        signal.setitimer(signal.ITIMER_PROF, LONGEST_TEST)
    yield
    if together(item):
        signal.setitimer(signal.ITIMER_PROF, 0.0)


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_teardown(item: pytest.Item) -> Iterator[None]:
    """Agree on the outcome before fixtures (whose end may be collective) are torn down."""
    if together(item):
        agree(item)
    yield
    if together(item):
        collect_garbage()


def agree(item: pytest.Item) -> None:
    mine = item.stash.get(FAILURE, None)
    failed, any_failed = np.array([mine is not None], "i"), np.zeros(1, "i")
    request = WORLD.Iallreduce(failed, any_failed, MPI.MAX)
    patience = Patience(WAIT_FOR_OTHERS)
    while not request.Test():
        time.sleep(1e-3)
        if mine is not None and patience.over:
            terminal = item.config.stash[TERMINAL]
            terminal.write(f"\nfailed on rank {WORLD.rank}, others still wait: {item.nodeid}\n{mine}\n")
            terminal.flush()
            WORLD.Abort(1)
    if any_failed[0]:
        texts = WORLD.allgather(mine)
        if mine is None:
            item.stash[FAILURE_ELSEWHERE] = "\n".join(
                f"failed on rank {rank}:\n{text}" for rank, text in enumerate(texts) if text is not None
            )


def collect_garbage() -> None:
    """Objects that are freed collectively must be freed at the same place on all ranks."""
    gc.collect()
    if "petsc4py.PETSc" in sys.modules:
        from petsc4py import PETSc

        if hasattr(PETSc, "garbage_cleanup"):
            PETSc.garbage_cleanup()
    gc.freeze()  # objects that outlive tests, mainly kernels: each collection would visit them
    WORLD.Barrier()


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    outcome = yield
    report = outcome.get_result()
    if not together(item):
        return
    if report.failed and report.when != "teardown":
        item.stash[FAILURE] = report.longreprtext
    elsewhere = item.stash.get(FAILURE_ELSEWHERE, None)
    if report.when == "teardown" and elsewhere is not None:
        report.outcome = "failed"
        report.longrepr = elsewhere
