"""Starts mpirun from a process that was not started by a launcher itself."""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from lyra_petsc.errors import InputError, OutputError
from lyra_petsc.output.file_operations import reason
from lyra_petsc.startup import is_launched

JOB_PREFIXES = ("OMPI_COMM_", "OMPI_UNIVERSE", "OMPI_APP", "PMIX_", "PMI_", "HYDRA_", "ORTE_SCHIZO_")

SINGLETON_VARIABLES = frozenset(
    f"OMPI_MCA_{name}"
    for name in ("ess", "pmix", "orte_launch", "orte_ess_num_procs", "orte_precondition_transports")
)
"""Variables that Open MPI 4 sets in a process without a launcher, with which an mpirun started there
fails."""


def find_launcher(ranks: int) -> list[str]:
    """The command that starts ``ranks`` ranks: ``MPIRUN``, else the mpirun beside Python or on the path.

    Raises
    ------
    InputError
        Under an mpirun, for fewer ranks than one, or if there is no launcher.
    """
    if ranks < 1:
        raise InputError(f"must be at least 1, not {ranks}", key="--ranks")
    if is_launched(os.environ):
        raise InputError(
            "starts one mpirun per case and cannot be used under mpirun; leave one of them out", key="--ranks"
        )
    command = shlex.split(os.environ.get("MPIRUN", ""))
    if not command:
        beside = Path(sys.executable).with_name("mpirun")
        command = [str(beside) if beside.exists() else "mpirun"]
    if shutil.which(command[0]) is None:
        raise InputError(f"{command[0]} not found; install it or set MPIRUN", key="--ranks")
    return [*command, "-n", str(ranks)]


def environment() -> dict[str, str]:
    """Environment for a launcher: that of this process without the variables of a parallel job."""
    variables = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(JOB_PREFIXES) and name not in SINGLETON_VARIABLES
    }
    variables.setdefault("OMPI_MCA_rmaps_base_oversubscribe", "1")
    variables.setdefault("PRTE_MCA_rmaps_default_mapping_policy", ":oversubscribe")
    variables.setdefault("OMP_NUM_THREADS", "1")
    if os.geteuid() == 0:
        for name in ("OMPI_ALLOW_RUN_AS_ROOT", "PRTE_ALLOW_RUN_AS_ROOT"):
            variables[name] = variables[f"{name}_CONFIRM"] = "1"
    return variables


def run_launched(
    command: Sequence[str], watch: Callable[[], None], keep_open: Sequence[int] = ()
) -> tuple[int, str]:
    """Run a command with a launcher to its end; returns its exit code and its standard error.

    Parameters
    ----------
    command : sequence of str
        The command.
    watch : callable
        Called repeatedly; if it raises, the process is terminated.
    keep_open : sequence of int
        File descriptors that the process inherits.

    Raises
    ------
    OutputError
        If the command cannot be started.
    """
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as errors_file:
        try:
            process = subprocess.Popen(
                command,
                env=environment(),
                stdin=subprocess.DEVNULL,
                stderr=errors_file.fileno(),
                start_new_session=True,
                preexec_fn=_end_with_parent(),
                pass_fds=tuple(keep_open),
            )
        except OSError as error:
            raise OutputError(f"{command[0]} cannot be started: {reason(error)}") from error
        try:
            while process.poll() is None:
                time.sleep(0.05)
                watch()
            watch()
        except BaseException:
            _terminate(process)
            raise
        errors_file.seek(0)
        return int(process.returncode), errors_file.read()


def _end_with_parent() -> Callable[[], None] | None:
    """Function for a new process to call so that it ends with this one; None if the system has no prctl."""
    try:
        control = ctypes.CDLL(None).prctl
    except (AttributeError, OSError):
        return None
    set_signal = 1  # PR_SET_PDEATHSIG: the signal that a process gets when its parent ends
    return lambda: control(set_signal, signal.SIGTERM)


def _terminate(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(10.0)  # seconds, before it is killed
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def error_message(errors: str, code: int) -> str:
    """Message of a failed process: this program's line in ``errors``, else exit code and last line."""
    own = [line for line in errors.splitlines() if line.startswith("lyra-petsc: ")]
    if own:
        return own[0].removeprefix("lyra-petsc: ")
    lines = [line.strip() for line in errors.splitlines() if line.strip(" -\t")]
    return f"its mpirun ended with exit code {code}" + (f": {lines[-1]}" if lines else "")
