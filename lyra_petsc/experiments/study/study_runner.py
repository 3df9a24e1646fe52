"""Runs the cases of a study that are not finished, and compares them with the reference of their scene.

References are chosen on rank 0 before anything runs: an exact solution if one holds, otherwise a finer run by
a second-order integrator with a quarter of the smallest Δt and solver tolerances of a hundredth of the
tightest. If element sizes vary, the reference has half the smallest size; if only element sizes vary, the
time integration of the scene stays, so that the errors are those of the mesh. The error of the reference
itself is estimated by Richardson extrapolation from coarser runs, in Δt and element size separately, each
coarser than the one before by a factor of two.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import statistics
from collections.abc import Generator, Iterator, Sequence
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
from lyra_petsc.experiments.study.comparison import (
    Errors,
    History,
    RestSurface,
    Samples,
    error_history,
    overall,
    read_samples,
    samples_of_motion,
)
from lyra_petsc.experiments.study.jobs import CASES, RESULT_FILE, Job, Result, launch, read_result, run_case
from lyra_petsc.experiments.study.plan import (
    ASSUMED_STEPS,
    MEAN_SQUARE,
    Axis,
    Combination,
    Physics,
    Plan,
    StudyCase,
    Value,
    describe_settings,
    overrides,
    scene_of,
)
from lyra_petsc.mesh.build import build_scene_mesh
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.schema import Scene

NUMERICAL_BLOCKS = {"time", "output", "solver", "petsc", "title", "probes"}
"""Blocks in which the scene of ``--reference run:DIR`` may differ without a note."""


@dataclass(frozen=True)
class EstimatedError:
    """Estimated error of a reference in one quantity.

    Attributes
    ----------
    error : float
        Relative error, scaled as the errors that are measured against the reference.
    order : float
        Observed order; NaN if two runs agree, or if only two were made.
    trusted : bool
        Whether the runs converge.
    """

    error: float
    order: float
    trusted: bool


@dataclass
class Reference:
    """The reference of one physical scene.

    Attributes
    ----------
    kind : str
        ``exact``, ``run``, ``finer``, or ``none`` if every attempt at one failed.
    description : str
        Description for the report; empty for ``finer`` until the run is known.
    motion : ExactMotion or None
    folder : Path or None
        Folder of the run.
    sheets : sequence of int
        Number of vertices of each mesh source; needed for comparison between meshes.
    notes : list of str
    own_errors : dict of str to EstimatedError
        Its own error by quantity; empty if unknown.
    seconds : float
        Wall time [s] of its steps, if it was run by this study.
    """

    kind: str
    description: str = ""
    motion: ExactMotion | None = None
    folder: Path | None = None
    sheets: Sequence[int] = ()
    notes: list[str] = field(default_factory=list)
    own_errors: dict[str, EstimatedError] = field(default_factory=dict)
    seconds: float = math.nan


def physical_overrides(plan: Plan, physics: Physics) -> tuple[str, ...]:
    """The ``--set`` arguments of one physical scene."""
    values = dict(physics)
    return plan.overrides([(axis, values[axis.key]) for axis in plan.axes if axis.physical])


def choose_references(plan: Plan) -> dict[Physics, Reference]:
    """Choose the reference of every physical scene of a study. For rank 0.

    Raises
    ------
    InputError
        Unknown reference, an exact solution that does not hold, a run of another mesh.
    """
    text = plan.request.reference
    kind, colon, name = text.partition(":")
    key = f"--reference {text}"
    groups = list(dict.fromkeys(combination.physics for combination in plan.combinations))

    def scene(physics: Physics) -> Scene:
        return plan.scene(StudyCase("", "", physical_overrides(plan, physics)))

    if kind == "auto" and not colon:
        return {physics: _automatic_reference(scene(physics)) for physics in groups}
    if kind == "finer" and not colon:
        return {physics: Reference("finer") for physics in groups}
    if kind == "exact" and name:
        return {
            physics: _exact_reference(name, exact_motion(name, Body(scene(physics)))) for physics in groups
        }
    if kind == "run" and name:
        if len(groups) > 1:
            listed = ", ".join(axis.key for axis in plan.axes if axis.physical)
            raise InputError(
                f"one run cannot be the reference of different scenes ({listed} varies)", key=key
            )
        return {groups[0]: _reference_run(plan, Path(name), key)}
    raise InputError("must be auto, finer, exact:NAME or run:DIR", key=key)


def _exact_reference(name: str, motion: ExactMotion) -> Reference:
    return Reference("exact", f"exact: {name} ({SOLUTIONS[name].title})", motion)


def _automatic_reference(scene: Scene) -> Reference:
    body = Body(scene)
    solution = matching(body)
    return Reference("finer") if solution is None else _exact_reference(solution.name, solution.motion(body))


def _reference_run(plan: Plan, folder: Path, key: str) -> Reference:
    if not folder.is_dir():
        raise InputError("no such folder", file=folder, key=key)
    try:
        samples = read_samples(folder, plan.sample_times(), plan.interval)
    except InputError as error:
        raise InputError(error.message, file=error.file, key=key) from None
    axis = plan.axis("mesh")
    for chosen in [[(axis, value)] for value in axis.values] if axis is not None else [[]]:
        mesh = build_scene_mesh(plan.request.with_changes(overrides(plan.base, chosen)))
        built = RestSurface(mesh.rest, mesh.triangles, np.ones(mesh.n_vertices))
        stored = samples.surface
        if not built.same_as(stored):
            raise InputError(
                f"is a run of another mesh ({len(stored.rest)} vertices, {len(stored.triangles)} triangles; "
                f"the study's has {mesh.n_vertices} and {mesh.n_triangles}, or others)",
                file=folder,
                key=key,
            )
    missing = [name for name in (q.probe for q in plan.quantities) if name and name not in samples.probes]
    if missing and plan.request.quantities:
        raise InputError(f"has no probe '{missing[0]}'", file=folder, key=key)
    notes = [f"the reference run has no probe '{name}': its error is not known" for name in missing]
    return Reference("run", f"run {folder}", folder=folder, notes=[*notes, *_scene_differences(plan, folder)])


def _scene_differences(plan: Plan, folder: Path) -> list[str]:
    """Notes on physical differences between the scene of a run and that of the study."""
    try:
        other = load_scene(folder / "scene.yaml")
    except InputError:
        return ["the reference run's scene cannot be read, so it is unknown whether it is the same"]
    names = type(plan.base).model_fields.keys() - NUMERICAL_BLOCKS
    keys = sorted(name for name in names if getattr(plan.base, name) != getattr(other, name))
    return [f"the reference run is of another scene: {', '.join(keys)} differ"] if keys else []


SECOND_ORDER = ("bdf2", "alpha2", "midpoint")
MINIMUM_TOLERANCES = {"force_tolerance": 1e-10, "step_tolerance": 1e-10}
TIME_KEYS = ("time.step", "time.integrator", "time.tolerance", "time.spectral_radius")

SAFETY = 2.0
"""An error is not resolved if it is below this factor times the error of the reference."""


@dataclass(frozen=True)
class Chain:
    """Runs that differ in Δt or element size by factors of two, finest first.

    Attributes
    ----------
    levels : tuple of StudyCase
    order : int
        Expected order of convergence; 0 if there is none.
    """

    levels: tuple[StudyCase, ...]
    order: int


def make_chains(
    plan: Plan, physics: Sequence[str], smallest: float | None, integrator: str, number: str = ""
) -> list[Chain]:
    """The runs of the reference of one physical scene; the first one is the reference itself.

    Parameters
    ----------
    plan : Plan
    physics : sequence of str
        ``--set`` arguments of this scene.
    smallest : float or None
        Smallest Δt [s] of the study; None if the time integration is not refined.
    integrator : str
        Integrator of the reference if the time integration is refined.
    number : str
        Suffix of the names if there are several physical scenes.
    """
    tolerance_refinement = 100.0
    common = [*physics, *_tolerances(plan, tolerance_refinement)]
    mesh = plan.axis("mesh")
    meshes: list[float | None] = [None]
    if mesh is not None:
        size = min(map(float, mesh.values))
        meshes = [size / 2.0, size, 2.0 * size]
    if smallest is None or plan.base.time.static:
        smallest, integrator = None, ""
        fixed = [axis for axis in plan.axes if axis.path in TIME_KEYS and len(axis.values) == 1]
        common += overrides(plan.base, [(axis, axis.values[0]) for axis in fixed])

    def level(h: float | None, step: float | None) -> StudyCase:
        chosen: list[tuple[Axis, Value]] = []
        if step is not None:
            chosen += [(Axis("integrator", "time.integrator"), integrator), (Axis("dt", "time.step"), step)]
        if h is not None:
            chosen.append((Axis("mesh", "mesh"), h))
        sizes = [f"dt{step:.6g}" if step is not None else "", f"h{h:.6g}" if h is not None else ""]
        name = "-".join(filter(None, ["reference", integrator, *sizes])) + number
        title = describe_settings((axis.key, value) for axis, value in chosen) or "tightest tolerances"
        weight = (h or 1.0) ** -2 / (step or 1.0)
        return StudyCase(name, title, (*common, *overrides(plan.base, chosen)), weight)

    def chain(order: int, *sizes: tuple[float | None, float | None]) -> Chain:
        return Chain(tuple(level(*size) for size in sizes), order)

    if smallest is None:
        if mesh is not None:
            return [chain(2, *((h, None) for h in meshes))]
        tolerances = (*physics, *_tolerances(plan, tolerance_refinement / 10.0))
        loose = StudyCase("reference-loose" + number, "tolerances ten times larger", tolerances)
        return [Chain((*chain(0, (None, None)).levels, loose), 0)]
    # smallest Δt of the study over that of the reference
    finest = plan.interval / (4 * math.ceil(plan.interval / smallest * (1.0 - 1e-9)))
    order = 2 if integrator in SECOND_ORDER else 1
    in_time = chain(order, *((meshes[len(meshes) // 2], factor * finest) for factor in (1.0, 2.0, 4.0)))
    return [in_time] if mesh is None else [chain(2, *((h, finest) for h in meshes)), in_time]


def refines_time(plan: Plan) -> bool:
    """Whether the reference refines the time integration: always, unless only meshes are compared."""
    if plan.base.time.static:
        return False
    varies = any(axis.path in TIME_KEYS and len(axis.values) > 1 for axis in plan.axes)
    return varies or plan.axis("mesh") is None


def reference_integrators(plan: Plan) -> list[str]:
    """Integrators to try for the reference; the scene's own is first if it is of second order."""
    return [*sorted(SECOND_ORDER, key=lambda name: name != plan.base.time.integrator), "beuler"]


