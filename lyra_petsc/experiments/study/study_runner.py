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
import json
import math
import statistics
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

import lyra_petsc
from lyra_petsc.errors import InputError
from lyra_petsc.experiments.case import Launcher, Outcome, Verdict
from lyra_petsc.experiments.exact_motions import SOLUTIONS, Body, ExactMotion, exact_motion, matching
from lyra_petsc.experiments.study import comparison
from lyra_petsc.experiments.study.comparison import Errors, History, RestSurface, Samples
from lyra_petsc.experiments.study.jobs import CASES, RESULT_FILE, Job, Result, launched, read_result, run_case
from lyra_petsc.experiments.study.plan import (
    AUTO_STEPS,
    MEAN_SQUARE,
    Axis,
    Combination,
    Physics,
    Plan,
    StudyCase,
    Value,
    in_words,
    overrides,
    scene_of,
)
from lyra_petsc.mesh.build import build_scene_mesh
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.schema import Scene

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
    """The reference of one physical scene: how it was chosen, and its results.

    Attributes
    ----------
    kind : str
        ``exact``, ``run``, ``finer``, or in the end ``none``.
    words : str
        What it is; empty for ``finer`` until it is known which run it became.
    motion : ExactMotion or None
    folder : Path or None
        Of the run.
    sheets : sequence of int
        Vertices of each of its mesh sources; needed between different meshes.
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
    sheets: Sequence[int] = ()
    notes: list[str] = field(default_factory=list)
    own: dict[str, Estimate] = field(default_factory=dict)
    seconds: float = math.nan


def physical_overrides(plan: Plan, physics: Physics) -> tuple[str, ...]:
    """What makes one physical scene of the scene file, with what the whole study sets."""
    values = dict(physics)
    return plan.overrides([(axis, values[axis.key]) for axis in plan.axes if axis.physical])


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
    groups = list(dict.fromkeys(combination.physics for combination in plan.combinations))

    def scene(physics: Physics) -> Scene:
        return plan.scene(StudyCase("", "", physical_overrides(plan, physics)))

    if kind == "auto" and not colon:
        return {physics: _automatic(scene(physics)) for physics in groups}
    if kind == "exact" and name:
        return {physics: _exact(name, exact_motion(name, Body(scene(physics)))) for physics in groups}
    if kind == "run" and name:
        if len(groups) > 1:
            listed = ", ".join(axis.key for axis in plan.axes if axis.physical)
            raise InputError(
                f"one run cannot be the reference of different scenes ({listed} varies)", key=key
            )
        return {groups[0]: _of_run(plan, Path(name), key)}
    raise InputError("must be auto, exact:NAME or run:DIR", key=key)


def _exact(name: str, motion: ExactMotion) -> Reference:
    return Reference("exact", f"exact: {name} ({SOLUTIONS[name].title})", motion)


def _automatic(scene: Scene) -> Reference:
    if scene.handles or scene.loads:
        return Reference("finer")  # no exact solution has any: the mesh need not be built to know
    body = Body(scene)
    solution = matching(body)
    return Reference("finer") if solution is None else _exact(solution.name, solution.motion(body))


def _of_run(plan: Plan, folder: Path, key: str) -> Reference:
    if not folder.is_dir():
        raise InputError("no such folder", file=folder, key=key)
    try:
        samples = comparison.read_here(folder, plan.sample_times(), plan.every)
        stored = comparison.read_surface(folder)
    except InputError as error:
        raise InputError(error.message, file=error.file, key=key) from None
    axis = plan.axis("mesh")
    for chosen in [[(axis, value)] for value in axis.values] if axis is not None else [[]]:
        mesh = build_scene_mesh(plan.request.with_changes(overrides(plan.base, chosen)))
        built = RestSurface(mesh.rest, mesh.triangles, np.ones(mesh.n_vertices))
        if not built.same_as(stored):
            raise InputError(
                f"is a run of another mesh ({len(stored.rest)} vertices, {len(stored.triangles)} triangles; "
                f"the study's has {mesh.n_vertices} and {mesh.n_triangles}, or others)",
                file=folder,
                key=key,
            )
    lacking = [each.probe for each in plan.quantities if each.probe and each.probe not in samples.probes]
    if lacking and plan.request.quantities:
        raise InputError(f"has no probe '{lacking[0]}'", file=folder, key=key)
    notes = [f"the reference run has no probe '{name}': its error is not told" for name in lacking]
    return Reference("run", f"run {folder}", folder=folder, notes=[*notes, *_differences(plan, folder)])


def _differences(plan: Plan, folder: Path) -> Sequence[str]:
    """How the scene of a run differs physically from the study's, in words."""
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

REFINED = 2.0
"""Factor between neighbours of a chain."""

