"""Plan of a study, made before anything runs: axes of ``--vary``, combinations and their scenes, sample
times, and the quantities whose errors are measured.
"""

from __future__ import annotations

import hashlib
import itertools
import math
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from lyra_petsc.errors import InputError, suggest
from lyra_petsc.experiments.case import Case, load_record
from lyra_petsc.linear.petsc_options import is_set, petsc_number
from lyra_petsc.mesh.build import build_scene_mesh
from lyra_petsc.mesh.measures import mean_edge_length
from lyra_petsc.output.file_operations import reason
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.schema import INTEGRATORS, Scene
from lyra_petsc.show.report.document import seconds, short
from lyra_petsc.stepping.ts_options import STEP_OPTIONS

Value = float | str
Physics = tuple[tuple[str, Value], ...]
"""The settings that change the physical problem, in the order of the axes."""

SHORT_NAMES = {
    "mesh": "mesh",
    "dt": "time.step",
    "integrator": "time.integrator",
    "tolerance": "time.tolerance",
    "spectral_radius": "time.spectral_radius",
    "force_tolerance": "solver.force_tolerance",
    "step_tolerance": "solver.step_tolerance",
    "max_iterations": "solver.max_iterations",
    "hessian": "solver.hessian",
}
"""Short names of keys of the scene; ``mesh`` is the element size [m]."""

TEXT_VALUED = frozenset({"time.integrator", "solver.hessian"})
"""Keys of the scene with short names whose values are texts."""

OPTION = re.compile(r"(ksp|pc|snes|ts|mat|mg|gamg|sub|redundant|vec)_\w+", re.ASCII)
USUAL_OPTIONS = ("ksp_rtol", "ksp_atol", "ksp_max_it", "ksp_type", "pc_type", "snes_rtol", "snes_atol")

NUMERICAL = ("time.step", "time.integrator", "time.tolerance", "time.spectral_radius", "solver.", "petsc.")
"""Keys that change how a scene is solved; other keys change the scene, which then has its own reference."""


@dataclass(frozen=True)
class Axis:
    """A setting that varies.

    Attributes
    ----------
    key : str
        The key as the user wrote it.
    path : str
        The key of the scene; ``mesh`` for the element size.
    values : tuple of float or str
        In the order given.
    """

    key: str
    path: str
    values: tuple[Value, ...] = ()

    @property
    def numeric(self) -> bool:
        """Whether all its values are numbers."""
        return all(isinstance(value, float) for value in self.values)

    @property
    def physical(self) -> bool:
        """Whether its values make different physical problems, not different ways to solve one."""
        return self.path != "mesh" and not self.path.startswith(NUMERICAL)

    @property
    def refines(self) -> bool:
        """Whether errors may decrease along it: several numbers that change how a scene is solved."""
        return self.numeric and not self.physical and len(self.values) > 1


Choice = Sequence[tuple[Axis, Value]]
"""Axes with one value of each."""


def parse_axes(texts: Sequence[str]) -> list[Axis]:
    """Parse the axes of ``--vary``, in their order.

    Raises
    ------
    InputError
        Unknown key, no value, a value of the wrong kind, a value or a key given twice.
    """
    max_combinations = 10_000
    axes: dict[str, Axis] = {}
    for text in texts:
        axis = _parse_axis(text)
        if earlier := axes.get(axis.path):
            message = f"varies what {earlier.key} varies already; give all values at once"
            raise InputError(message, key=_option(text))
        axes[axis.path] = axis
    if {"time.step", "time.tolerance"} <= set(axes):
        raise InputError(
            "a tolerance is for steps of automatic length, dt for fixed ones: vary one of them", key="--vary"
        )
    if math.prod(len(axis.values) for axis in axes.values()) > max_combinations:
        raise InputError(f"makes more than {max_combinations} combinations", key="--vary")
    return list(axes.values())


def _option(text: str) -> str:
    return f"--vary {text if len(text) <= 60 else text[:57] + '...'}"


