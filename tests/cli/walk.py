"""Many runs with different PETSc options, forked from one process that has loaded everything.

Arguments: a folder with ``scene.yaml``. Each line of the standard input is a list of command lines' PETSc
options in JSON; the answer is a line with exit code, stdout and stderr of each run.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import sys
import time
import traceback
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from patience import Patience

os.environ |= {"OMPI_MCA_ess_singleton_isolated": "1"}  # no daemon of Open MPI
AT_A_TIME = 2


def start(folder: Path, words: list[str], name: str) -> int:
    """Fork a process for one run; returns its process number."""
    pid = os.fork()
    if pid:
        return pid
    for number, path in enumerate(files(folder, name), start=1):
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


def files(folder: Path, name: str) -> tuple[Path, Path]:
    """Files for stdout and stderr of a run."""
    return folder / f"{name}.out", folder / f"{name}.err"


def run_all(folder: Path, runs: list[list[str]]) -> list[tuple[int, str, str]]:
    """Exit code (−1 if it hangs), stdout and stderr of each run; several run at the same time."""
    waiting = list(enumerate(runs))
    going: dict[int, tuple[int, Patience]] = {}
    codes: dict[int, int] = {}
    while waiting or going:
        while waiting and len(going) < AT_A_TIME:
            number, words = waiting.pop(0)
            going[number] = start(folder, words, f"run{number}"), Patience()
        for number, (pid, patience) in list(going.items()):
            ended, status = os.waitpid(pid, os.WNOHANG)
            late = patience.over
            if late and not ended:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
            if ended or late:
                codes[number] = os.waitstatus_to_exitcode(status) if ended else -1
                del going[number]
        time.sleep(0.002)
    return [
        (codes[number], *(file.read_text(errors="replace") for file in files(folder, f"run{number}")))
        for number in range(len(runs))
    ]


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
