"""Performs one measurement in its own process or mpirun, so that memory is not affected by others.

    mpirun -n P python worker.py JOB.json RESULT.json [-petsc options]

``JOB.json`` holds ``kind`` (a name in `KINDS`), ``scene`` and further parameters of the kind; times are in
seconds of wall time, between barriers, unless stated otherwise.
"""

from __future__ import annotations

import json
import os
import re
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import petsc4py

petsc4py.init([sys.argv[0], *sys.argv[3:]])

import numpy as np  # noqa: E402
from mpi4py import MPI  # noqa: E402
from petsc4py import PETSc  # noqa: E402

from lyra_petsc import phases  # noqa: E402
from lyra_petsc.errors import LyraError  # noqa: E402
from lyra_petsc.linear.matrix import AssembledMatrix  # noqa: E402
from lyra_petsc.output.read_run import StoredRun  # noqa: E402
from lyra_petsc.output.recorder import Recorder  # noqa: E402
from lyra_petsc.output.summary import library_versions  # noqa: E402
from lyra_petsc.scene.schema import Scene  # noqa: E402
from lyra_petsc.stepping.simulation import SteppedScene  # noqa: E402

MIN_STEPS = 2
"""Smallest number of measured steps, however long they take."""

PARTS = {
    "residual": phases.RESIDUAL,
    "jacobian": phases.JACOBIAN,
    "frozen": phases.FROZEN,
    "energy": "SNESObjectiveEval",
    "preconditioner": "PCSetUp",
    "solve": "KSPSolve",
}
"""Parts of a step and their events in PETSc's log; they do not overlap."""

Comm = MPI.Intracomm
Result = dict[str, Any]


def now(comm: Comm) -> float:
    comm.Barrier()
    return time.perf_counter()


def resident() -> tuple[int, int]:
    """Current and peak resident memory of this process [bytes] (Linux)."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    now_and_peak = [re.search(rf"^{name}:\s+(\d+) kB", status, re.M) for name in ("VmRSS", "VmHWM")]
    current, peak = (1024 * int(line[1]) if line else 0 for line in now_and_peak)
    return current, peak


def reset_peak() -> None:
    """Reset the peak of the memory, as imports take more than they keep."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return


def events(comm: Comm) -> dict[str, tuple[float, int]]:
    """Seconds (mean over ranks) and number of calls of each of `PARTS` so far."""
    stage = phases.STAGES["solve"].id
    totals = {}
    for part, name in PARTS.items():
        info = PETSc.Log.Event(name).getPerfInfo(stage)
        totals[part] = (comm.allreduce(info["time"]) / comm.size, int(info["count"]))
    return totals


def matrix_product(comm: Comm, matrix: PETSc.Mat) -> list[float]:
    """Times of single products of a matrix with a vector: at least 20, and 0.2 s in total."""
    x, y = matrix.createVecs()
    x.setRandom()
    for _ in range(3):
        matrix.mult(x, y)
    times: list[float] = []
    while len(times) < 20 or (sum(times) < 0.2 and len(times) < 2000):
        began = now(comm)
        matrix.mult(x, y)
        times.append(comm.bcast(now(comm) - began))
    x.destroy()
    y.destroy()
    return times


def steps(comm: Comm, job: Result) -> Result:
    """Measure set-up, steps with their parts, and memory.

    After ``warm_up`` steps up to ``steps`` are measured, fewer if they take more than ``seconds``.
    """
    PETSc.Log.begin()
    reset_peak()
    before, _ = resident()
    began = now(comm)
    simulation = SteppedScene(comm, Scene.model_validate(job["scene"]))
    simulation.problem.release()
    built = now(comm) - began
    simulation.step()
    set_up = now(comm) - began
    for _ in range(job["warm_up"] - 1):
        simulation.step()
    rows: list[Result] = []
    first, past = now(comm), events(comm)
    while len(rows) < job["steps"]:
        began, cpu = now(comm), time.process_time()
        report = simulation.step()
        seconds, cpu, after = now(comm) - began, comm.allreduce(time.process_time() - cpu), events(comm)
        row: Result = {
            "seconds": seconds,
            "cpu": cpu,
            "newton": report.newton_iterations,
            "cg": report.linear_iterations,
        }
        spent = {part: after[part][0] - past[part][0] for part in PARTS}
        calls = {part: after[part][1] - past[part][1] for part in PARTS}
        row |= spent | {"rest": max(0.0, seconds - sum(spent.values()))}
        # assembly time of a Newton iteration; quantities frozen in a step serve all of its iterations
        row["assembly"] = spent["residual"] / max(1, calls["residual"])
        row["assembly"] += (spent["jacobian"] + spent["frozen"]) / max(1, calls["jacobian"])
        row["solves"] = calls["solve"]
        rows.append(row)
        past = after
        if comm.bcast(time.perf_counter() - first > job["seconds"] and len(rows) >= MIN_STEPS):
            break
    _, peak = resident()
    whole, stepper = simulation.problem.whole, simulation.stepper
    operator, pattern = stepper.solver.linear.operator, simulation.problem.pattern
    # PETSc's own product, with the storage of as many entries
    assembled = AssembledMatrix(simulation.problem.points, pattern, "sbaij")
    assembled.set(operator.rows)
    return {
        "vertices": whole.n_vertices,
        "triangles": whole.n_triangles,
        "integer_bits": 8 * np.dtype(PETSc.IntType).itemsize,
        "build_seconds": built,
        "set_up_seconds": set_up,
        "phases": simulation.phases.seconds(),
        "peak_bytes": comm.allgather(peak - before),
        "matmult_seconds": matrix_product(comm, operator.mat),
        "petsc_matmult_seconds": matrix_product(comm, assembled.mat),
        "matrix_type": operator.mat.getType(),
        "preset": stepper.preset,
        "petsc_options": PETSc.Options().getAll(),
        "notes": simulation.notes,
        "steps": rows,
    }


