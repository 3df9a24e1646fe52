"""A study at work: runs what is not finished, compares all with the references."""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from mpi4py import MPI
from petsc4py import PETSc

import lyra_petsc
from lyra_petsc.errors import InputError
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.study.analysis import Row, mark_unresolved
from lyra_petsc.study.case import RESULT_FILE, Job, Result, fingerprint, read_result
from lyra_petsc.study.combination import LEAN, Combination, scene_of
from lyra_petsc.study.folder import CASES
from lyra_petsc.study.measure import Errors, Party, against_motion, against_run
from lyra_petsc.study.plan import Plan
from lyra_petsc.study.reference import Chosen, Physics, physical_overrides, physics_of
from lyra_petsc.study.refine import (
    Chain,
    Estimate,
    Family,
    Level,
    integrators,
    joined,
    make_family,
    of_chain,
    refines_time,
)
from lyra_petsc.study.samples import read_samples

ROUND_OFF = 1e-13
"""Own error of an exact reference."""

AUTO_STEPS = 200.0
"""Steps that a run with automatic ones is guessed to take, for the time left."""

Runner = Callable[[Job, Callable[[float], None], bool], Result]
"""Runs a job: (job, watch, warm) → result; collective."""


class Observer(Protocol):
    """Who wants to know how far a study is, and may end it."""

    def case(self, label: str, *, resumed: bool) -> None:
        """A case begins, or was found finished."""

    def progress(self, done: float, whole: float) -> None:
        """Work done and in all, in the same unit; called after every step on all ranks, may raise."""

    def note(self, text: str) -> None:
        """Something the user should know."""


@dataclass
class Known:
    """A reference as it came out.

    Attributes
    ----------
    kind : str
        ``exact``, ``run``, ``finer`` or ``none``.
    words : str
    own : dict of str to Estimate
        Own error by quantity; empty where it is unknown.
    seconds : float
        Wall time [s] of its steps, where it was run here.
    notes : list of str
    """

    kind: str
    words: str
    own: dict[str, Estimate] = field(default_factory=dict)
    seconds: float = math.nan
    notes: list[str] = field(default_factory=list)


