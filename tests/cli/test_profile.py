"""``-log_view`` shows phases as stages and the assembly as events, with correct counts."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from launch import SCENE, done, environment, read_csv, write_scene
from patience import run_program

STAGE = re.compile(r"^ *\d+: +(mesh|partition|assembly|solve|balance|output): +\S+ +[\d.]+%", re.M)


def counts(log: str, name: str) -> list[int]:
    """Calls of an event in each stage in which it occurred (maximum over ranks)."""
    return [int(found) for found in re.findall(rf"^{name} +(\d+) 1\.0", log, re.M) if int(found)]


def column(folder: Path, name: str) -> list[int]:
    return [int(row[name]) for row in read_csv(folder / "history.csv")]


@pytest.mark.parametrize(
    ("integrator", "ranks"), [("beuler", 1), ("semi-implicit", 1), ("midpoint", 1), ("beuler", 2)]
)
def test_stages_and_events(tmp_path: Path, integrator: str, ranks: int) -> None:
    scene = write_scene(tmp_path, SCENE.replace("step: 0.01}", f"step: 0.01, integrator: {integrator}}}"))
    left = done(["run", scene, "--out", "out", "-log_view"], tmp_path, ranks)
    assert STAGE.findall(left.out) == ["mesh", "partition", "assembly", "solve", "balance", "output"]
    newton, rejected = column(tmp_path / "out", "newton_iterations"), column(tmp_path / "out", "rejected")
    steps = len(newton) - 1
    assert steps == 5
    assert sum(rejected) == 0
    assert sum(newton) == steps if integrator == "semi-implicit" else sum(newton) > steps
    assert counts(left.out, "AssembleJacobian") == [sum(newton)]
    assert counts(left.out, "AssembleFrozen") == [steps]
    (residuals,) = counts(left.out, "AssembleResidual")
    assert residuals >= sum(newton)
    assert counts(left.out, "AssembleAgain") == []
    assert "Event Stage" in left.out
    assert not re.search(r"Event Stage \d+: Unknown", left.out)


def test_compilation_is_an_event(tmp_path: Path) -> None:
    program = f"""
from pathlib import Path
from mpi4py import MPI
from petsc4py import PETSc
from lyra_petsc.kernels.cache import cached
from lyra_petsc.phases import COMPILE, STAGES, Phases
from lyra_petsc.scene.load import load_scene
from lyra_petsc.stepping.simulation import SteppedScene
PETSc.Log.begin()

@cached()
def inner(x):
    return x + 1.0

@cached()
def outer(x):
    return inner(x) * 2.0

phases = Phases()
simulation = SteppedScene(MPI.COMM_SELF, load_scene(Path({str(write_scene(tmp_path))!r}), []), phases)
stage = STAGES["solve"].id
before = COMPILE.getPerfInfo(stage)["count"], phases.seconds().get("compilation", 0.0)
with phases("solve"):
    outer(1.0)
    outer(2.0)
after = COMPILE.getPerfInfo(stage)["count"], phases.seconds()["compilation"]
print(after[0] - before[0], after[1] > before[1])
"""
    path = tmp_path / "program.py"
    path.write_text(program)
    process = run_program([sys.executable, path], env=environment(), seconds=100)
    # the kernel that is called is compiled within the other one
    assert process.stdout.split() == ["1", "True"], process.stderr


def test_stages_are_closed_after_exceptions(tmp_path: Path) -> None:
    program = """
from petsc4py import PETSc
from lyra_petsc.phases import Phases
from lyra_petsc.phases import STAGES, logged
PETSc.Log.begin()

@logged("Marker")
def mark(fails=False):
    if fails:
        raise ValueError

phases = Phases()
for outer, inner in (("solve", "output"), ("mesh", "mesh"), ("solve", "a further one")):
    try:
        with phases(outer):
            with phases(inner):
                mark(fails=True)
    except ValueError:
        pass
mark()
event = PETSc.Log.Event("Marker")
print([event.getPerfInfo(stage)["count"] for stage in (0, *(stage.id for stage in STAGES.values()))])
print(list(STAGES))
"""
    process = run_program([sys.executable, "-c", program], env=environment(), seconds=60)
    # once outside of all stages, once in each innermost stage
    assert process.stdout.splitlines() == [
        "[1, 1, 0, 0, 0, 0, 1, 1]",
        "['mesh', 'partition', 'assembly', 'solve', 'balance', 'output', 'a further one']",
    ], process.stderr