def _parse_axis(text: str) -> Axis:
    key, equals, listed = (part.strip() for part in text.partition("="))
    if not equals or not key:
        raise InputError("must read key=value,value,…, as in dt=0.02,0.01", key=_option(text))
    path = scene_key(key)
    words = [word.strip() for word in _split_at_commas(listed)]
    if not any(words):
        raise InputError(f"no values: give at least one, as in {key}=…,…", key=_option(text))
    if not all(words):
        raise InputError("has an empty value between its commas", key=_option(text))
    values = tuple(_parse_value(path, word, text) for word in words)
    if twice := [word for number, word in enumerate(words) if values[number] in values[:number]]:
        raise InputError(f"has the value {twice[0]} twice", key=_option(text))
    return Axis(key, path, values)


def scene_key(key: str) -> str:
    """The key of the scene that a key of ``--vary`` denotes.

    Raises
    ------
    InputError
        For an unknown key; the message suggests the nearest known one.
    """
    if key in SHORT_NAMES or key == "mesh.size":
        return SHORT_NAMES.get(key, "mesh")
    if "." in key or "[" in key or key in list(Scene.keys()):
        return key
    if OPTION.fullmatch(key) and key not in (*STEP_OPTIONS, "ts_type"):
        return f"petsc.{key}"
    hint = suggest(key, [*SHORT_NAMES, *USUAL_OPTIONS])
    raise InputError(
        f"unknown key, {hint}; any key of the scene can vary by its path, as in time.step",
        key=f"--vary {key}",
    )


def _split_at_commas(text: str) -> list[str]:
    """Split at the commas outside of brackets."""
    pieces, depth = [""], 0
    for sign in text:
        depth += (sign in "[{(") - (sign in "]})")
        if sign == "," and depth <= 0:
            pieces.append("")
        else:
            pieces[-1] += sign
    return pieces


def _parse_value(path: str, word: str, text: str) -> Value:
    if path == "time.integrator":
        if word not in INTEGRATORS:
            raise InputError(f"unknown integrator '{word}', {suggest(word, INTEGRATORS)}", key=_option(text))
        return word
    with suppress(ValueError):
        if math.isfinite(number := float(word)):
            return number
    option = path.startswith("petsc.") and not path.endswith("_type")
    if option or (path in SHORT_NAMES.values() and path not in TEXT_VALUED):
        raise InputError(f"'{word}' is no number", key=_option(text))
    return word


REDUCED_OUTPUT = ("output.fields=[]", "output.reactions=false")
"""Settings that switch off output which a study does not need."""


@dataclass(frozen=True)
class StudyCase(Case):
    """A run of a study; ``name`` is its folder.

    Attributes
    ----------
    overrides : tuple of str
        ``--set`` arguments that make its scene from the scene file.
    weight : float
        Estimated cost, as steps × vertices, in a unit that all cases share.
    repeats : int
        How often it is timed.
    kernels : tuple of str
        Key of its compiled kernels: the first case with a key takes a warm-up step.
    """

    overrides: tuple[str, ...] = ()
    weight: float = 1.0
    repeats: int = 1
    kernels: tuple[str, ...] = ("reference",)


@dataclass(frozen=True)
class Combination(StudyCase):
    """A value for each axis.

    Attributes
    ----------
    chosen : tuple of (Axis, float or str)
    """

    chosen: tuple[tuple[Axis, Value], ...] = ()

    @property
    def values(self) -> tuple[Value, ...]:
        """One for each axis."""
        return tuple(value for _, value in self.chosen)

    @property
    def settings(self) -> dict[str, Value]:
        """Values by the keys of the axes."""
        return {axis.key: value for axis, value in self.chosen}

    @property
    def physics(self) -> Physics:
        """Its settings that change the physical problem."""
        return tuple((axis.key, value) for axis, value in self.chosen if axis.physical)


def _folder_name(chosen: Choice) -> str:
    """Name of a case from its settings, so that a wider study finds the finished cases of a smaller one."""
    parts = []
    for axis, value in chosen:
        key = "" if axis.path == "time.integrator" else axis.key
        parts.append(f"{key}{value!r}" if isinstance(value, float) else f"{key}-{value}".lstrip("-"))
    plain = "-".join(parts)
    safe = re.sub(r"[^\w.+-]+", "_", plain)[:80].strip("_.-")
    return safe if safe == plain else f"{safe}-{hashlib.sha256(plain.encode()).hexdigest()[:8]}"


