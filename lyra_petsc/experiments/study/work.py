"""A study at work: runs what is not finished, compares all with the references."""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from mpi4py import MPI
from petsc4py import PETSc

import lyra_petsc
from lyra_petsc.errors import InputError
from lyra_petsc.experiments.study.analysis import Row, mark_unresolved
from lyra_petsc.experiments.study.case import RESULT_FILE, Job, Result, fingerprint, read_result
from lyra_petsc.experiments.study.combination import LEAN, Combination, scene_of
from lyra_petsc.experiments.study.folder import CASES
from lyra_petsc.experiments.study.measure import (
    Errors,
    Party,
    against_motion,
    against_run,
    history_against_run,
)
from lyra_petsc.experiments.study.plan import Plan
from lyra_petsc.experiments.study.reference import Chosen, Physics, physical_overrides, physics_of
from lyra_petsc.experiments.study.refine import (
    Estimate,
    Family,
    Level,
    integrators,
    joined,
    make_family,
    of_chain,
    refines_time,
)
from lyra_petsc.experiments.study.samples import read_samples
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.dump import dump_scene

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
        settings = {axis.path: combination.settings[axis.key] for axis in combination.axes}
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
        request, words = self.plan.request, tuple(v for v in combination.values if isinstance(v, str))
        overrides = (*request.settings, *LEAN, *self.plan.overrides(combination))
        level = Level(combination.name, combination.label, overrides, self._weight(combination))
        return self._case(level, request.repeats, ("combination", *words))

    def _case(self, level: Level, repeats: int, kind: tuple[object, ...]) -> Result:
        """The result of a run, which is made unless a finished one is found.

        ``kind`` names the runs that use the same kernels: the first of each begins with a step to warm up.
        """
        folder, label = self.folder / CASES / level.name, level.label

        def look() -> tuple[Job, Result | None, bool]:
            digest = self._fingerprint(level.overrides, repeats)
            request = self.plan.request
            overrides = tuple(level.overrides)
            job = Job(request.scene, overrides, str(folder), repeats, digest, request.trust_mesh)
            found = read_result(folder, digest)
            return job, found, found is None and (folder / RESULT_FILE).exists()

        looked = on_root(self.comm, look)
        assert looked is not None
        job, found, stale = looked
        self._observer.case(label, resumed=found is not None)
        if stale:
            self._observer.note(
                f"{label} was finished with another scene, program, options, repeats or ranks: it runs again"
            )
        if found is None:
            begun = self._done

            def watch(fraction: float) -> None:
                self._observer.progress(begun + level.weight * fraction, self._whole)

            found = self._run(job, watch, kind not in self._warm)
            self._warm.add(kind)
            if found.problem:
                self._observer.note(f"{label} failed: {found.problem}")
        else:
            self.reused += 1
        self._done += level.weight
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
        quantities, motion = self.plan.quantities, chosen.motion
        if motion is not None:
            found.own = {quantity.name: Estimate(ROUND_OFF, math.nan, True) for quantity in quantities}
            self._fill(rows, found, lambda party: against_motion(self.comm, party, motion, quantities))
            return found
        assert chosen.folder is not None
        other = self._party(chosen.folder, [])
        found.notes.append("the own error of the reference run is not known")
        self._fill(rows, found, lambda party: against_run(self.comm, party, other, quantities))
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
        party = self._of_level(physics, family.best)
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
            named = replace(level, name=name, label=f"reference: {level.label}")
            self._levels[name] = self._case(named, 1, ("reference",))
        return self._levels[name]

    def _level_name(self, name: str, physics: Physics) -> str:
        number = f"-{list(self.chosen).index(physics) + 1}" if len(self.chosen) > 1 else ""
        return name + number

    def _of_level(self, physics: Physics, level: Level) -> Party:
        name = self._level_name(level.name, physics)
        return self._party(self.folder / CASES / name, self._levels[name].sheets)

    def _party(self, folder: Path, sheets: Sequence[int]) -> Party:
        return Party(read_samples(self.comm, folder, self.plan.sample_times(), self.plan.every), sheets)

    def _own(self, physics: Physics, family: Family, known: Known) -> dict[str, Estimate]:
        """Own error of the reference from its chains."""
        estimates = []
        for chain in family.chains:
            results = [self._level(physics, level) for level in chain.levels]
            for level, result in zip(chain.levels, results, strict=True):
                if not result.done:
                    known.notes.append(f"the own error of the reference is not known: {level.label} failed")
                    return {}
            parties = [self._of_level(physics, level) for level in chain.levels]
            differences = [
                history_against_run(self.comm, coarse, fine, self.plan.quantities)
                for fine, coarse in itertools.pairwise(parties)
            ]
            estimates.append(of_chain(differences, chain))
        own = joined(estimates)
        doubtful = [name for name, estimate in own.items() if not estimate.trusted]
        if doubtful:
            known.notes.append(
                "the reference's runs do not converge towards each other as they should "
                f"({', '.join(doubtful)}): its own error is a guess from their largest difference"
            )
        return own

    def _fill(self, rows: Sequence[Row], known: Known, errors_of: Callable[[Party], Errors]) -> None:
        """Errors of the rows; one that misses a sample time has failed after all."""
        for row in rows:
            try:
                party = self._party(self.folder / CASES / row.combination.name, row.result.sheets)
            except InputError as error:
                row.result.fail(" ".join(str(error).split()))
                continue
            row.errors = errors_of(party)
            row.own = {name: estimate.error for name, estimate in known.own.items()}
            mark_unresolved(row)
