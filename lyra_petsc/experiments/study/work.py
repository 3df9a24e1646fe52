"""A study at work: runs what is not finished, and compares it with the reference of its physical scene.

References are chosen on rank 0 before anything runs: an exact solution where there is one, else runs
finer than all that is studied, by a second-order integrator at a quarter of the smallest Δt, with solver
tolerances of a hundredth of the tightest. Where element sizes vary, half the smallest; and where nothing
of the time integration varies beside them, that stays as it is, so that the errors are those of the mesh.
Beside it stand coarser runs, each coarser in one thing by a factor of two from the next, from which its
own error is estimated (Richardson).
"""

from __future__ import annotations

import hashlib
import itertools
import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

import lyra_petsc
from lyra_petsc.errors import InputError
from lyra_petsc.experiments.exact_motions import SOLUTIONS, Body, ExactMotion, exact_motion, matching
from lyra_petsc.experiments.study.comparison import (
    Errors,
    History,
    RestSurface,
    Samples,
    against_motion,
    against_run,
    history_against_run,
    overall,
    read_here,
    read_samples,
    read_surface,
)
from lyra_petsc.experiments.study.jobs import CASES, RESULT_FILE, Job, Result, fingerprint, read_result
from lyra_petsc.experiments.study.plan import (
    LEAN,
    MEAN_SQUARE,
    Combination,
    Plan,
    Value,
    mesh_overrides,
    overrides,
    scene_of,
    time_overrides,
)
from lyra_petsc.mesh.build import mesh_of
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.schema import Scene
from lyra_petsc.show.report.document import seconds

Physics = tuple[tuple[str, Value], ...]
"""The settings that make a scene another one, in the axes' order."""

NUMERICAL_BLOCKS = {"time", "output", "solver", "petsc", "title", "probes"}
"""Keys in which the scene of a run to compare with may differ without a note."""


@dataclass(frozen=True)
class Estimate:
    """Own error of a reference in one quantity.

    Attributes
    ----------
    error : float
        Relative, as the errors measured against it.
    order : float
        Observed; NaN where two runs agree, or only two were made.
    trusted : bool
        Whether the runs converge.
    """

    error: float
    order: float
    trusted: bool


@dataclass
class Reference:
    """The reference of one physical scene, as chosen and as it came out.

    Attributes
    ----------
    kind : str
        ``exact``, ``run``, ``finer``, or in the end ``none``.
    words : str
        What it is; empty for ``finer`` until it is known which run it became.
    motion : ExactMotion or None
    folder : Path or None
    notes : list of str
    own : dict of str to Estimate
        Own error by quantity; empty where it is unknown.
    seconds : float
        Wall time [s] of its steps, where it was run here.
    """

    kind: str
    words: str = ""
    motion: ExactMotion | None = None
    folder: Path | None = None
    notes: list[str] = field(default_factory=list)
    own: dict[str, Estimate] = field(default_factory=dict)
    seconds: float = math.nan


def physics_of(combination: Combination) -> Physics:
    """Key of the physical scene that a combination belongs to."""
    return tuple(combination.physics.items())


def physical_overrides(plan: Plan, physics: Physics) -> list[str]:
    """What makes one physical scene of the study's scene, with what the whole study sets."""
    axes = [axis for axis in plan.axes if axis.physical]
    return [f"output.every={plan.every!r}", *overrides(plan.base, axes, [value for _, value in physics])]