def describe_setting(key: str, value: Value) -> str:
    """A setting as shown to the user."""
    if key in ("integrator", "time.integrator"):
        return str(value)
    if isinstance(value, str):
        return f"{key} {value}"
    if key in ("dt", "time.step"):
        return f"Δt {seconds(value, 6)}"
    return f"h {value:g} m" if key == "mesh" else f"{key} {short(value)}"


def describe_settings(settings: Iterable[tuple[str, Value]]) -> str:
    """Settings by key as shown to the user."""
    return ", ".join(describe_setting(key, value) for key, value in settings)


def make_combinations(axes: Sequence[Axis]) -> list[Combination]:
    """All combinations, the last axis varying fastest."""
    combinations = []
    for values in itertools.product(*(axis.values for axis in axes)):
        chosen = tuple(zip(axes, values, strict=True))
        title = describe_settings((axis.key, value) for axis, value in chosen) or "the scene as it is"
        combinations.append(Combination(_folder_name(chosen), title, chosen=chosen))
    return combinations


# -- from values to a scene ----------------------------------------------------------------------------


def overrides(base: Scene, chosen: Choice) -> list[str]:
    """The ``--set`` arguments for these values of axes, with the changes of ``time`` that they require.

    Raises
    ------
    InputError
        An element size for a mesh with fixed elements.
    """
    changes: list[str] = []
    for axis, value in chosen:
        if axis.path == "mesh":
            changes += mesh_overrides(base, float(value))
        else:
            whole = isinstance(value, float) and value.is_integer()
            changes.append(f"{axis.path}={int(value) if whole else value}")
    time, values = base.time, {axis.path: value for axis, value in chosen}
    if "time.tolerance" in values and time.step != "auto":
        changes.append("time.step=auto")
    if values.get("time.step", "auto") != "auto" and time.tolerance is not None:
        changes.append("time.tolerance=")
    if values.get("time.integrator", "alpha2") != "alpha2" and "time.spectral_radius" not in values:
        changes.append("time.spectral_radius=")
    return changes


def mesh_overrides(base: Scene, size: float) -> list[str]:
    """The ``--set`` arguments for an element size [m]: ``size`` of gmsh scripts, numbers of cells of grids.

    Raises
    ------
    InputError
        For a mesh file with fixed elements, or a size that is not positive.
    """
    if not (math.isfinite(size) and size > 0.0):
        raise InputError(f"an element size must be > 0 m, not {size:g}", key="--vary mesh")
    changes = []
    for number, source in enumerate(base.mesh):
        if source.grid is not None:
            grid = source.grid
            nx, ny = (max(1, round(length / size)) for length in (grid.width, grid.height))
            changes += [f"mesh[{number}].grid.nx={nx}", f"mesh[{number}].grid.ny={ny}"]
        elif source.file is not None and source.file.suffix.lower() == ".geo":
            changes.append(f"mesh[{number}].size={size!r}")
        else:
            name = source.file.name if source.file is not None else "a mesh"
            raise InputError(
                f"{name} comes with its elements; element sizes vary for grids and .geo files only",
                file=base.source,
                key="--vary mesh",
            )
    return changes


def scene_of(path: str, overrides: Sequence[str], *, trust_mesh: bool = False) -> Scene:
    """Load the scene with the overrides of a case.

    Raises
    ------
    InputError
        As of ``load_scene``; the message names ``--vary`` where a combination is the cause.
    """
    try:
        scene = load_scene(path, overrides)
    except InputError as error:
        message = error.message.replace("(from --set)", "(from --set or --vary)")
        key = error.key and re.sub("^--set ", "--vary ", error.key)
        raise InputError(message, file=error.file, key=key) from None
    return scene.trusting_meshes() if trust_mesh else scene


@dataclass(frozen=True)
class StudyQuantity:
    """A kind of error that is measured for each combination.

    Attributes
    ----------
    name : str
        ``position_max``, ``position_l2``, ``energy`` or ``probe_<name>``: columns are ``error_<name>``.
    title : str
        Name for reports.
    probe : str
        The probe of the scene that it belongs to; empty for none.
    """

    name: str
    title: str
    probe: str = ""