SLOWEST = 0.5
"""Order of convergence below which an estimate is not trusted to follow it."""


@dataclass(frozen=True)
class Chain:
    """Runs that differ in one thing by factors of two, finest first.

    Attributes
    ----------
    levels : tuple of StudyCase
    order : int
        Expected; 0 where none is.
    """

    levels: tuple[StudyCase, ...]
    order: int


def make_family(
    plan: Plan, physics: Sequence[str], smallest: float | None, integrator: str, number: str = ""
) -> list[Chain]:
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
    number : str
        What the names end with, where there are several such families.
    """
    common = [*physics, *_tolerances(plan, TIGHTER)]
    mesh = plan.axis("mesh")
    meshes: list[float | None] = [None]
    if mesh is not None:
        size = min(map(float, mesh.values))
        meshes = [size / 2.0, size, 2.0 * size]
    if smallest is None or plan.base.time.static:
        smallest, integrator = None, ""
        fixed = [axis for axis in plan.axes if axis.path in TIMES and len(axis.values) == 1]
        common += overrides(plan.base, [(axis, axis.values[0]) for axis in fixed])

    def level(h: float | None, step: float | None) -> StudyCase:
        chosen: list[tuple[Axis, Value]] = []
        if step is not None:
            chosen += [(Axis("integrator", "time.integrator"), integrator), (Axis("dt", "time.step"), step)]
        if h is not None:
            chosen.append((Axis("mesh", "mesh"), h))
        sizes = [f"dt{step:.6g}" if step is not None else "", f"h{h:.6g}" if h is not None else ""]
        name = "-".join(filter(None, ["reference", integrator, *sizes])) + number
        title = in_words((axis.key, value) for axis, value in chosen) or "tightest tolerances"
        weight = (h or 1.0) ** -2 / (step or 1.0)
        return StudyCase(name, title, (*common, *overrides(plan.base, chosen)), weight)

    def chain(order: int, *sizes: tuple[float | None, float | None]) -> Chain:
        return Chain(tuple(level(*size) for size in sizes), order)

    if smallest is None:
        if mesh is not None:
            return [chain(2, *((h, None) for h in meshes))]
        tolerances = (*physics, *_tolerances(plan, TIGHTER / 10.0))
        loose = StudyCase("reference-loose" + number, "tolerances ten times larger", tolerances)
        return [Chain((*chain(0, (None, None)).levels, loose), 0)]
    finest = plan.every / (FINER * math.ceil(plan.every / smallest * (1.0 - 1e-9)))
    order = 2 if integrator in SECOND_ORDER else 1
    in_time = chain(order, *((meshes[len(meshes) // 2], factor * finest) for factor in (1.0, 2.0, 4.0)))
    return [in_time] if mesh is None else [chain(2, *((h, finest) for h in meshes)), in_time]


def refines_time(plan: Plan) -> bool:
    """Whether the reference integrates time more finely: always, but where meshes alone are compared."""
    if plan.base.time.static:
        return False
    varies = any(axis.path in TIMES and len(axis.values) > 1 for axis in plan.axes)
    return varies or plan.axis("mesh") is None


def integrators(plan: Plan) -> list[str]:
    """Those to try for the reference, in order."""
    # the scene's own first
    return [*sorted(SECOND_ORDER, key=lambda name: name != plan.base.time.integrator), "beuler"]


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


def of_chain(differences: Sequence[History], chain: Chain) -> dict[str, Estimate]:
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
    sums = [comparison.overall(history) for history in differences]
    found = {}
    for name, first in sums[0].items():
        if len(differences) == 1:
            found[name] = Estimate(first, math.nan, True)
            continue
        found[name] = whole = richardson(first, sums[1][name], REFINED, chain.order)
        if name != MEAN_SQUARE and not math.isnan(whole.error):
            pairs = zip(differences[0][name], differences[1][name], strict=True)
            each = [
                richardson(float(fine), float(coarse), REFINED, chain.order).error for fine, coarse in pairs
            ]
            found[name] = replace(whole, error=LARGEST_SAFETY * max(whole.error, *each))
    return found


ROUND_OFF = 1e-13
"""Own error of an exact reference."""


class Observer(Protocol):
    """Receives the progress of a study, and may end it."""

    def case(self, label: str, *, resumed: bool) -> None:
        """A case begins, or was found finished."""

    def progress(self, done: float, whole: float) -> None:
        """Work done and in all, in the same unit; called after every step on all ranks, may raise."""

    def note(self, text: str) -> None:
        """A message for the user."""


@dataclass
class StudyRow(Outcome[Combination]):
    """The result of a combination.

    Attributes
    ----------
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

    _: KW_ONLY
    result: Result
    errors: dict[str, float] = field(default_factory=dict)
    own: dict[str, float] = field(default_factory=dict)
    unresolved: set[str] = field(default_factory=set)
    orders: dict[tuple[str, str], float] = field(default_factory=dict)
    on_front: bool = False
    recommended: bool = False

    @property
    def passed(self) -> bool:
        """Whether it ran to its end."""
        return not self.result.problem

    @property
    def run(self) -> float:
        """Median wall time [s] of the steps alone; NaN for a failed row."""
        return statistics.median(self.result.run_seconds or [math.nan])

    @property
    def total(self) -> float:
        """Median wall time [s] with set-up."""
        return statistics.median(self.result.total_seconds or [math.nan])

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
        """The name of its line in a diagram: its integrator."""
        return self.result.integrator or str(self.case.settings.get("integrator", ""))


