"""Runs a case over its resolutions and judges it."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass, field

import numpy as np
from mpi4py import MPI

from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.verification.bench import Bench
from lyra_petsc.verification.case import Case, Measured
from lyra_petsc.verification.claims import Row, Verdict, observed_order


@dataclass
class Outcome:
    """What came of a case.

    Attributes
    ----------
    case : Case
    rows : list of Row
        By quantity, within a quantity from the coarsest on.
    verdicts : dict of quantity → Verdict
    seconds : float
        Wall time of the whole case.
    """

    case: Case
    rows: list[Row] = field(default_factory=list)
    verdicts: dict[str, Verdict] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether every claim holds."""
        return bool(self.verdicts) and all(verdict.passed for verdict in self.verdicts.values())

    def quantities(self) -> list[str]:
        """Names of the quantities, in the order in which they were measured."""
        return list(dict.fromkeys(row.quantity for row in self.rows))

    def rows_of(self, quantity: str) -> list[Row]:
        """Rows of one quantity."""
        return [row for row in self.rows if row.quantity == quantity]


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
                row = dataclasses.replace(row, order=observed_order(table[-1], row))
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
    began = time.perf_counter()
    rows: list[Row] = []
    problem = None
    measured: Iterable[Measured] = ()
    with Bench(comm, watch) as bench:
        bench.watch()
        try:
            measured = case.measure(bench, n)
            for one in measured:
                steps, seconds = bench.latest
                row = Row(
                    one.quantity, one.unit, n, case.size(n), one.value, one.exact, one.error,
                    steps=steps, wall_seconds=seconds,
                )  # fmt: skip
                rows.append(row)
        except (InputError, SolverError) as error:
            # what one rank alone met cannot be gone past: the others still wait for it
            if isinstance(error, SolverError) and not error.collective and comm.size > 1:
                raise
            problem = " ".join(str(error).split())
    if not isinstance(measured, Generator):
        whole = time.perf_counter() - began
        rows = [dataclasses.replace(row, steps=bench.steps, wall_seconds=whole) for row in rows]
    slowest = np.max(comm.allgather([row.wall_seconds for row in rows]), axis=0)
    rows = [
        dataclasses.replace(row, wall_seconds=float(seconds))
        for row, seconds in zip(rows, slowest, strict=True)
    ]
    if problem is not None:
        rows.append(Row("could not run", "", n, case.size(n), problem=problem))
    return rows