MEAN_SQUARE = "position_l2"
"""Name of the quantity whose samples are combined by their mean square; others by their maximum."""

POSITION = (
    StudyQuantity(MEAN_SQUARE, "L2 error in position / sheet size"),
    StudyQuantity("position_max", "largest error in position / sheet size"),
)
"""Root mean square over area and sample times, and maximum over vertices and sample times."""

ENERGY = StudyQuantity("energy", "error in energy / largest energy exchanged")


def probe_quantity(name: str) -> StudyQuantity:
    """The error in the position of a probe."""
    return StudyQuantity(f"probe_{name}", f"error of probe '{name}' / sheet size", name)


def parse_quantities(text: str, probes: Iterable[str]) -> list[StudyQuantity]:
    """The quantities of ``--quantities``; all for an empty text.

    Parameters
    ----------
    text : str
        ``position``, ``energy``, ``probes`` (all of the scene) or names of probes, separated by commas.
    probes : iterable of str
        Probes of the scene.

    Raises
    ------
    InputError
        For an unknown quantity, one given twice, or probes if the scene has none.
    """
    key, every = "--quantities", [probe_quantity(name) for name in probes]
    known = {quantity.probe: [quantity] for quantity in every}
    known |= {"position": [*POSITION], "energy": [ENERGY], "probes": every}
    words = [word.strip() for word in text.split(",")] if text.strip() else ["position", "energy", "probes"]
    quantities: list[StudyQuantity] = []
    for word in words:
        if not word:
            raise InputError("has an empty name between its commas", key=key)
        if word not in known:
            raise InputError(f"unknown quantity '{word}', {suggest(word, known)}", key=key)
        if not known[word] and text.strip():
            raise InputError("the scene has no probes; add some, as in probes: {tip: {group: tip}}", key=key)
        if any(quantity in quantities for quantity in known[word]):
            raise InputError(f"names '{word}' twice", key=key)
        quantities += known[word]
    return quantities


REQUEST_FILE = "request.json"


@dataclass(frozen=True)
class Request:
    """The request for a study, as stored in its folder.

    Attributes
    ----------
    scene : str
        Path of the scene.
    settings : tuple of str
        ``--set``.
    vary : tuple of str
        ``--vary``; empty: the default sweep.
    reference : str
        ``auto``, ``finer``, ``exact:NAME`` or ``run:DIR``.
    quantities : str
        Separated by commas; empty: all.
    repeats : int
        How often each combination is timed.
    ranks : int or None
        ``--ranks``: one mpirun per case; None: the communicator the study was started with.
    trust_mesh : bool
        ``--trust-mesh``.
    """

    scene: str
    settings: tuple[str, ...] = ()
    vary: tuple[str, ...] = ()
    reference: str = "auto"
    quantities: str = ""
    repeats: int = 3
    ranks: int | None = None
    trust_mesh: bool = False

    def with_changes(self, overrides: Sequence[str]) -> Scene:
        """Load the scene with its settings and further overrides, and with reduced output.

        Raises
        ------
        InputError
            If the settings contradict each other.
        """
        settings = (*self.settings, *REDUCED_OUTPUT, *overrides)
        return scene_of(self.scene, settings, trust_mesh=self.trust_mesh)


def read_request(folder: Path) -> Request:
    """Read the request in the folder of a study.

    Raises
    ------
    InputError
        If it is missing or cannot be read.
    """
    path = folder / REQUEST_FILE
    try:
        return load_record(path, Request)
    except OSError as error:
        raise InputError(f"cannot be read: {reason(error)}", file=path, key="--resume") from None
    except ValueError:
        raise InputError("is damaged; begin the study anew with --force", file=path, key="--resume") from None


ASSUMED_STEPS = 200.0
"""Assumed number of steps of a run with adaptive steps, for the estimate of the remaining time."""

TIME_TOLERANCE = 1e-6
"""Fraction of Δt by which the end of a step may differ from a sample time."""

