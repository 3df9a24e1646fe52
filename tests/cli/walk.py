"""Many runs with different PETSc options, forked from one process that has loaded everything.

Arguments: a folder with ``scene.yaml``. Each line of the standard input is a list of command lines' PETSc
options in JSON; the answer is a line with exit code, stdout and stderr of each run.
"""

from __future__ import annotations

import gc
import json
import os
import resource
import sys
import traceback
from pathlib import Path

os.environ |= {"OMPI_MCA_ess_singleton_isolated": "1"}  # no daemon of Open MPI
CPU_SECONDS = 60


def start(folder: Path, words: list[str]) -> int:
    """Fork a process for one run; returns its process number."""
    pid = os.fork()
    if pid:
        return pid
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS))
    for number, path in enumerate(files(folder), start=1):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    code = 70
    try:
        code = simulate(folder / "scene.yaml", words)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def simulate(scene: Path, words: list[str]) -> int:
    """Compute one step, as ``run`` does; returns the exit code."""
    from mpi4py import MPI
    from petsc4py import PETSc

    from lyra_petsc.cli.arguments import split
    from lyra_petsc.errors import LyraError
    from lyra_petsc.scene.load import load_scene
    from lyra_petsc.startup import options_error
    from lyra_petsc.stepping.simulation import SteppedScene

    ours, petsc = split(words)
    why = options_error(petsc)
    if why:
        print(f"lyra-petsc: {why}", file=sys.stderr)
        return 2
    PETSc.Options().insertString(" ".join(petsc))
    try:
        simulation = SteppedScene(
            MPI.COMM_WORLD, load_scene(scene, [word for word in ours if word != "--set"])
        )
        simulation.step()
        simulation.destroy()
    except LyraError as error:
        print(f"lyra-petsc: {' '.join(str(error).split())}", file=sys.stderr)
        return error.exit_code
    return 0


def files(folder: Path) -> tuple[Path, Path]:
    """Files for stdout and stderr of a run."""
    return folder / "out", folder / "err"


def run_all(folder: Path, runs: list[list[str]]) -> list[tuple[int, str, str]]:
    """Exit code (negative for a signal, as after too long a time), stdout and stderr of each run."""
    ended = []
    for words in runs:
        pid = start(folder, words)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        ended.append((code, *(file.read_text(errors="replace") for file in files(folder))))
    return ended


def main() -> None:
    folder = Path(sys.argv[1])
    import petsc4py

    petsc4py.init(["lyra-petsc"])
    from mpi4py import MPI

    from lyra_petsc.phases import Phases
    from lyra_petsc.scene.load import load_scene
    from lyra_petsc.stepping.simulation import SteppedScene

    for settings in ([], ["petsc.pc_type=mg"], ["petsc.mat_type=aij"]):
        simulation = SteppedScene(MPI.COMM_SELF, load_scene(folder / "scene.yaml", settings), Phases())
        simulation.step()
        simulation.destroy()
    gc.collect()
    gc.freeze()  # else each forked process copies the memory that the collector visits
    for line in sys.stdin:
        print(json.dumps(run_all(folder, json.loads(line))), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()