class Work:
    """Runs and comparisons of a study; every method is collective.

    Parameters
    ----------
    comm : MPI.Comm
    plan : Plan
    chosen : dict of physics → Chosen
    folder : Path
    run : callable
        How a job is run, see `Runner`.
    observer : Observer
    """

    def __init__(
        self,
        comm: MPI.Comm,
        plan: Plan,
        chosen: dict[Physics, Chosen],
        folder: Path,
        run: Runner,
        observer: Observer,
    ) -> None:
        self.comm, self.plan, self.chosen, self.folder = comm, plan, chosen, folder
        self._run, self._observer = run, observer
        self._warm: set[tuple[object, ...]] = set()
        self._levels: dict[str, Result] = {}
        self._done = 0.0
        self._whole = sum(self._weight(combination) for combination in plan.combinations)
        self._whole += sum(self._guessed(physics) for physics in chosen)
        self.reused = 0

    # -- how much work there is --------------------------------------------------------------------------

    def _weight(self, combination: Combination) -> float:
        """Cost of a combination: repeats × steps × vertices, in a unit that the reference shares."""
        settings = {
            axis.path: value for axis, value in zip(combination.axes, combination.values, strict=True)
        }
        step = settings.get("time.step", self.plan.base.time.step)
        if not isinstance(step, int | float) or "time.tolerance" in settings:
            step = self.plan.end / AUTO_STEPS
        size = settings.get("mesh")
        return self.plan.request.repeats / float(step) / (float(size) ** 2 if size is not None else 1.0)

    def _guessed(self, physics: Physics) -> float:
        if self.chosen[physics].kind != "finer":
            return 0.0
        family = self._family(physics, self._smallest([]), integrators(self.plan)[0])
        return sum(level.weight for level in family.levels)

    # -- runs --------------------------------------------------------------------------------------------

    def rows(self) -> list[Row]:
        """Run every combination that is not finished."""
        return [Row(combination, self._combination(combination)) for combination in self.plan.combinations]

    def _combination(self, combination: Combination) -> Result:
        words = tuple(v for v in combination.values if isinstance(v, str))
        overrides = (*self.plan.request.settings, *LEAN, *self.plan.overrides(combination))
        return self._case(
            combination.name,
            combination.label,
            overrides,
            self.plan.request.repeats,
            self._weight(combination),
            ("combination", *words),
        )

    def _case(
        self,
        name: str,
        label: str,
        overrides: Sequence[str],
        repeats: int,
        weight: float,
        kind: tuple[object, ...],
    ) -> Result:
        folder = self.folder / CASES / name
        job = on_root(
            self.comm,
            lambda: Job(
                self.plan.request.scene,
                tuple(overrides),
                str(folder),
                repeats,
                self._fingerprint(overrides, repeats),
            ),
        )
        assert job is not None
        found = on_root(self.comm, lambda: read_result(folder, job.fingerprint))
        stale = on_root(self.comm, lambda: found is None and (folder / RESULT_FILE).exists())
        self._observer.case(label, resumed=found is not None)
        if found is None:
            if stale:
                self._observer.note(
                    f"{label} was finished with another scene, program, options, repeats or ranks: "
                    "it runs again"
                )
            begun = self._done

            def watch(fraction: float) -> None:
                self._observer.progress(begun + weight * fraction, self._whole)

            found = self._run(job, watch, kind not in self._warm)
            self._warm.add(kind)
        else:
            self.reused += 1
            self._done += weight
            self._observer.progress(self._done, self._whole)
            return found
        if found.problem:
            self._observer.note(f"{label} failed: {found.problem}")
        self._done += weight
        self._observer.progress(self._done, self._whole)
        return found

    def _fingerprint(self, overrides: Sequence[str], repeats: int) -> str:
        """Of the scene as understood, its mesh files, the PETSc options, ranks and program."""
        path = Path(self.plan.request.scene)
        try:
            scene = scene_of(path, (), overrides)
        except InputError as error:
            return fingerprint(str(error), overrides)
        meshes = [
            hashlib.sha256(source.file.read_bytes()).hexdigest() for source in scene.mesh if source.file
        ]
        options = [f"{name}={value}" for name, value in sorted(PETSc.Options().getAll().items())]
        ranks = str(self.plan.request.ranks or self.comm.size)
        return fingerprint(dump_scene(scene), meshes, options, str(repeats), ranks, lyra_petsc.__version__)

    # -- comparisons -------------------------------------------------------------------------------------

    def compare(self, rows: Sequence[Row]) -> dict[Physics, Known]:
        """Errors of all rows that ran; the references behind them, which are run where needed."""
        known: dict[Physics, Known] = {}
        for physics, chosen in self.chosen.items():
            group = [row for row in rows if physics_of(row.combination) == physics]
            able = [row for row in group if row.result.done]
            if not able:
                known[physics] = Known("none", "no reference: no combination ran to its end")
            elif chosen.kind == "finer":
                known[physics] = self._against_finer(physics, able)
            else:
                known[physics] = self._against_given(chosen, able)
        return known

    def _against_given(self, chosen: Chosen, rows: Sequence[Row]) -> Known:
        found = Known(chosen.kind, chosen.words, notes=list(chosen.notes))
        names = [quantity.name for quantity in self.plan.quantities]
        if chosen.motion is not None:
            found.own = {name: Estimate(ROUND_OFF, math.nan, True) for name in names}
            motion = chosen.motion
            self._fill(
                rows, found, lambda party: against_motion(self.comm, party, motion, self.plan.quantities)
            )
            return found
        assert chosen.folder is not None
        other = Party(read_samples(self.comm, chosen.folder, self.plan.sample_times(), self.plan.every), [])
        found.notes.append("the own error of the reference run is not known")
        self._fill(rows, found, lambda party: against_run(self.comm, party, other, self.plan.quantities))
        return found

    def _against_finer(self, physics: Physics, rows: Sequence[Row]) -> Known:
        smallest = self._smallest(rows)
        notes = []
        for integrator in integrators(self.plan) if smallest is not None else [""]:
            family = self._family(physics, smallest, integrator)
            best = self._level(physics, family.best)
            if best.done:
                break
            notes.append(f"a reference with {family.best.label} failed: {best.problem}")
        else:
            return Known("none", "no reference: every attempt at one failed", notes=notes)
        found = Known("finer", f"finer run: {family.best.label}", notes=notes)
        found.seconds = best.timings[0].run
        party = self._party(family.best.name, physics, best)
        found.own = self._own(physics, family, found)
        self._fill(rows, found, lambda mine: against_run(self.comm, mine, party, self.plan.quantities))
        return found

    def _family(self, physics: Physics, smallest: float | None, integrator: str) -> Family:
        given = [*self.plan.request.settings, *LEAN, *physical_overrides(self.plan, physics)]
        return make_family(self.plan, given, smallest, integrator)

    def _smallest(self, rows: Sequence[Row]) -> float | None:
        """Smallest Δt [s] that is asked for, or that automatic steps took on average."""
        if not refines_time(self.plan):
            return None
        axis = self.plan.axis("time.step")
        steps = [float(value) for value in axis.values] if axis is not None else []
        steps += [row.result.mean_step for row in rows if row.result.mean_step > 0.0]
        if not steps:
            base = self.plan.base.time.step
            steps = [float(base) if isinstance(base, int | float) else self.plan.end / AUTO_STEPS]
        return min(steps)

    def _level(self, physics: Physics, level: Level) -> Result:
        name = self._level_name(level.name, physics)
        if name not in self._levels:
            label = f"reference: {level.label}"
            self._levels[name] = self._case(name, label, level.overrides, 1, level.weight, ("reference",))
        return self._levels[name]

    def _level_name(self, name: str, physics: Physics) -> str:
        if len(self.chosen) == 1:
            return name
        return f"{name}-{list(self.chosen).index(physics) + 1}"

    def _party(self, name: str, physics: Physics | None, result: Result) -> Party:
        folder = self.folder / CASES / (name if physics is None else self._level_name(name, physics))
        samples = read_samples(self.comm, folder, self.plan.sample_times(), self.plan.every)
        return Party(samples, result.sheets)

    def _own(self, physics: Physics, family: Family, known: Known) -> dict[str, Estimate]:
        """Own error of the reference from its chains."""
        estimates = []
        for chain in family.chains:
            results = [self._level(physics, level) for level in chain.levels]
            failed = [
                level.label for level, result in zip(chain.levels, results, strict=True) if not result.done
            ]
            if failed:
                known.notes.append(f"the own error of the reference is not known: {failed[0]} failed")
                return {}
            estimates.append(self._of_chain(physics, chain, results))
        own = joined(estimates)
        doubtful = [name for name, estimate in own.items() if not estimate.trusted]
        if doubtful:
            known.notes.append(
                "the reference's runs do not converge towards each other as they should "
                f"({', '.join(doubtful)}): its own error is a guess from their largest difference"
            )
        return own

    def _of_chain(self, physics: Physics, chain: Chain, results: Sequence[Result]) -> dict[str, Estimate]:
        parties = [
            self._party(level.name, physics, result)
            for level, result in zip(chain.levels, results, strict=True)
        ]
        differences: list[Errors] = [
            against_run(self.comm, coarse, fine, self.plan.quantities)
            for fine, coarse in itertools.pairwise(parties)
        ]
        return of_chain(differences, chain)

    def _fill(self, rows: Sequence[Row], known: Known, errors_of: Callable[[Party], Errors]) -> None:
        """Errors of the rows; one that misses a sample time has failed after all."""
        for row in rows:
            try:
                party = self._party(row.combination.name, None, row.result)
            except InputError as error:
                row.result.problem = " ".join(str(error).split())
                row.result.timings = []
                continue
            row.errors = errors_of(party)
            row.own = {name: estimate.error for name, estimate in known.own.items()}
            mark_unresolved(row)