OVERRIDING_OPTIONS = {
    "time.step": STEP_OPTIONS,
    "time.integrator": ("ts_type",),
    "time.tolerance": STEP_OPTIONS,
}
"""PETSc options that override the key of an axis."""


@dataclass
class Plan:
    """The plan of a study.

    Attributes
    ----------
    request : Request
    base : Scene
    axes : list of Axis
    combinations : list of Combination
    quantities : list of StudyQuantity
    end : float
        End time [s], or load factor of a static analysis.
    interval : float
        Time between samples [s]; the end is sampled as well.
    notes : list of str
        Notes for the user.
    """

    request: Request
    base: Scene
    axes: list[Axis]
    combinations: list[Combination]
    quantities: list[StudyQuantity]
    end: float
    interval: float
    notes: list[str] = field(default_factory=list)

    def axis(self, path: str) -> Axis | None:
        """The axis of a key of the scene; None if it does not vary."""
        return next((axis for axis in self.axes if axis.path == path), None)

    def sample_times(self) -> list[float]:
        """Sample times [s], ascending, from 0 to the end."""
        count = math.floor(self.end / self.interval * (1.0 + TIME_TOLERANCE))
        times = [number * self.interval for number in range(count + 1)]
        return times if self.end - times[-1] <= TIME_TOLERANCE * self.interval else [*times, self.end]

    def overrides(self, chosen: Choice) -> tuple[str, ...]:
        """All ``--set`` arguments of the scene with these values of axes."""
        further = f"output.every={self.interval!r}", *overrides(self.base, chosen)
        return (*self.request.settings, *REDUCED_OUTPUT, *further)

    def scene(self, case: StudyCase) -> Scene:
        """The scene of a case.

        Raises
        ------
        InputError
            If its settings contradict each other.
        """
        return scene_of(self.request.scene, case.overrides, trust_mesh=self.request.trust_mesh)


def make_plan(request: Request) -> Plan:
    """Plan a requested study: reads the scene and its meshes, but runs and writes nothing. For rank 0.

    Raises
    ------
    InputError
        For any part of the request, the scene or its meshes that cannot be used.
    """
    if request.repeats < 1:
        raise InputError(f"must be at least 1, not {request.repeats}", key="--repeats")
    axes = parse_axes(request.vary)
    base = request.with_changes([])
    quantities = parse_quantities(request.quantities, base.probes)
    notes: list[str] = []
    axes = axes or default_axes(base, notes)
    for axis in axes:
        if axis.path in ("output.every", "time.end", "time.analysis"):
            raise InputError("decides when errors are sampled and cannot vary", key=f"--vary {axis.key}")
        _refuse_overridden(axis)
        _check_each_value(request, base, axis)
        if axis.path == "mesh":
            notes += _note_numbered_vertices(base)
    end = petsc_number("ts_max_time", base.time.end)
    every = _sampling_interval(base, axes, end, notes)
    plan = Plan(request, base, axes, make_combinations(axes), quantities, end, every, notes)
    plan.combinations = [_with_cost(plan, combination) for combination in plan.combinations]
    return plan


def _with_cost(plan: Plan, combination: Combination) -> Combination:
    """The combination with its overrides, cost, repeats and kernels."""
    settings = {axis.path: value for axis, value in combination.chosen}
    step = settings.get("time.step", plan.base.time.step)
    if isinstance(step, str) or "time.tolerance" in settings:
        step = plan.end / ASSUMED_STEPS
    weight = plan.request.repeats / step / float(settings.get("mesh", 1.0)) ** 2
    texts = (value for value in combination.values if isinstance(value, str))
    return replace(
        combination,
        overrides=plan.overrides(combination.chosen),
        weight=weight,
        repeats=plan.request.repeats,
        kernels=("combination", *texts),
    )


