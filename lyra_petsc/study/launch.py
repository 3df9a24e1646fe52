"""``--ranks P``: every case in an mpirun of its own, one after another."""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import signal
import site
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import lyra_petsc
from lyra_petsc.errors import InputError, OutputError
from lyra_petsc.output.agreement import reason
from lyra_petsc.output.atomic import replace_text
from lyra_petsc.study.case import Job, Result, read_result

POLL = 0.05
"""Seconds between looks at a process."""

GRACE = 10.0
"""Seconds [s] that a process gets to leave before it is killed."""

PR_SET_PDEATHSIG = 1
"""Linux: the signal that a process gets when its parent ends."""

PROGRESS_FILE = "progress"
OF_A_JOB = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "PMI_RANK", "PMIX_RANK", "MPI_LOCALNRANKS")
"""Variables that say that a process was started by a launcher."""

NOT_INHERITED = ("OMPI_COMM_", "OMPI_UNIVERSE", "OMPI_APP", "PMIX_", "PMI_", "HYDRA_")


def is_launched(environment: Mapping[str, str]) -> bool:
    """Whether this process was started by mpirun, mpiexec or srun."""
    if any(name in environment for name in OF_A_JOB):
        return True
    # only inside srun: a batch script has the first of these, too
    return "SLURM_STEP_NUM_TASKS" in environment and "SLURM_PROCID" in environment


def find_launcher(ranks: int) -> list[str]:
    """The command that starts ``ranks`` ranks: ``MPIRUN``, else the mpirun beside Python or on the path.

    Raises
    ------
    InputError
        Under an mpirun, for a number that is none, or where there is no launcher.
    """
    if ranks < 1:
        raise InputError(f"must be at least 1, not {ranks}", key="--ranks")
    if is_launched(os.environ):
        raise InputError(
            "starts one mpirun per case and cannot be used under mpirun; leave one of them out", key="--ranks"
        )
    words = shlex.split(os.environ.get("MPIRUN", ""))
    if not words:
        beside = Path(sys.executable).with_name("mpirun")
        words = [str(beside) if beside.exists() else "mpirun"]
    if shutil.which(words[0]) is None:
        raise InputError(f"{words[0]} not found; install it or set MPIRUN", key="--ranks")
    return [*words, "-n", str(ranks)]


def environment() -> dict[str, str]:
    """For a launcher: this one's, without what tells a process that it is one of a parallel job."""
    ours = {name: value for name, value in os.environ.items() if not name.startswith(NOT_INHERITED)}
    ours.setdefault("OMPI_MCA_rmaps_base_oversubscribe", "1")
    ours.setdefault("PRTE_MCA_rmaps_default_mapping_policy", ":oversubscribe")
    ours.setdefault("OMP_NUM_THREADS", "1")
    if os.geteuid() == 0:
        for name in ("OMPI_ALLOW_RUN_AS_ROOT", "PRTE_ALLOW_RUN_AS_ROOT"):
            ours[name] = ours[f"{name}_CONFIRM"] = "1"
    home = str(Path(lyra_petsc.__file__).resolve().parents[1])
    if home not in site.getsitepackages():
        ours["PYTHONPATH"] = home + os.pathsep * bool(ours.get("PYTHONPATH")) + ours.get("PYTHONPATH", "")
    return ours


class Launcher:
    """Runs jobs, each in a launcher's processes of its own.

    Parameters
    ----------
    command : sequence of str
        From `find_launcher`.
    petsc : sequence of str
        PETSc's options of the command line.
    lock : int
        File descriptor that the processes keep open, so that the folder stays locked while they live.
    """

    def __init__(self, command: Sequence[str], petsc: Sequence[str], lock: int) -> None:
        self._command, self._petsc, self._lock = list(command), list(petsc), lock

    def __call__(self, job: Job, watch: Callable[[float], None], warm: bool) -> Result:
        """Run a job; ``warm`` has no meaning, as every process must warm up."""
        folder = Path(job.folder)
        told = folder.parent / f"{folder.name}.job.json"
        replace_text(told, job.text())
        words = [*self._command, sys.executable, "-m", "lyra_petsc", "study", "--job", str(told)]
        try:
            code, heard = run_launched(
                [*words, *self._petsc], lambda: watch(_fraction(folder)), keep_open=(self._lock,)
            )
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


def run_launched(
    words: Sequence[str], watch: Callable[[], None], keep_open: Sequence[int] = ()
) -> tuple[int, str]:
    """Run a launcher's command to its end; its exit code and what it said on stderr.

    Parameters
    ----------
    words : sequence of str
    watch : callable
        Called again and again; where it raises, the process is ended.
    keep_open : sequence of int
        File descriptors that it inherits.

    Raises
    ------
    OutputError
        If it cannot be started.
    """
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as complaints:
        try:
            process = subprocess.Popen(
                words,
                env=environment(),
                stdin=subprocess.DEVNULL,
                stderr=complaints.fileno(),
                start_new_session=True,
                preexec_fn=_with_parent(),
                pass_fds=tuple(keep_open),
            )
        except OSError as error:
            raise OutputError(f"{words[0]} cannot be started: {reason(error)}") from error
        try:
            while process.poll() is None:
                time.sleep(POLL)
                watch()
            watch()
        except BaseException:
            _end(process)
            raise
        complaints.seek(0)
        return int(process.returncode), complaints.read()


def _with_parent() -> Callable[[], None] | None:
    """What a new process calls to be ended when this one is killed; None where the system cannot."""
    try:
        control = ctypes.CDLL(None).prctl
    except (AttributeError, OSError):
        return None
    return lambda: control(PR_SET_PDEATHSIG, signal.SIGTERM)


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


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(GRACE)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def last_words(heard: str, code: int) -> str:
    """What a launched process had to say in the end: our line, else its last, and the exit code."""
    ours = [line for line in heard.splitlines() if line.startswith("lyra-petsc: ")]
    if ours:
        return ours[0].removeprefix("lyra-petsc: ")
    lines = [line.strip() for line in heard.splitlines() if line.strip(" -\t")]
    return f"its mpirun ended with exit code {code}" + (f": {lines[-1]}" if lines else "")