def _tolerances(plan: Plan, tighter: float) -> list[str]:
    """Overrides of solver tolerances: the tightest of the study over ``tighter``."""
    tolerances = []
    for name, minimum in MINIMUM_TOLERANCES.items():
        axis = plan.axis(f"solver.{name}")
        values = [float(v) for v in axis.values] if axis else [float(getattr(plan.base.solver, name))]
        tolerances.append(f"solver.{name}={max(minimum, min(values) / tighter)!r}")
    for axis in plan.axes:
        if axis.path.startswith("petsc.") and axis.numeric and axis.path.endswith(("tol", "_atol")):
            tightest = min(float(value) for value in axis.values)
            tolerances.append(f"{axis.path}={max(1e-13, tightest / tighter)!r}")
    return tolerances


# -- error of the reference ------------------------------------------------------------------------------


def richardson(first: float, second: float, order: int) -> EstimatedError:
    """Error of the finest of three runs, each with half the Δt or element size of the one before.

    Differences that decrease faster than the expected order do so by chance, as errors of several causes may
    cancel or the place of the maximum may change. The estimate is therefore at least that of the coarser
    pair alone with the expected order.

    Parameters
    ----------
    first, second : float
        Difference between the two finest runs, and between the second and the third.
    order : int
        Expected order; the observed one is used if it is smaller.
    """
    # order of convergence below which an estimate is not trusted to follow it
    minimum_order = 0.5
    if math.isnan(first) or math.isnan(second):
        return EstimatedError(math.nan, math.nan, False)
    if first == second == 0.0:
        return EstimatedError(0.0, math.nan, True)
    observed = math.inf if first == 0.0 else -math.inf
    if first > 0.0 < second:
        observed = math.log2(second / first)
    used = min(float(order), max(observed, minimum_order))
    trusted = observed >= minimum_order
    largest = first if trusted else max(first, second)
    error = largest / (2.0**used - 1.0)
    if order > 0:
        error = max(error, second / 2.0**order / (2.0**order - 1.0))
    return EstimatedError(error, observed, trusted)