def default_axes(base: Scene, notes: list[str]) -> list[Axis]:
    """The axes without ``--vary``: integrators and halved steps or tolerances; element sizes in statics."""
    if base.time.static:
        size = mean_edge_length(build_scene_mesh(base))
        grid = base.mesh[0].grid
        h = float(f"{(grid.width / grid.nx if grid is not None else base.mesh[0].size) or size:.3g}")
        mesh_overrides(base, h)
        notes.append(f"no --vary: element sizes {2 * h:g}, {h:g} and {h / 2:g} m")
        return [Axis("mesh", "mesh", (2.0 * h, h, h / 2.0))]
    integrators = Axis("integrator", "time.integrator", tuple(INTEGRATORS))
    if base.time.step == "auto":
        middle = float(base.time.tolerance or 1e-3)
        notes.append("no --vary: every integrator with steps of automatic length, three tolerances")
        able = tuple(name for name in INTEGRATORS if name != "semi-implicit")
        return [
            Axis("integrator", "time.integrator", able),
            Axis("tolerance", "time.tolerance", (4.0 * middle, middle, middle / 4.0)),
        ]
    step = float(base.time.step)
    every = base.output.every
    double = every is None or _divides(2.0 * step, every)
    steps = (2.0 * step, step, step / 2.0) if double else (step, step / 2.0, step / 4.0)
    notes.append("no --vary: every integrator with Δt " + ", ".join(seconds(value) for value in steps))
    return [integrators, Axis("dt", "time.step", steps)]


def _divides(step: float, every: float) -> bool:
    count = every / step
    return count >= 1.0 - TIME_TOLERANCE and abs(count - round(count)) <= TIME_TOLERANCE * max(1.0, count)


def _sampling_interval(base: Scene, axes: Sequence[Axis], end: float, notes: list[str]) -> float:
    """Time between samples [s]; adds a note about Δt that do not divide it."""
    if base.time.static:
        return end
    steps = [float(v) for axis in axes if axis.path == "time.step" for v in axis.values if v != "auto"]
    if not steps and base.time.step != "auto":
        steps = [float(base.time.step)]
    every = base.output.every
    if every is None:
        every = min(end, max(steps)) if steps else end / 10.0
        notes.append(f"the scene writes every step: errors are sampled every {seconds(every)} instead")
    every = min(every, end)
    unfit = [step for step in steps if not _divides(step, every)]
    if unfit:
        listed = ", ".join(seconds(step) for step in unfit)
        notes.append(
            f"Δt {listed} does not divide the time between samples, {seconds(every)}: steps are shortened "
            "to land on them (--set output.every=… changes it)"
        )
    return every


def _note_numbered_vertices(base: Scene) -> list[str]:
    """A note on vertices selected by number, which differ between meshes; empty if there are none."""
    picked = [f"handles[{i}]" for i, handle in enumerate(base.handles) if handle.nodes is not None]
    picked += [f"loads[{i}]" for i, load in enumerate(base.loads) if load.nodes is not None]
    picked += [f"probes.{name}" for name, probe in base.probes.items() if probe.nodes is not None]
    reason = "vertices picked by number are others on another mesh; use group or box"
    return [f"{', '.join(picked)}: {reason}"] if picked else []


def _refuse_overridden(axis: Axis) -> None:
    """Refuse an axis that a PETSc option of the command line overrides: its values would have no effect."""
    option = (axis.path.removeprefix("petsc."),) if axis.path.startswith("petsc.") else ()
    for name in filter(is_set, OVERRIDING_OPTIONS.get(axis.path, option)):
        raise InputError(
            f"-{name} on the command line (or in PETSC_OPTIONS, .petscrc) would fix what varies; "
            "leave it out",
            key=f"--vary {axis.key}",
        )


def _check_each_value(request: Request, base: Scene, axis: Axis) -> None:
    """Check each value by itself; conflicts between axes are reported in the rows of combinations."""
    seen: dict[tuple[str, ...], Value] = {}
    for value in axis.values:
        changes = overrides(base, [(axis, value)])
        try:
            request.with_changes(changes)
        except InputError:
            # a spectral radius may be valid only together with values of other axes
            if len(request.vary) <= 1 or axis.path != "time.spectral_radius":
                raise
        if axis.path == "mesh" and (other := seen.setdefault(tuple(changes), value)) != value:
            raise InputError(f"{other:g} and {value:g} m give the same grid", key=f"--vary {axis.key}")