def mark_unresolved(row: StudyRow) -> None:
    """Note the quantities whose error is below the reference's own, with a margin."""
    row.unresolved |= {name for name, error in row.errors.items() if error < SAFETY * row.own.get(name, 0.0)}


def fingerprint(*parts: Sequence[str] | str) -> str:
    """A short digest of texts."""
    text = json.dumps([part if isinstance(part, str) else list(part) for part in parts])
    return hashlib.sha256(text.encode()).hexdigest()[:20]


T = TypeVar("T")
Runs = Generator[StudyCase, None, T]
"""Cases to run, and what is made of their results."""


@dataclass
class Work:
    """Runs and comparisons of a study; every method is collective.

    Attributes
    ----------
    comm : MPI.Comm
    plan : Plan
    chosen : dict of physics → Reference
    folder : Path
    observer : Observer
    launcher : Launcher or None
        What starts processes for each case; None: cases are run here.
    lock : int
        File descriptor that those processes keep open, see `launched`.
    rows : list of StudyRow
        The combinations that have ended.
    known : dict of physics → Reference
        References as they came out.
    """

    comm: MPI.Comm
    plan: Plan
    chosen: dict[Physics, Reference]
    folder: Path
    observer: Observer
    launcher: Launcher | None = None
    lock: int = -1
    rows: list[StudyRow] = field(default_factory=list, init=False)
    known: dict[Physics, Reference] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self._results: dict[str, Result] = {}
        self._warm: set[tuple[str, ...]] = set()
        self._done = 0.0
        self._whole = sum(case.weight for case in self.plan.combinations)
        for physics in (physics for physics, one in self.chosen.items() if one.kind == "finer"):
            family = self._family(physics, self._smallest([]), integrators(self.plan)[0])
            weights = {each.name: each.weight for chain in family for each in chain.levels}
            self._whole += sum(weights.values())

    def of(self, physics: Physics) -> list[StudyRow]:
        """The rows of one physical scene."""
        return [row for row in self.rows if row.case.physics == physics]

    # -- runs --------------------------------------------------------------------------------------------

    def cases(self) -> Iterator[StudyCase]:
        """The combinations, then the runs of references, chosen by what came of those before."""
        yield from self.plan.combinations
        for physics in self.chosen:
            self.known[physics] = yield from self._compared(physics)

    def run(self, case: StudyCase) -> Outcome[Any]:
        """What came of a case, which runs unless a finished one is found."""
        folder, begun = self.folder / CASES / case.name, self._done

        def look() -> tuple[Job, Result | None, bool]:
            digest, request = self._fingerprint(case), self.plan.request
            found = read_result(folder, digest)
            job = Job(request.scene, case.overrides, str(folder), case.repeats, digest, request.trust_mesh)
            return job, found, found is None and (folder / RESULT_FILE).exists()

        def watch(fraction: float) -> None:
            self.observer.progress(begun + case.weight * fraction, self._whole)

        looked = on_root(self.comm, look)
        job, found, stale = looked
        self.observer.case(case.title, resumed=found is not None)
        if stale:
            self.observer.note(
                f"{case.title} was finished with another scene, program, options, repeats or ranks: it runs "
                "again"
            )
        if found is None:
            if self.launcher is not None:
                # every process warms up by itself
                found = launched(self.launcher, job, watch, self.lock)
            else:
                found = run_case(self.comm, job, watch, warm=case.kernels not in self._warm)
            self._warm.add(case.kernels)
            if found.problem:
                self.observer.note(f"{case.title} failed: {found.problem}")
        watch(1.0)
        self._done += case.weight
        self._results[case.name] = found
        if not isinstance(case, Combination):
            return Outcome(case, {"done": Verdict(not found.problem, found.problem)})
        self.rows.append(StudyRow(case, result=found))
        return self.rows[-1]

    def _fingerprint(self, case: StudyCase) -> str:
        """Of the scene as understood, its mesh files, the PETSc options, ranks and program."""
        try:
            scene = scene_of(self.plan.request.scene, case.overrides)
        except InputError as error:
            return fingerprint(str(error), case.overrides)
        meshes = [hashlib.sha256(file.read_bytes()).hexdigest() for file in scene.mesh_files.values()]
        options = [f"{name}={value}" for name, value in sorted(PETSc.Options().getAll().items())]
        about = str(case.repeats), str(self.plan.request.ranks or self.comm.size), lyra_petsc.__version__
        return fingerprint(dump_scene(scene), meshes, options, *about)

    # -- comparisons -------------------------------------------------------------------------------------

    def _compared(self, physics: Physics) -> Runs[Reference]:
        """The reference of a physical scene; its errors are noted in the rows.

        A row that misses a sample time has failed after all.
        """
        found, rows = self.chosen[physics], [row for row in self.of(physics) if row.passed]
        if not rows:
            return Reference("none", "no reference: no combination ran to its end")
        if found.kind == "finer":
            found = yield from self._finer(physics, rows)
        if found.kind == "none":
            return found
        if found.kind == "run":
            found.notes.append("the own error of the reference run is not known")
        quantities = self.plan.quantities
        if found.motion is not None:
            found.own = {quantity.name: Estimate(ROUND_OFF, math.nan, True) for quantity in quantities}
            errors_of: Callable[..., Errors] = partial(
                comparison.against_motion, self.comm, motion=found.motion
            )
        else:
            assert found.folder is not None
            other = self._samples(found.folder, found.sheets)
            errors_of = partial(comparison.against_run, self.comm, other=other)
        for row in rows:
            try:
                mine = self._of_case(row.case)
            except InputError as error:
                row.result.fail(" ".join(str(error).split()))
                continue
            row.errors = errors_of(mine, quantities=quantities)
            row.own = {name: estimate.error for name, estimate in found.own.items()}
            mark_unresolved(row)
        return found

    def _finer(self, physics: Physics, rows: Sequence[StudyRow]) -> Runs[Reference]:
        """A run finer than these rows, by the first integrator that can."""
        smallest = self._smallest(rows)
        notes = []
        for integrator in integrators(self.plan) if smallest is not None else [""]:
            family = self._family(physics, smallest, integrator)
            finest = family[0].levels[0]
            best = yield from self._level(finest)
            if not best.problem:
                break
            notes.append(f"a reference with {finest.title} failed: {best.problem}")
        else:
            return Reference("none", "no reference: every attempt at one failed", notes=notes)
        folder, took = self.folder / CASES / finest.name, best.timings[0].run
        found = Reference("finer", f"finer run: {finest.title}", None, folder, best.sheets, notes, {}, took)
        found.own = yield from self._own(family, found)
        return found

    def _family(self, physics: Physics, smallest: float | None, integrator: str) -> list[Chain]:
        number = f"-{list(self.chosen).index(physics) + 1}" if len(self.chosen) > 1 else ""
        return make_family(self.plan, physical_overrides(self.plan, physics), smallest, integrator, number)

    def _smallest(self, rows: Sequence[StudyRow]) -> float | None:
        """Smallest Δt [s] that is asked for, or that automatic steps took on average."""
        if not refines_time(self.plan):
            return None
        axis, base = self.plan.axis("time.step"), self.plan.base.time.step
        steps = [float(value) for value in axis.values] if axis is not None else []
        steps += [row.result.mean_step for row in rows if row.result.mean_step > 0.0]
        return min(steps or [self.plan.end / AUTO_STEPS if isinstance(base, str) else float(base)])

    def _level(self, level: StudyCase) -> Runs[Result]:
        """The result of a run of a reference, which several of its chains may share."""
        if level.name not in self._results:
            yield replace(level, title=f"reference: {level.title}")
        return self._results[level.name]

    def _of_case(self, case: StudyCase) -> Samples:
        return self._samples(self.folder / CASES / case.name, self._results[case.name].sheets)

    def _samples(self, folder: Path, sheets: Sequence[int]) -> Samples:
        return comparison.read_samples(self.comm, folder, self.plan.sample_times(), self.plan.every, sheets)

    def _own(self, family: list[Chain], known: Reference) -> Runs[dict[str, Estimate]]:
        """Own error of the reference from its chains."""
        estimates = []
        for chain in family:
            for level in chain.levels:
                yield from self._level(level)
            for level in chain.levels:
                if self._results[level.name].problem:
                    known.notes.append(f"the own error of the reference is not known: {level.title} failed")
                    return {}
            samples = [self._of_case(level) for level in chain.levels]
            differences = [
                comparison.history_against_run(self.comm, coarse, fine, self.plan.quantities)
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
