"""``--ranks P``: every case in an mpirun of its own, one after another."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from lyra_petsc.api.mpirun import last_words
from lyra_petsc.experiments import records
from lyra_petsc.experiments.launch import Launcher
from lyra_petsc.experiments.study.case import Job, Result, read_result

PROGRESS_FILE = "progress"


def launched(launcher: Launcher, job: Job, watch: Callable[[float], None], lock: int) -> Result:
    """What comes of a job in processes of its own.

    Parameters
    ----------
    launcher : Launcher
    job : Job
    watch : callable
        Called again and again with the fraction that is done; where it raises, the processes are ended.
    lock : int
        File descriptor that the processes keep open, so that the folder stays locked while they live.
    """
    folder = Path(job.folder)
    told = folder.parent / f"{folder.name}.job.json"
    records.save(told, job)
    try:
        code, heard = launcher(["--job", str(told)], lambda: watch(_fraction(folder)), (lock,))
        watch(1.0)
    finally:
        told.unlink(missing_ok=True)
        (folder / PROGRESS_FILE).unlink(missing_ok=True)
    result = read_result(folder, job.fingerprint)
    if result is None:
        result = Result(job.fingerprint, problem=last_words(heard, code))
        folder.mkdir(parents=True, exist_ok=True)
        result.write(folder)
    return result


def report_progress(folder: Path) -> Callable[[float], None]:
    """What a launched case calls on rank 0 to tell how far it is, some times a second."""
    last = 0.0

    def tell(fraction: float) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last > 0.3:
            last = now
            (folder / PROGRESS_FILE).write_text(f"{fraction:.6f}", encoding="ascii")

    return tell


def _fraction(folder: Path) -> float:
    try:
        return min(1.0, float((folder / PROGRESS_FILE).read_text(encoding="ascii")))
    except (OSError, ValueError):
        return 0.0
