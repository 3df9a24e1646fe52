"""Runs a case over its resolutions and judges it."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass, field

import numpy as np
from mpi4py import MPI

from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.experiments import case as experiments
from lyra_petsc.experiments.bench import Bench, problem_of
from lyra_petsc.experiments.case import Verdict
from lyra_petsc.experiments.verification.case import Case, Measured
from lyra_petsc.experiments.verification.claims import Row, observed_order


@dataclass
class Outcome(experiments.Outcome[Case]):
    """What came of a case; its verdicts are by quantity.

    Attributes
    ----------
    rows : list of Row
        By quantity, within a quantity from the coarsest on.
    """

    rows: list[Row] = field(default_factory=list)

    def tables(self) -> dict[str, list[Row]]:
        """The rows of each quantity, in the order in which they were measured."""
        found: dict[str, list[Row]] = {}
        for row in self.rows:
            found.setdefault(row.quantity, []).append(row)
        return found


def run_case(
    comm: MPI.Comm,
    case: Case,
    *,
    quick: bool = False,
    warm: bool = True,
    watch: Callable[[], None] | None = None,
) -> Outcome:
    """Measure a case at its resolutions and judge it; collective, the same outcome on all ranks.

    Parameters
    ----------
    comm : MPI.Comm
    case : Case
    quick : bool
        Only the coarsest resolutions.
    warm : bool
        Measure the coarsest once before the clock runs, so that no compilation is counted.
    watch : callable, optional
        Called before every step on all ranks; may raise to end the work.
    """
    began = time.perf_counter()
    resolutions = list(case.resolutions)[: case.quick] if quick else list(case.resolutions)
    if warm and len(resolutions) > 1:
        _rows_at(comm, watch, case, resolutions[0])
    tables: dict[str, list[Row]] = {}
    problems: list[Row] = []
    for n in resolutions:
        for row in _rows_at(comm, watch, case, n):
            if row.problem:
                problems.append(row)
                continue
            table = tables.setdefault(row.quantity, [])
            if table and case.claim_of(row.quantity).has_order:
                row.order = observed_order(table[-1], row)
            table.append(row)
    outcome = Outcome(case)
    for quantity, table in tables.items():
        outcome.rows += table
        outcome.verdicts[quantity] = case.claim_of(quantity).judge(table, case.size(case.resolutions[-1]))
    if problems:
        outcome.rows += problems
        outcome.verdicts[problems[0].quantity] = Verdict(
            False, "; ".join(f"n = {row.n:g} could not run: {row.problem}" for row in problems)
        )
    outcome.seconds = time.perf_counter() - began
    return outcome


def _rows_at(comm: MPI.Comm, watch: Callable[[], None] | None, case: Case, n: float) -> list[Row]:
    """The rows of one resolution, and one that says why where it cannot run to its end."""
    comm.Barrier()
    began, h = time.perf_counter(), case.size(n)
    rows: list[Row] = []
    problem = ""
    measured: Iterable[Measured] = ()
    with Bench(comm, watch) as bench:
        bench.watch()
        try:
            measured = case.measure(bench, n)
            for one in measured:
                row = Row(one.quantity, one.unit, n, h, one.value, one.exact, one.error)
                row.steps, row.wall_seconds = bench.latest
                rows.append(row)
        except (InputError, SolverError) as error:
            problem = problem_of(comm, error)
    if not isinstance(measured, Generator):
        whole = time.perf_counter() - began
        for row in rows:
            row.steps, row.wall_seconds = bench.steps, whole
    slowest = np.max(comm.allgather([row.wall_seconds for row in rows]), axis=0)
    for row, seconds in zip(rows, slowest, strict=True):
        row.wall_seconds = float(seconds)
    if problem:
        rows.append(Row("could not run", "", n, h, problem=problem))
    return rows