def choose_references(plan: Plan) -> dict[Physics, Reference]:
    """The reference of every physical scene of a study. For rank 0.

    Raises
    ------
    InputError
        Unknown reference, an exact solution that does not hold, a run that does not fit.
    """
    text = plan.request.reference
    kind, colon, name = text.partition(":")
    key = f"--reference {text}"
    groups = list(dict.fromkeys(physics_of(combination) for combination in plan.combinations))
    if kind == "auto" and not colon:
        return {physics: _automatic(_scene(plan, physics)) for physics in groups}
    if kind == "exact" and name:
        found = {}
        for physics in groups:
            motion = exact_motion(name, Body(_scene(plan, physics)))
            found[physics] = Reference("exact", _exact_words(name), motion)
        return found
    if kind == "run" and name:
        if len(groups) > 1:
            listed = ", ".join(axis.key for axis in plan.axes if axis.physical)
            raise InputError(
                f"one run cannot be the reference of different scenes ({listed} varies)", key=key
            )
        return {groups[0]: _of_run(plan, Path(name), key)}
    raise InputError("must be auto, exact:NAME or run:DIR", key=key)


def _scene(plan: Plan, physics: Physics) -> Scene:
    return plan.request.with_changes(physical_overrides(plan, physics))


def _exact_words(name: str) -> str:
    return f"exact: {name} ({SOLUTIONS[name].title})"


def _automatic(scene: Scene) -> Reference:
    if scene.handles or scene.loads:
        return Reference("finer")  # no exact solution has any: the mesh need not be built to know
    body = Body(scene)
    solution = matching(body)
    if solution is None:
        return Reference("finer")
    return Reference("exact", _exact_words(solution.name), solution.motion(body))


def _of_run(plan: Plan, folder: Path, key: str) -> Reference:
    if not folder.is_dir():
        raise InputError("no such folder", file=folder, key=key)
    try:
        samples = read_here(folder, plan.sample_times(), plan.every)
        stored = read_surface(folder)
    except InputError as error:
        raise InputError(error.message, file=error.file, key=key) from None
    axis = plan.axis("mesh")
    for value in axis.values if axis is not None else [None]:
        further = overrides(plan.base, [axis], [value]) if axis is not None and value is not None else []
        scene = plan.request.with_changes(further)
        mesh = mesh_of(scene)
        built = RestSurface(mesh.rest, mesh.triangles, np.ones(mesh.n_vertices))
        if not built.same_as(stored):
            raise InputError(
                f"is a run of another mesh ({len(stored.rest)} vertices, {len(stored.triangles)} triangles; "
                f"the study's has {mesh.n_vertices} and {mesh.n_triangles}, or others)",
                file=folder,
                key=key,
            )
    lacking = [
        quantity.probe
        for quantity in plan.quantities
        if quantity.probe is not None and quantity.probe not in samples.probes
    ]
    if lacking and plan.request.quantities:
        raise InputError(f"has no probe '{lacking[0]}'", file=folder, key=key)
    notes = [f"the reference run has no probe '{name}': its error is not told" for name in lacking]
    return Reference("run", f"run {folder}", folder=folder, notes=[*notes, *_differences(plan, folder)])


def _differences(plan: Plan, folder: Path) -> Sequence[str]:
    """What the scene of a run has that the study's has not, beside how it was solved."""
    try:
        other = load_scene(folder / "scene.yaml")
    except InputError:
        return ["the reference run's scene cannot be read, so it is unknown whether it is the same"]
    keys = [
        name
        for name in type(plan.base).model_fields
        if name not in NUMERICAL_BLOCKS and getattr(plan.base, name) != getattr(other, name)
    ]
    return [f"the reference run is of another scene: {', '.join(keys)} differ"] if keys else []


FINER = 4
"""How many times smaller than the smallest Δt of the study the reference's is."""

SECOND_ORDER = ("bdf2", "alpha2", "midpoint")
TIGHTER = 100.0
TIGHTEST = {"force_tolerance": 1e-10, "step_tolerance": 1e-10}
TIMES = ("time.step", "time.integrator", "time.tolerance", "time.spectral_radius")

SAFETY = 2.0
"""An error below so many times the reference's own cannot be told from it."""

LARGEST_SAFETY = 1.25
"""Factor on the estimates of largest errors."""

SLOWEST = 0.5
"""Order of convergence below which an estimate is not trusted to follow it."""


