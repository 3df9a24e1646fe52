"""A whole study: runs, comparisons, and what it leaves in its folder."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from mpi4py import MPI

from lyra_petsc.experiments.study.advice import Advice, advise, choose_recommended
from lyra_petsc.experiments.study.analysis import Row, mark_front, observed_orders
from lyra_petsc.experiments.study.pages import main_axis, make_report
from lyra_petsc.experiments.study.reference import Physics, physics_of
from lyra_petsc.experiments.study.tables import content, write_csv
from lyra_petsc.experiments.study.work import Known, Work
from lyra_petsc.extras import PACKAGES
from lyra_petsc.output.summary import versions, write_summary
from lyra_petsc.parallel import on_root


@dataclass
class Outcome:
    """What came of a study.

    Attributes
    ----------
    rows : list of Row
    known : dict of physics → Known
        References as they came out.
    advice : dict of physics → list of Advice
    reused : int
        Cases that were found finished.
    """

    rows: list[Row]
    known: dict[Physics, Known]
    advice: dict[Physics, list[Advice]] = field(default_factory=dict)
    reused: int = 0

    @property
    def failed(self) -> list[Row]:
        """Rows without a result."""
        return [row for row in self.rows if not row.result.done]


def conduct(comm: MPI.Comm, work: Work, command: str) -> Outcome:
    """Run what is not finished, compare, and write tables, diagrams and reports; collective.

    Parameters
    ----------
    comm : MPI.Comm
    work : Work
    command : str
        That repeats the study.

    Raises
    ------
    OutputError
        On every rank, if something cannot be written.
    """
    plan, folder = work.plan, work.folder
    plan.notes += busy(plan.request.ranks or comm.size)
    rows = work.rows()
    known = work.compare(rows)
    outcome = Outcome(rows, known, reused=work.reused)
    main = plan.quantities[0].name
    for physics in known:
        mine = [row for row in rows if physics_of(row.combination) == physics]
        mark_front(mine, main)
        outcome.advice[physics] = advise(mine, main, main_axis(plan.axes))
        choose_recommended(outcome.advice[physics])
    orders = observed_orders(rows, plan.axes, [quantity.name for quantity in plan.quantities])
    facts: dict[str, Any] = {
        "scene": plan.request.scene,
        "title": plan.base.title,
        "command": command,
        "ranks": plan.request.ranks or comm.size,
        "machine": machine(),
        "versions": all_versions(),
    }
    on_root(comm, lambda: write_csv(folder, plan, rows))
    write_summary(folder / "study.json", content(plan, rows, known, orders, outcome.advice, facts), comm)

    def pages() -> None:
        make_report(plan, rows, known, orders, outcome.advice, facts).write(folder)

    on_root(comm, pages)
    return outcome


def all_versions() -> dict[str, str]:
    """Versions of the program and all that takes part."""
    found = versions()
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def busy(ranks: int) -> list[str]:
    """A note where other processes leave too few cores of this machine idle for so many ranks."""
    cores = os.cpu_count() or 1
    try:
        load = os.getloadavg()[0]
    except OSError:
        return []
    if load + ranks <= cores + 0.5:
        return []
    return [
        f"the machine was busy when this began (load {load:.1f} on {cores} cores): "
        "run times may be larger and spread more than on an idle one"
    ]


def machine() -> str:
    """Processor and cores, in words."""
    model = platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                model = line.split(":", 1)[1].strip()
                break
    except OSError:
        pass
    return f"{model}, {os.cpu_count() or 1} cores"