def sum_estimates(estimates: Sequence[dict[str, EstimatedError]]) -> dict[str, EstimatedError]:
    """Sum of the errors of time integration and mesh, by quantity."""
    total = {}
    for name in estimates[0]:
        parts = [estimate[name] for estimate in estimates]
        total[name] = EstimatedError(
            math.fsum(part.error for part in parts),
            parts[0].order if len(parts) == 1 else math.nan,
            all(part.trusted for part in parts),
        )
    return total


def estimate_chain(differences: Sequence[History], chain: Chain) -> dict[str, EstimatedError]:
    """Error of the finest run of a chain, by quantity.

    The place and time of a maximum error change between runs, so that maxima give no reliable order. It is
    therefore also estimated at every sample, and multiplied by the safety factor of Roache's grid convergence
    index for three grids [1]_.

    Parameters
    ----------
    differences : sequence of History
        Differences between neighbouring runs, finest first.

    References
    ----------
    .. [1] P. J. Roache, Verification and Validation in Computational Science and Engineering, 1998, ch. 5.
    """
    estimates = {}
    for name, history in differences[0].items():
        first = overall({name: history})[name]
        if len(differences) == 1:
            estimates[name] = EstimatedError(first, math.nan, True)
            continue
        coarser = differences[1][name]
        estimates[name] = whole = richardson(first, overall({name: coarser})[name], chain.order)
        if name != MEAN_SQUARE and not math.isnan(whole.error):
            pairs = zip(history.tolist(), coarser.tolist(), strict=True)
            largest = max(richardson(fine, coarse, chain.order).error for fine, coarse in pairs)
            # safety factor on the estimates of maximum errors
            estimates[name] = replace(whole, error=1.25 * max(whole.error, largest))
    return estimates