def meshes(comm: Comm, job: Result) -> Result:
    """Measure CPU time, summed over ranks, of steps of several scenes by turns, so that disturbances hit all.

    ``scenes`` by name; ``warm_up``, ``steps`` and ``seconds`` as for `steps`.
    """
    simulations, results = {}, {}
    for name, scene in job["scenes"].items():
        began = time.process_time()
        simulation = SteppedScene(comm, Scene.model_validate(scene))
        simulation.problem.release()
        simulation.step()
        simulations[name] = simulation
        results[name] = {
            "vertices": simulation.problem.whole.n_vertices,
            "preset": simulation.stepper.preset,
            "set_up_cpu": comm.allreduce(time.process_time() - began),
            "steps": [],
        }
        for option in simulation.stepper.our_options:
            PETSc.Options().delValue(option)  # the next chooses its own
    first, last = now(comm), job["warm_up"] - 1 + job["steps"]
    for number in range(1, last + 1):
        for name, simulation in simulations.items():
            wall, began = now(comm), time.process_time()
            report = simulation.step()
            cpu = comm.allreduce(time.process_time() - began)
            wall = comm.bcast(now(comm) - wall)
            results[name]["all_cpu"] = results[name].get("all_cpu", 0.0) + cpu
            if number >= job["warm_up"]:
                iterations = {"cg": report.linear_iterations, "newton": report.newton_iterations}
                results[name]["steps"].append({"cpu": cpu, "seconds": wall, **iterations})
        enough = number >= job["warm_up"] - 1 + MIN_STEPS
        if comm.bcast(time.perf_counter() - first > job["seconds"] and enough):
            break
    return {"meshes": results}


def apart(comm: Comm, job: Result) -> Result:
    """Measure steps of independent sheets, one a rank, at the same time."""
    own = steps(MPI.COMM_SELF, job)
    gathered = comm.gather([row["seconds"] for row in own["steps"]])
    seconds = [step for of_rank in gathered or [] for step in of_rank]
    return {"vertices": own["vertices"], "step_seconds": seconds}


def output(comm: Comm, job: Result) -> Result:
    """Write states with checkpoints, by turns with plain files of the same sizes; all with fsync."""
    folder = Path(job["folder"])
    simulation = SteppedScene(comm, Scene.model_validate(job["scene"]))
    recorder = Recorder(simulation)
    recorder.begin(folder)
    ours, raw, sizes = [], [], []
    for number in range(1, job["states"] + 1):
        simulation.step_number, simulation.time = number, number * simulation.control.step
        began = now(comm)
        recorder.write_state()
        recorder.flush()
        ours.append(now(comm) - began)
        run = StoredRun(folder)
        state = run.positions[number].nbytes + sum(run.field(name)[number].nbytes for name in run.fields)
        written = [state, (folder / "checkpoint.h5").stat().st_size]
        blocks = [os.urandom(size) for size in written] if comm.rank == 0 else []
        began = now(comm)
        for block in blocks:
            _write_plain(folder / f"plain-{number}-{len(block)}", block)
        raw.append(now(comm) - began)
        sizes.append(sum(written))
    recorder.close()
    return {
        "vertices": simulation.problem.whole.n_vertices,
        "bytes": statistics.median(sizes),
        "states_bytes_a_second": [size / seconds for size, seconds in zip(sizes, ours, strict=True)],
        "plain_bytes_a_second": [size / seconds for size, seconds in zip(sizes, raw, strict=True)],
    }


def _write_plain(path: Path, block: bytes) -> None:
    with path.open("wb") as file:
        file.write(block)
        file.flush()
        os.fsync(file.fileno())


KINDS = {"steps": steps, "meshes": meshes, "apart": apart, "output": output}


def main() -> None:
    """Run the job on all ranks; rank 0 writes the result, or prints the error."""
    comm = MPI.COMM_WORLD
    job = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    try:
        result = KINDS[job["kind"]](comm, job) | {"ranks": comm.size, "versions": library_versions()}
    except LyraError as error:
        if comm.rank == 0:
            print(f"lyra-petsc: {error}", file=sys.stderr, flush=True)
        sys.exit(error.exit_code)
    if comm.rank == 0:
        Path(sys.argv[2]).write_text(json.dumps(result), encoding="utf-8")


if __name__ == "__main__":
    try:
        main()
    except Exception:  # other ranks may be waiting
        import traceback

        traceback.print_exc()
        sys.stderr.flush()
        MPI.COMM_WORLD.Abort(1)
