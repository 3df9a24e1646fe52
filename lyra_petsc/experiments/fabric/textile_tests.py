"""The tests by name, and how one is run."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from mpi4py import MPI

from lyra_petsc.errors import InputError, SolverError, nearest
from lyra_petsc.experiments.bench import Bench, problem_of
from lyra_petsc.experiments.case import Launcher, Watch
from lyra_petsc.experiments.fabric.records import FabricCase, FabricOutcome, Record, outcome_of, restore
from lyra_petsc.experiments.fabric.specimens import Fabric

Measure = Callable[[Bench, Fabric, float], Record]

DIRECTIONS = {"warp": 0.0, "weft": 90.0}


@dataclass(frozen=True)
class TextileTest:
    """A test.

    Attributes
    ----------
    title : str
    module : str
        Of its function.
    both : bool
        Warp and weft have one each.
    exact : bool
        By a direct solver.
    """

    title: str
    module: str
    both: bool = True
    exact: bool = True


TESTS = {
    "tensile": TextileTest("KES-F 1, 20 cm × 5 cm pulled to 500 gf/cm", "strips"),
    "shear": TextileTest("KES-F 1, 20 cm × 5 cm sheared to ±8°", "strips", both=False),
    "bending": TextileTest("KES-F 2, 1 cm bent to ±2.5 cm⁻¹", "strips"),
    "cantilever": TextileTest("ASTM D1388, overhang at 41.5°", "strips"),
    "loop": TextileTest("Peirce's heart loop", "strips"),
    "cusick": TextileTest("BS 5058, 30 cm on a disc of 18 cm", "cusick", both=False, exact=False),
}
ALL = "all"


def cases_of(test: str) -> list[FabricCase]:
    """The cases of a test, or of all.

    Raises
    ------
    InputError
        For a test that there is not.
    """
    if test != ALL and test not in TESTS:
        raise InputError(f"unknown test, {nearest(test, [*TESTS, ALL])}", key=test)
    found = []
    for name in TESTS if test == ALL else [test]:
        each = TESTS[name]
        if not each.both:
            found.append(FabricCase(name, each.title, name, 0.0))
            continue
        found += [
            FabricCase(f"{name}-{way}", f"{each.title}, {way}", name, a) for way, a in DIRECTIONS.items()
        ]
    return found


def run_case(comm: MPI.Comm, case: FabricCase, fabric: Fabric, watch: Watch) -> FabricOutcome:
    """Run a test; collective, the same outcome on all ranks."""
    began, test = time.perf_counter(), TESTS[case.test]
    measure: Measure = getattr(import_module(f"lyra_petsc.experiments.fabric.{test.module}"), case.test)
    with Bench(comm, watch, exact=test.exact) as bench:
        bench.watch()
        try:
            record = measure(bench, fabric, case.degrees)
        except SolverError as error:
            record = Record(stopped=problem_of(comm, error))
    record.seconds = comm.bcast(time.perf_counter() - began)
    return outcome_of(case, record)


def launched(launcher: Launcher, case: FabricCase, asked: Sequence[str], watch: Watch) -> FabricOutcome:
    """Run a test in processes of its own; ``asked`` are the material and options.

    Raises
    ------
    InputError
        If the launched program refuses what it was asked for.
    """
    with tempfile.TemporaryDirectory(prefix="lyra-fabric-") as folder:
        code, words = launcher([case.test, *asked, "--only", case.name, "--job", folder], watch)
        outcome = restore(Path(folder), case)
    if outcome is None:
        if code == InputError.exit_code:
            raise InputError(words)
        outcome = outcome_of(case, Record(stopped=words))
    return outcome