@dataclass(frozen=True)
class ReferenceRun:
    """One run of the reference's family.

    Attributes
    ----------
    name : str
        The folder.
    label : str
        In words.
    overrides : tuple of str
    weight : float
        Its cost beside a run at the study's finest.
    """

    name: str
    label: str
    overrides: tuple[str, ...]
    weight: float = 1.0


@dataclass(frozen=True)
class Chain:
    """Runs that differ in one thing by factors of two, finest first.

    Attributes
    ----------
    levels : tuple of ReferenceRun
    order : int
        Expected; 0 where none is.
    """

    levels: tuple[ReferenceRun, ...]
    order: int


def make_family(plan: Plan, physics: Sequence[str], smallest: float | None, integrator: str) -> list[Chain]:
    """The runs of the reference of one physical scene; the first of all is the reference.

    The finest runs of the chains differ from each other only where meshes are refined too.

    Parameters
    ----------
    plan : Plan
    physics : sequence of str
        Overrides that make this scene, and what the whole study sets.
    smallest : float or None
        Smallest Δt [s] among the runs, where the time integration is refined.
    integrator : str
        With which it is.
    """
    common = [*physics, *_tolerances(plan, TIGHTER)]
    mesh = plan.axis("mesh")
    meshes: list[float | None] = [None]
    if mesh is not None:
        size = min(float(value) for value in mesh.values)
        meshes = [size / 2.0, size, 2.0 * size]
    if smallest is None or plan.static:
        smallest, integrator = None, ""
        fixed = [axis for axis in plan.axes if axis.path in TIMES and len(axis.values) == 1]
        common += overrides(plan.base, fixed, [axis.values[0] for axis in fixed])

    def chain(order: int, *sizes: tuple[float | None, float | None]) -> Chain:
        return Chain(tuple(_level(plan.base, common, h, step, integrator) for h, step in sizes), order)

    if smallest is None:
        if mesh is not None:
            return [chain(2, *((h, None) for h in meshes))]
        tolerances = (*physics, *_tolerances(plan, TIGHTER / 10.0))
        loose = ReferenceRun("reference-loose", "tolerances ten times larger", tolerances)
        return [Chain((*chain(0, (None, None)).levels, loose), 0)]
    finest = plan.every / (FINER * math.ceil(plan.every / smallest * (1.0 - 1e-9)))
    order = 2 if integrator in SECOND_ORDER else 1
    in_time = chain(order, *((meshes[len(meshes) // 2], factor * finest) for factor in (1.0, 2.0, 4.0)))
    return [in_time] if mesh is None else [chain(2, *((h, finest) for h in meshes)), in_time]


def refines_time(plan: Plan) -> bool:
    """Whether the reference integrates time more finely: always, but where meshes alone are compared."""
    if plan.static:
        return False
    varies = any(axis.path in TIMES and len(axis.values) > 1 for axis in plan.axes)
    return varies or plan.axis("mesh") is None


def integrators(plan: Plan) -> list[str]:
    """Those to try for the reference, in order."""
    # the scene's own first
    return [*sorted(SECOND_ORDER, key=lambda name: name != plan.base.time.integrator), "beuler"]


def _level(
    base: Scene, common: list[str], h: float | None, step: float | None, integrator: str
) -> ReferenceRun:
    further, words, name, weight = [], [], ["reference"], 1.0
    if step is not None:
        chosen: dict[str, Value] = {"time.step": step, "time.integrator": integrator}
        further += [f"time.integrator={integrator}", f"time.step={step!r}", *time_overrides(base, chosen)]
        words += [integrator, f"Δt {seconds(step, 6)}"]
        name += [integrator, f"dt{step:.6g}"]
        weight /= step
    if h is not None:
        further += mesh_overrides(base, h)
        words.append(f"h {h:g} m")
        name.append(f"h{h:.6g}")
        weight *= h**-2
    return ReferenceRun(
        "-".join(name), ", ".join(words) or "tightest tolerances", (*common, *further), weight
    )


def _tolerances(plan: Plan, tighter: float) -> list[str]:
    """Solver tolerances below the tightest of the study."""
    found = []
    for name, least in TIGHTEST.items():
        axis = plan.axis(f"solver.{name}")
        values = [float(v) for v in axis.values] if axis else [float(getattr(plan.base.solver, name))]
        found.append(f"solver.{name}={max(least, min(values) / tighter)!r}")
    for axis in plan.axes:
        if axis.path.startswith("petsc.") and axis.numeric and axis.path.endswith(("tol", "_atol")):
            least = min(float(value) for value in axis.values)
            found.append(f"{axis.path}={max(1e-13, least / tighter)!r}")
    return found


# -- its own error -------------------------------------------------------------------------------------


def richardson(first: float, second: float, ratio: float, order: int) -> Estimate:
    """Own error of the finest of three runs.

    Differences that fall faster than the order allows do so by chance, where errors of several causes cancel
    or the place of the largest error changes. The estimate is therefore never below what the coarser pair
    alone says at the expected order.

    Parameters
    ----------
    first, second : float
        Differences of the two finest runs, and of the finest but one from the third.
    ratio : float
        Factor by which each is coarser than the one before.
    order : int
        Expected; the observed one is used where it is smaller.
    """
    if math.isnan(first) or math.isnan(second):
        return Estimate(math.nan, math.nan, False)
    if first == second == 0.0:
        return Estimate(0.0, math.nan, True)
    observed = math.inf if first == 0.0 else -math.inf
    if first > 0.0 < second:
        observed = math.log(second / first) / math.log(ratio)
    used = min(float(order), max(observed, SLOWEST))
    trusted = observed >= SLOWEST
    largest = first if trusted else max(first, second)
    error = largest / (ratio**used - 1.0)
    if order > 0:
        error = max(error, second / ratio**order / (ratio**order - 1.0))
    return Estimate(error, observed, trusted)


def joined(estimates: Sequence[dict[str, Estimate]]) -> dict[str, Estimate]:
    """Sums of the errors in time and in space."""
    names = dict.fromkeys(name for estimate in estimates for name in estimate)
    found = {}
    for name in names:
        parts = [estimate[name] for estimate in estimates]
        found[name] = Estimate(
            math.fsum(part.error for part in parts),
            parts[0].order if len(parts) == 1 else math.nan,
            all(part.trusted for part in parts),
        )
    return found


def of_chain(differences: Sequence[History], chain: Chain, ratio: float = 2.0) -> dict[str, Estimate]:
    """Own error of a chain's finest run, by quantity.

    A largest error wanders over the sheet and in time, so that the differences of the largest ones tell
    nothing certain of its order: it is estimated at every sample by itself, and raised by the factor of
    safety of Roache's grid convergence index for three grids [1]_.

    Parameters
    ----------
    differences : sequence of History
        Between neighbours, finest first.

    References
    ----------
    .. [1] P. J. Roache, Verification and Validation in Computational Science and Engineering, 1998, ch. 5.
    """
    sums = [overall(history) for history in differences]
    found = {}
    for name, first in sums[0].items():
        if len(differences) == 1:
            found[name] = Estimate(first, math.nan, True)
            continue
        found[name] = whole = richardson(first, sums[1][name], ratio, chain.order)
        if name != MEAN_SQUARE and not math.isnan(whole.error):
            pairs = zip(differences[0][name], differences[1][name], strict=True)
            each = [
                richardson(float(fine), float(coarse), ratio, chain.order).error for fine, coarse in pairs
            ]
            found[name] = replace(whole, error=LARGEST_SAFETY * max(whole.error, *each))
    return found


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
class StudyRow:
    """A combination with what came of it.

    Attributes
    ----------
    combination : Combination
    result : Result
    errors : dict of str to float
        By quantity; NaN where nothing can be told.
    own : dict of str to float
        The reference's own error, NaN where it is unknown.
    unresolved : set of str
        Quantities whose error cannot be told from the reference's.
    orders : dict of (axis key, quantity) to float
        Observed, from the next coarser row that differs in that axis alone.
    on_front, recommended : bool
    """

    combination: Combination
    result: Result
    errors: dict[str, float] = field(default_factory=dict)
    own: dict[str, float] = field(default_factory=dict)
    unresolved: set[str] = field(default_factory=set)
    orders: dict[tuple[str, str], float] = field(default_factory=dict)
    on_front: bool = False
    recommended: bool = False

    @property
    def run(self) -> float:
        """Median wall time [s] of the steps alone; NaN for a failed row."""
        return statistics.median(self.result.run_seconds()) if self.result.timings else math.nan

    @property
    def total(self) -> float:
        """Median wall time [s] with set-up."""
        return statistics.median(self.result.total_seconds()) if self.result.timings else math.nan

    def shown(self, quantity: str) -> float:
        """The error as a number, NaN where it is not resolved."""
        return math.nan if quantity in self.unresolved else self.errors.get(quantity, math.nan)

    def at_most(self, quantity: str) -> float:
        """What the true error is at most, with the reference's own error; NaN where nothing is known."""
        own = self.own.get(quantity, 0.0)
        own = 0.0 if math.isnan(own) else own
        if quantity in self.unresolved:
            return (SAFETY + 1.0) * own
        return self.errors.get(quantity, math.nan) + own

    @property
    def line(self) -> str:
        """What its line in a diagram is called: its integrator."""
        return self.result.integrator or str(self.combination.settings.get("integrator", ""))


def mark_unresolved(row: StudyRow) -> None:
    """Note the quantities whose error is below the reference's own, with a margin."""
    for name, error in row.errors.items():
        own = row.own.get(name, 0.0)
        if not math.isnan(error) and not math.isnan(own) and own > 0.0 and error < SAFETY * own:
            row.unresolved.add(name)


class Work:
    """Runs and comparisons of a study; every method is collective.

    Parameters
    ----------
    comm : MPI.Comm
    plan : Plan
    chosen : dict of physics → Reference
    folder : Path
    run : callable
        How a job is run, see `Runner`.
    observer : Observer
    """

    def __init__(
        self,
        comm: MPI.Comm,
        plan: Plan,
        chosen: dict[Physics, Reference],
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
        weights = {level.name: level.weight for chain in family for level in chain.levels}
        return sum(weights.values())

    # -- runs --------------------------------------------------------------------------------------------

    def rows(self) -> list[StudyRow]:
        """Run every combination that is not finished."""
        return [
            StudyRow(combination, self._combination(combination)) for combination in self.plan.combinations
        ]

    def _combination(self, combination: Combination) -> Result:
        request, words = self.plan.request, tuple(v for v in combination.values if isinstance(v, str))
        overrides = (*request.settings, *LEAN, *self.plan.overrides(combination))
        level = ReferenceRun(combination.name, combination.label, overrides, self._weight(combination))
        return self._case(level, request.repeats, ("combination", *words))

    def _case(self, level: ReferenceRun, repeats: int, kind: tuple[object, ...]) -> Result:
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
        meshes = [hashlib.sha256(file.read_bytes()).hexdigest() for file in scene.mesh_files.values()]
        options = [f"{name}={value}" for name, value in sorted(PETSc.Options().getAll().items())]
        ranks = str(self.plan.request.ranks or self.comm.size)
        return fingerprint(dump_scene(scene), meshes, options, str(repeats), ranks, lyra_petsc.__version__)

    # -- comparisons -------------------------------------------------------------------------------------

    def compare(self, rows: Sequence[StudyRow]) -> dict[Physics, Reference]:
        """Errors of all rows that ran; the references behind them, which are run where needed."""
        known: dict[Physics, Reference] = {}
        for physics, chosen in self.chosen.items():
            group = [row for row in rows if physics_of(row.combination) == physics]
            able = [row for row in group if row.result.done]
            if not able:
                known[physics] = Reference("none", "no reference: no combination ran to its end")
            elif chosen.kind == "finer":
                known[physics] = self._against_finer(physics, able)
            else:
                known[physics] = self._against_given(chosen, able)
        return known

    def _against_given(self, found: Reference, rows: Sequence[StudyRow]) -> Reference:
        quantities, motion = self.plan.quantities, found.motion
        if motion is not None:
            found.own = {quantity.name: Estimate(ROUND_OFF, math.nan, True) for quantity in quantities}
            self._fill(rows, found, lambda mine: against_motion(self.comm, mine, motion, quantities))
            return found
        assert found.folder is not None
        other = self._samples(found.folder)
        found.notes.append("the own error of the reference run is not known")
        self._fill(rows, found, lambda mine: against_run(self.comm, mine, other, quantities))
        return found

    def _against_finer(self, physics: Physics, rows: Sequence[StudyRow]) -> Reference:
        smallest = self._smallest(rows)
        notes = []
        for integrator in integrators(self.plan) if smallest is not None else [""]:
            family = self._family(physics, smallest, integrator)
            finest = family[0].levels[0]
            best = self._level(physics, finest)
            if best.done:
                break
            notes.append(f"a reference with {finest.label} failed: {best.problem}")
        else:
            return Reference("none", "no reference: every attempt at one failed", notes=notes)
        found = Reference("finer", f"finer run: {finest.label}", notes=notes)
        found.seconds = best.timings[0].run
        other = self._of_level(physics, finest)
        found.own = self._own(physics, family, found)
        self._fill(rows, found, lambda mine: against_run(self.comm, mine, other, self.plan.quantities))
        return found

    def _family(self, physics: Physics, smallest: float | None, integrator: str) -> list[Chain]:
        given = [*self.plan.request.settings, *LEAN, *physical_overrides(self.plan, physics)]
        return make_family(self.plan, given, smallest, integrator)

    def _smallest(self, rows: Sequence[StudyRow]) -> float | None:
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

    def _level(self, physics: Physics, level: ReferenceRun) -> Result:
        name = self._level_name(level.name, physics)
        if name not in self._levels:
            named = replace(level, name=name, label=f"reference: {level.label}")
            self._levels[name] = self._case(named, 1, ("reference",))
        return self._levels[name]

    def _level_name(self, name: str, physics: Physics) -> str:
        number = f"-{list(self.chosen).index(physics) + 1}" if len(self.chosen) > 1 else ""
        return name + number

    def _of_level(self, physics: Physics, level: ReferenceRun) -> Samples:
        name = self._level_name(level.name, physics)
        return self._samples(self.folder / CASES / name, self._levels[name].sheets)

    def _samples(self, folder: Path, sheets: Sequence[int] = ()) -> Samples:
        return read_samples(self.comm, folder, self.plan.sample_times(), self.plan.every, sheets)

    def _own(self, physics: Physics, family: list[Chain], known: Reference) -> dict[str, Estimate]:
        """Own error of the reference from its chains."""
        estimates = []
        for chain in family:
            results = [self._level(physics, level) for level in chain.levels]
            for level, result in zip(chain.levels, results, strict=True):
                if not result.done:
                    known.notes.append(f"the own error of the reference is not known: {level.label} failed")
                    return {}
            samples = [self._of_level(physics, level) for level in chain.levels]
            differences = [
                history_against_run(self.comm, coarse, fine, self.plan.quantities)
                for fine, coarse in itertools.pairwise(samples)
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

    def _fill(
        self, rows: Sequence[StudyRow], known: Reference, errors_of: Callable[[Samples], Errors]
    ) -> None:
        """Errors of the rows; one that misses a sample time has failed after all."""
        for row in rows:
            try:
                mine = self._samples(self.folder / CASES / row.combination.name, row.result.sheets)
            except InputError as error:
                row.result.fail(" ".join(str(error).split()))
                continue
            row.errors = errors_of(mine)
            row.own = {name: estimate.error for name, estimate in known.own.items()}
            mark_unresolved(row)