class StudyObserver(Protocol):
    """Is notified of the progress of a study, and may end it."""

    def case(self, label: str, *, resumed: bool) -> None:
        """A case begins, or was found finished."""

    def progress(self, done: float, whole: float) -> None:
        """Completed and total cost, in the same unit; called after every step on all ranks, may raise."""

    def note(self, text: str) -> None:
        """A message for the user."""


@dataclass
class StudyRow(Outcome[Combination]):
    """The result of a combination.

    Attributes
    ----------
    result : Result
    errors : dict of str to float
        Errors by quantity; NaN where unknown.
    own_errors : dict of str to float
        Errors of the reference by quantity; NaN where unknown.
    unresolved : set of str
        Quantities whose error cannot be distinguished from that of the reference.
    orders : dict of (axis key, quantity) to float
        Observed orders, from the next coarser row that differs in this axis only.
    on_front, recommended : bool
        Whether it is on the Pareto front; whether it is the setting recommended for 1 %.
    """

    _: KW_ONLY
    result: Result
    errors: dict[str, float] = field(default_factory=dict)
    own_errors: dict[str, float] = field(default_factory=dict)
    unresolved: set[str] = field(default_factory=set)
    orders: dict[tuple[str, str], float] = field(default_factory=dict)
    on_front: bool = False
    recommended: bool = False

    @property
    def passed(self) -> bool:
        """Whether it ran to its end."""
        return not self.result.problem

    @property
    def run_time(self) -> float:
        """Median wall time [s] of the steps alone; NaN for a failed row."""
        return statistics.median(self.result.run_seconds or [math.nan])

    @property
    def total_time(self) -> float:
        """Median wall time [s] with set-up."""
        return statistics.median(self.result.total_seconds or [math.nan])

    def resolved(self, quantity: str) -> float:
        """The error; NaN if it is unknown or not resolved."""
        return math.nan if quantity in self.unresolved else self.errors.get(quantity, math.nan)

    def error_bound(self, quantity: str) -> float:
        """Upper bound of the true error, including that of the reference; NaN if unknown."""
        own = self.own_errors.get(quantity, 0.0)
        own = 0.0 if math.isnan(own) else own
        if quantity in self.unresolved:
            return (SAFETY + 1.0) * own
        return self.errors.get(quantity, math.nan) + own

    @property
    def integrator(self) -> str:
        """Its integrator, which names its line in diagrams."""
        return self.result.integrator or str(self.case.settings.get("integrator", ""))


