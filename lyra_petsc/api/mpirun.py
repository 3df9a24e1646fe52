"""Starts mpirun, and other processes of this package, from a process that has no launcher."""

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

POLL = 0.05
"""Seconds between checks of a process."""

GRACE = 10.0
"""Seconds that a process has to end before it is killed."""

PR_SET_PDEATHSIG = 1
"""Linux: the signal that a process gets when its parent ends."""

LAUNCHER_VARIABLES = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "PMI_RANK", "PMIX_RANK", "MPI_LOCALNRANKS")
"""Environment variables of processes that a launcher has started."""

NOT_INHERITED = ("OMPI_COMM_", "OMPI_UNIVERSE", "OMPI_APP", "PMIX_", "PMI_", "HYDRA_", "ORTE_SCHIZO_")

OF_ONE_PROCESS = frozenset(
    f"OMPI_MCA_{name}"
    for name in ("ess", "pmix", "orte_launch", "orte_ess_num_procs", "orte_precondition_transports")
)
"""What Open MPI 4 sets in a process without a launcher, and what mpirun started from there would fail by."""


def is_launched(environment: Mapping[str, str]) -> bool:
    """Whether this process was started by mpirun, mpiexec or srun."""
    if environment.get("OMPI_MCA_ess") == "singleton":  # below a process that no launcher has started
        return False
    if any(name in environment for name in LAUNCHER_VARIABLES):
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
    """Environment for a launcher: that of this process without the variables of a parallel job."""
    ours = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(NOT_INHERITED) and name not in OF_ONE_PROCESS
    }
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


def run_launched(
    words: Sequence[str], watch: Callable[[], None], keep_open: Sequence[int] = ()
) -> tuple[int, str]:
    """Run a launcher's command to its end; its exit code and its standard error.

    Parameters
    ----------
    words : sequence of str
    watch : callable
        Called repeatedly; if it raises, the process is ended.
    keep_open : sequence of int
        File descriptors that it inherits.

    Raises
    ------
    OutputError
        If it cannot be started.
    """
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as errors_file:
        try:
            process = subprocess.Popen(
                words,
                env=environment(),
                stdin=subprocess.DEVNULL,
                stderr=errors_file.fileno(),
                start_new_session=True,
                preexec_fn=_end_with_parent(),
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
            _terminate(process)
            raise
        errors_file.seek(0)
        return int(process.returncode), errors_file.read()


def _end_with_parent() -> Callable[[], None] | None:
    """What a new process calls so that it ends when this one is killed; None if the system lacks that."""
    try:
        control = ctypes.CDLL(None).prctl
    except (AttributeError, OSError):
        return None
    return lambda: control(PR_SET_PDEATHSIG, signal.SIGTERM)


def _terminate(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(GRACE)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def last_words(errors: str, code: int) -> str:
    """The message of a launched process: the line of this program, else its last line and the exit code."""
    own = [line for line in errors.splitlines() if line.startswith("lyra-petsc: ")]
    if own:
        return own[0].removeprefix("lyra-petsc: ")
    lines = [line.strip() for line in errors.splitlines() if line.strip(" -\t")]
    return f"its mpirun ended with exit code {code}" + (f": {lines[-1]}" if lines else "")