def mark_unresolved(row: StudyRow) -> None:
    """Note the quantities whose error is below ``SAFETY`` times the error of the reference."""
    for name, error in row.errors.items():
        if error < SAFETY * row.own_errors.get(name, 0.0):
            row.unresolved.add(name)


def fingerprint(*parts: Sequence[str] | str) -> str:
    """Digest of texts."""
    text = json.dumps([part if isinstance(part, str) else list(part) for part in parts])
    return hashlib.sha256(text.encode()).hexdigest()[:20]


T = TypeVar("T")
Runs = Generator[StudyCase, None, T]
"""A generator that yields cases to run and returns a value computed from their results."""


@dataclass
class StudyRunner:
    """Runs and comparisons of a study; every method is collective.

    Attributes
    ----------
    comm : MPI.Comm
    plan : Plan
    planned : dict of physics → Reference
        References as chosen before anything runs.
    folder : Path
    observer : StudyObserver
    launcher : Launcher or None
        Starts processes for each case; None: cases run on this communicator.
    lock : int
        File descriptor that these processes keep open, see `launch`.
    rows : list of StudyRow
        Combinations that have ended.
    references : dict of physics → Reference
        References as they were used.
    """

    comm: MPI.Comm
    plan: Plan
    planned: dict[Physics, Reference]
    folder: Path
    observer: StudyObserver
    launcher: Launcher | None = None
    lock: int = -1
    rows: list[StudyRow] = field(default_factory=list, init=False)
    references: dict[Physics, Reference] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self._results: dict[str, Result] = {}
        self._warmed_up: set[tuple[str, ...]] = set()
        self._cost_done = 0.0
        self._total_cost = sum(case.weight for case in self.plan.combinations)
        for physics in (physics for physics, one in self.planned.items() if one.kind == "finer"):
            chains = self._chains(physics, self._smallest_step([]), reference_integrators(self.plan)[0])
            weights = {level.name: level.weight for chain in chains for level in chain.levels}
            self._total_cost += sum(weights.values())

    def rows_of(self, physics: Physics) -> list[StudyRow]:
        """The rows of one physical scene."""
        return [row for row in self.rows if row.case.physics == physics]

    # -- runs --------------------------------------------------------------------------------------------

    def cases(self) -> Iterator[StudyCase]:
        """The combinations, then the runs of references, which depend on the results so far."""
        yield from self.plan.combinations
        for physics in self.planned:
            self.references[physics] = yield from self._compare_scene(physics)

    def run(self, case: StudyCase) -> Outcome[Any]:
        """Run a case, unless a finished one is found in its folder."""
        folder, begun = self.folder / CASES / case.name, self._cost_done

        def find_result() -> tuple[Job, Result | None, bool]:
            digest, request = self._fingerprint(case), self.plan.request
            job = Job(request.scene, case.overrides, str(folder), case.repeats, digest, request.trust_mesh)
            return job, read_result(folder, digest), (folder / RESULT_FILE).exists()

        def watch(fraction: float) -> None:
            self.observer.progress(begun + case.weight * fraction, self._total_cost)

        job, result, exists = on_root(self.comm, find_result)
        self.observer.case(case.title, resumed=result is not None)
        if result is None:
            if exists:
                self.observer.note(
                    f"{case.title} was finished with another scene, program, options, repeats or ranks: it "
                    "runs again"
                )
            if self.launcher is not None:
                # launched processes always warm up
                result = launch(self.launcher, job, partial(watch, 0.0), self.lock)
            else:
                result = run_case(self.comm, job, watch, warm_up=case.kernels not in self._warmed_up)
            self._warmed_up.add(case.kernels)
            if result.problem:
                self.observer.note(f"{case.title} failed: {result.problem}")
        watch(1.0)
        self._cost_done += case.weight
        self._results[case.name] = result
        if not isinstance(case, Combination):
            return Outcome(case, {"done": Verdict(not result.problem, result.problem)})
        self.rows.append(StudyRow(case, result=result))
        return self.rows[-1]

    def _fingerprint(self, case: StudyCase) -> str:
        """Digest of the scene, its mesh files, PETSc options, repeats, ranks and program version."""
        try:
            scene = scene_of(self.plan.request.scene, case.overrides)
        except InputError as error:
            return fingerprint(str(error), case.overrides)
        meshes = [hashlib.sha256(file.read_bytes()).hexdigest() for file in scene.mesh_files.values()]
        options = [f"{name}={value}" for name, value in sorted(PETSc.Options().getAll().items())]
        about = str(case.repeats), str(self.plan.request.ranks or self.comm.size), lyra_petsc.__version__
        return fingerprint(dump_scene(scene), meshes, options, *about)

    # -- comparisons -------------------------------------------------------------------------------------

    def _compare_scene(self, physics: Physics) -> Runs[Reference]:
        """Get the reference of a physical scene and store the errors against it in the rows.

        A row without a state at some sample time counts as failed.
        """
        reference, rows = self.planned[physics], [row for row in self.rows_of(physics) if row.passed]
        if not rows:
            return Reference("none", "no reference: no combination ran to its end")
        if reference.kind == "finer":
            reference = yield from self._run_finer_reference(physics, rows)
        if reference.kind == "none":
            return reference
        if reference.kind == "run":
            reference.notes.append("the own error of the reference run is not known")
        if reference.motion is not None:
            exact = EstimatedError(1e-13, math.nan, True)
            reference.own_errors = dict.fromkeys((quantity.name for quantity in self.plan.quantities), exact)
        errors = on_root(self.comm, lambda: self._errors(reference, rows))
        for row, result in zip(rows, errors, strict=True):
            if isinstance(result, str):
                row.result.fail(result)
                continue
            row.errors = result
            row.own_errors = {name: estimate.error for name, estimate in reference.own_errors.items()}
            mark_unresolved(row)
        return reference

    def _errors(self, reference: Reference, rows: Sequence[StudyRow]) -> list[Errors | str]:
        """The errors of each row, or why it has none. On rank 0."""
        errors: list[Errors | str] = []
        other: Samples | None = None
        if reference.folder is not None:
            other = self._samples(reference.folder, reference.sheets)
        for row in rows:
            try:
                samples = self._samples_of(row.case)
            except InputError as error:
                errors.append(" ".join(str(error).split()))
                continue
            if reference.motion is not None:
                other = samples_of_motion(reference.motion, samples)
            assert other is not None
            errors.append(overall(error_history(samples, other, self.plan.quantities)))
        return errors

    def _run_finer_reference(self, physics: Physics, rows: Sequence[StudyRow]) -> Runs[Reference]:
        """Run a finer reference with the first integrator that reaches the end."""
        smallest = self._smallest_step(rows)
        notes = []
        for integrator in reference_integrators(self.plan) if smallest is not None else [""]:
            chains = self._chains(physics, smallest, integrator)
            finest = chains[0].levels[0]
            best = yield from self._run_level(finest)
            if not best.problem:
                break
            notes.append(f"a reference with {finest.title} failed: {best.problem}")
        else:
            return Reference("none", "no reference: every attempt at one failed", notes=notes)
        folder, time = self.folder / CASES / finest.name, best.timings[0].run
        title = f"finer run: {finest.title}"
        reference = Reference("finer", title, None, folder, best.sheets, notes, {}, time)
        reference.own_errors = yield from self._estimate_errors(chains, reference)
        return reference

    def _chains(self, physics: Physics, smallest: float | None, integrator: str) -> list[Chain]:
        number = f"-{list(self.planned).index(physics) + 1}" if len(self.planned) > 1 else ""
        return make_chains(self.plan, physical_overrides(self.plan, physics), smallest, integrator, number)

    def _smallest_step(self, rows: Sequence[StudyRow]) -> float | None:
        """Smallest Δt [s] of the study, or mean Δt of adaptive steps; None if time is not refined."""
        if not refines_time(self.plan):
            return None
        axis, base = self.plan.axis("time.step"), self.plan.base.time.step
        steps = [float(value) for value in axis.values] if axis is not None else []
        steps += [row.result.mean_step for row in rows if row.result.mean_step > 0.0]
        return min(steps or [self.plan.end / ASSUMED_STEPS if isinstance(base, str) else float(base)])

    def _run_level(self, level: StudyCase) -> Runs[Result]:
        """Run one level of a chain, unless another chain has run it already."""
        if level.name not in self._results:
            yield replace(level, title=f"reference: {level.title}")
        return self._results[level.name]

    def _estimate_chain(self, chain: Chain) -> dict[str, EstimatedError]:
        samples = [self._samples_of(level) for level in chain.levels]
        pairs = itertools.pairwise(samples)
        differences = [error_history(coarse, fine, self.plan.quantities) for fine, coarse in pairs]
        return estimate_chain(differences, chain)

    def _samples_of(self, case: StudyCase) -> Samples:
        return self._samples(self.folder / CASES / case.name, self._results[case.name].sheets)

    def _samples(self, folder: Path, sheets: Sequence[int]) -> Samples:
        return read_samples(folder, self.plan.sample_times(), self.plan.interval, sheets)

    def _estimate_errors(self, chains: list[Chain], known: Reference) -> Runs[dict[str, EstimatedError]]:
        """Estimate the error of a reference from its chains."""
        estimates = []
        for chain in chains:
            for level in chain.levels:
                yield from self._run_level(level)
            for level in chain.levels:
                if self._results[level.name].problem:
                    known.notes.append(f"the own error of the reference is not known: {level.title} failed")
                    return {}
            estimates.append(on_root(self.comm, partial(self._estimate_chain, chain)))
        errors = sum_estimates(estimates)
        doubtful = [name for name, estimate in errors.items() if not estimate.trusted]
        if doubtful:
            known.notes.append(
                "the reference's runs do not converge towards each other as they should "
                f"({', '.join(doubtful)}): its own error is a guess from their largest difference"
            )
        return errors
