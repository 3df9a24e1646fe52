"""What a study runs, worked out before anything does: axes of ``--vary``, combinations and their scenes,
sample times, and the quantities whose errors are measured.
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
"""The settings that make a scene another one, in the axes' order."""

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
"""Names of ours for keys of the scene; ``mesh`` is the element size [m]."""

WORDS = frozenset({"time.integrator", "solver.hessian"})
"""Keys of the scene with short names whose values are words."""

OPTION = re.compile(r"(ksp|pc|snes|ts|mat|mg|gamg|sub|redundant|vec)_\w+", re.ASCII)
USUAL_OPTIONS = ("ksp_rtol", "ksp_atol", "ksp_max_it", "ksp_type", "pc_type", "snes_rtol", "snes_atol")

NUMERICAL = ("time.step", "time.integrator", "time.tolerance", "time.spectral_radius", "solver.", "petsc.")
"""Keys that change how a scene is solved; every other key makes another scene, with its own reference."""

SYNONYMS = {
    "step": "dt",
    "timestep": "dt",
    "time_step": "dt",
    "h": "mesh",
    "size": "mesh",
    "rtol": "ksp_rtol",
    "scheme": "integrator",
    "method": "integrator",
    "ts_dt": "dt",
    "ts_time_step": "dt",
    "ts_type": "integrator",
}
"""What users may call the keys; refused with the right name."""

MOST_COMBINATIONS = 10_000


@dataclass(frozen=True)
class Axis:
    """One thing that varies.

    Attributes
    ----------
    key : str
        As the user wrote it.
    path : str
        The scene's key; ``mesh`` for the element size.
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
        """Whether its values are different scenes and not different ways to solve one."""
        return self.path != "mesh" and not self.path.startswith(NUMERICAL)

    @property
    def refines(self) -> bool:
        """Whether errors may shrink along it: several numbers that are ways to solve one scene."""
        return self.numeric and not self.physical and len(self.values) > 1


Choice = Sequence[tuple[Axis, Value]]
"""Axes and a value of each."""


def parse_axes(texts: Sequence[str]) -> list[Axis]:
    """The axes of ``--vary``, in their order.

    Raises
    ------
    InputError
        Unknown key, no value, a value of the wrong kind, a value or a key given twice.
    """
    axes: dict[str, Axis] = {}
    for text in texts:
        axis = _axis(text)
        if twin := axes.get(axis.path):
            words = f"varies what {twin.key} varies already; give all values at once"
            raise InputError(words, key=_named(text))
        axes[axis.path] = axis
    if {"time.step", "time.tolerance"} <= set(axes):
        raise InputError(
            "a tolerance is for steps of automatic length, dt for fixed ones: vary one of them", key="--vary"
        )
    if math.prod(len(axis.values) for axis in axes.values()) > MOST_COMBINATIONS:
        raise InputError(f"makes more than {MOST_COMBINATIONS} combinations", key="--vary")
    return list(axes.values())


def _named(text: str) -> str:
    return f"--vary {text if len(text) <= 60 else text[:57] + '...'}"


def _axis(text: str) -> Axis:
    key, equals, listed = text.partition("=")
    key = key.strip()
    if not equals or not key:
        raise InputError("must read key=value,value,…, as in dt=0.02,0.01", key=_named(text))
    path = path_of(key)
    words = [word.strip() for word in _split(listed)]
    if not any(words):
        raise InputError(f"no values: give at least one, as in {key}=…,…", key=_named(text))
    if not all(words):
        raise InputError("has an empty value between its commas", key=_named(text))
    values = tuple(_value(path, word, text) for word in words)
    for number, value in enumerate(values):
        if value in values[:number]:
            raise InputError(f"has the value {words[number]} twice", key=_named(text))
    return Axis(key, path, values)


def path_of(key: str) -> str:
    """The scene's key that a key of ``--vary`` stands for.

    Raises
    ------
    InputError
        For a key that stands for nothing, with the nearest that does.
    """
    if key in SHORT_NAMES or key == "mesh.size":
        return SHORT_NAMES.get(key, "mesh")
    if "." in key or "[" in key or key in list(Scene.keys()):
        return key
    if OPTION.fullmatch(key) and key not in SYNONYMS:
        return f"petsc.{key}"
    hint = suggest(SYNONYMS.get(key.lower(), key), [*SHORT_NAMES, *USUAL_OPTIONS])
    raise InputError(
        f"unknown key, {hint}; any key of the scene can vary by its path, as in time.step",
        key=f"--vary {key}",
    )


def _split(text: str) -> list[str]:
    """At the commas outside of brackets."""
    pieces, depth = [""], 0
    for sign in text:
        depth += (sign in "[{(") - (sign in "]})")
        if sign == "," and depth <= 0:
            pieces.append("")
        else:
            pieces[-1] += sign
    return pieces


def _value(path: str, word: str, text: str) -> Value:
    if path == "time.integrator":
        if word not in INTEGRATORS:
            raise InputError(f"unknown integrator '{word}', {suggest(word, INTEGRATORS)}", key=_named(text))
        return word
    with suppress(ValueError):
        if math.isfinite(number := float(word)):
            return number
    option = path.startswith("petsc.") and not path.endswith("_type")
    if option or (path in SHORT_NAMES.values() and path not in WORDS):
        raise InputError(f"'{word}' is no number", key=_named(text))
    return word


LONGEST_NAME = 80

LEAN = ("output.fields=[]", "output.reactions=false")
"""What no run of a study needs to write."""


@dataclass(frozen=True)
class StudyCase(Case):
    """A run that a study makes; ``name`` is its folder.

    Attributes
    ----------
    overrides : tuple of str
        What ``--set`` would say to make it of the scene file.
    weight : float
        Its cost, as steps × vertices, in a unit that all cases share.
    repeats : int
        How often it is timed.
    kernels : tuple of str
        What cases with the same kernels share: the first of them begins with a step to warm up.
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
        """Values by the axes' keys."""
        return {axis.key: value for axis, value in self.chosen}

    @property
    def physics(self) -> Physics:
        """Key of the physical scene it belongs to."""
        return tuple((axis.key, value) for axis, value in self.chosen if axis.physical)


def _folder(chosen: Choice) -> str:
    """The settings, so that a wider study finds what a smaller one has finished."""
    words = []
    for axis, value in chosen:
        key = "" if axis.path == "time.integrator" else axis.key
        words.append(f"{key}{value!r}" if isinstance(value, float) else f"{key}-{value}".lstrip("-"))
    plain = "-".join(words)
    tame = re.sub(r"[^\w.+-]+", "_", plain)[:LONGEST_NAME].strip("_.-")
    return tame if tame == plain else f"{tame}-{hashlib.sha256(plain.encode()).hexdigest()[:8]}"


def described(key: str, value: Value) -> str:
    """A setting in words."""
    if key in ("integrator", "time.integrator"):
        return str(value)
    if isinstance(value, str):
        return f"{key} {value}"
    if key in ("dt", "time.step"):
        return f"Δt {seconds(value, 6)}"
    return f"h {value:g} m" if key == "mesh" else f"{key} {short(value)}"


def in_words(settings: Iterable[tuple[str, Value]]) -> str:
    """Settings by key in words."""
    return ", ".join(described(key, value) for key, value in settings)


def combinations(axes: Sequence[Axis]) -> list[Combination]:
    """All combinations, the last axis varying fastest."""
    found = []
    for values in itertools.product(*(axis.values for axis in axes)):
        chosen = tuple(zip(axes, values, strict=True))
        title = in_words((axis.key, value) for axis, value in chosen) or "the scene as it is"
        found.append(Combination(_folder(chosen), title, chosen=chosen))
    return found


# -- from values to a scene ----------------------------------------------------------------------------


def overrides(base: Scene, chosen: Choice) -> list[str]:
    """The ``--set`` overrides for these values of axes, with the changes of ``time`` that they require.

    Raises
    ------
    InputError
        An element size for a mesh that comes with its elements.
    """
    found: list[str] = []
    for axis, value in chosen:
        if axis.path == "mesh":
            found += mesh_overrides(base, float(value))
        else:
            whole = isinstance(value, float) and value.is_integer()
            found.append(f"{axis.path}={int(value) if whole else value}")
    time, given = base.time, {axis.path: value for axis, value in chosen}
    if "time.tolerance" in given and time.step != "auto":
        found.append("time.step=auto")
    if given.get("time.step", "auto") != "auto" and time.tolerance is not None:
        found.append("time.tolerance=")
    if given.get("time.integrator", "alpha2") != "alpha2" and "time.spectral_radius" not in given:
        found.append("time.spectral_radius=")
    return found


def mesh_overrides(base: Scene, size: float) -> list[str]:
    """Element size [m] for every sheet: of gmsh scripts, or the nearest number of cells of grids.

    Raises
    ------
    InputError
        For a mesh file that comes with its elements, or a size that is no size.
    """
    if not (math.isfinite(size) and size > 0.0):
        raise InputError(f"an element size must be > 0 m, not {size:g}", key="--vary mesh")
    found = []
    for number, source in enumerate(base.mesh):
        if source.grid is not None:
            grid = source.grid
            nx, ny = (max(1, round(length / size)) for length in (grid.width, grid.height))
            found += [f"mesh[{number}].grid.nx={nx}", f"mesh[{number}].grid.ny={ny}"]
        elif source.file is not None and source.file.suffix.lower() == ".geo":
            found.append(f"mesh[{number}].size={size!r}")
        else:
            name = source.file.name if source.file is not None else "a mesh"
            raise InputError(
                f"{name} comes with its elements; element sizes vary for grids and .geo files only",
                file=base.source,
                key="--vary mesh",
            )
    return found


def scene_of(path: str, overrides: Sequence[str], *, trust_mesh: bool = False) -> Scene:
    """The scene with the overrides of a case.

    Raises
    ------
    InputError
        As ``load_scene`` does; what comes from the combination says so.
    """
    try:
        scene = load_scene(path, overrides)
    except InputError as error:
        message = error.message.replace("(from --set)", "(from --set or --vary)")
        key = error.key and re.sub("^--set ", "--vary ", error.key)
        raise InputError(message, file=error.file, key=key) from None
    return scene.trusting_meshes() if trust_mesh else scene


@dataclass(frozen=True)
class Quantity:
    """One error that is measured of each combination.

    Attributes
    ----------
    name : str
        ``position_max``, ``position_l2``, ``energy`` or ``probe_<name>``: columns are ``error_<name>``.
    title : str
        In words.
    probe : str
        The scene's probe it is about; empty if it is about none.
    """

    name: str
    title: str
    probe: str = ""


MEAN_SQUARE = "position_l2"
"""Name of the quantity whose samples are combined by their mean square; of all others the largest counts."""

POSITION = (
    Quantity(MEAN_SQUARE, "L2 error in position / sheet size"),
    Quantity("position_max", "largest error in position / sheet size"),
)
"""Root mean square over area and sample times; and the largest at any vertex and sample time."""

ENERGY = Quantity("energy", "error in energy / largest energy exchanged")


def probe_quantity(name: str) -> Quantity:
    """The error of a probe's position."""
    return Quantity(f"probe_{name}", f"error of probe '{name}' / sheet size", name)


def chosen(text: str, probes: Iterable[str]) -> list[Quantity]:
    """The quantities that ``--quantities`` names; all for an empty text.

    Parameters
    ----------
    text : str
        ``position``, ``energy``, ``probes`` (all of the scene's) or names of probes, separated by commas.
    probes : iterable of str
        The scene's.

    Raises
    ------
    InputError
        For an unknown one, one given twice, or probes where the scene has none.
    """
    key, every = "--quantities", [probe_quantity(name) for name in probes]
    known = {quantity.probe: [quantity] for quantity in every}
    known |= {"position": [*POSITION], "energy": [ENERGY], "probes": every}
    words = [word.strip() for word in text.split(",")] if text.strip() else ["position", "energy", "probes"]
    found: list[Quantity] = []
    for word in words:
        if not word:
            raise InputError("has an empty name between its commas", key=key)
        if word not in known:
            raise InputError(f"unknown quantity '{word}', {suggest(word, known)}", key=key)
        if not known[word] and text.strip():
            raise InputError("the scene has no probes; add some, as in probes: {tip: {group: tip}}", key=key)
        if any(quantity in found for quantity in known[word]):
            raise InputError(f"names '{word}' twice", key=key)
        found += known[word]
    return found


REQUEST_FILE = "request.json"


@dataclass(frozen=True)
class Request:
    """A study as asked for.

    Attributes
    ----------
    scene : str
        Path of the scene.
    settings : tuple of str
        ``--set``.
    vary : tuple of str
        ``--vary``; empty: the default sweep.
    reference : str
        ``auto``, ``exact:NAME`` or ``run:DIR``.
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
        """The scene with its settings and further overrides, without what a study need not write.

        Raises
        ------
        InputError
            If they do not go together.
        """
        given = (*self.settings, *LEAN, *overrides)
        return scene_of(self.scene, given, trust_mesh=self.trust_mesh)


def read_request(folder: Path) -> Request:
    """The request that a study's folder was begun with.

    Raises
    ------
    InputError
        If there is none, or it cannot be read.
    """
    path = folder / REQUEST_FILE
    try:
        return load_record(path, Request)
    except OSError as error:
        raise InputError(f"cannot be read: {reason(error)}", file=path, key="--resume") from None
    except ValueError:
        raise InputError("is damaged; begin the study anew with --force", file=path, key="--resume") from None


AUTO_STEPS = 200.0
"""Steps that a run with automatic ones is guessed to take, for the time left."""

LANDING = 1e-6
"""Fraction of Δt by which a multiple of it may miss a sample time."""

FIXED_BY = {
    "time.step": STEP_OPTIONS,
    "time.integrator": ("ts_type",),
    "time.tolerance": STEP_OPTIONS,
}
"""PETSc options that would override what an axis varies."""


@dataclass
class Plan:
    """What a study will do.

    Attributes
    ----------
    request : Request
    base : Scene
    axes : list of Axis
    combinations : list of Combination
    quantities : list of Quantity
    end : float
        Last time [s]; of a static analysis, load factor.
    every : float
        Time between samples [s]; the end is sampled too.
    notes : list of str
        What the user should know.
    """

    request: Request
    base: Scene
    axes: list[Axis]
    combinations: list[Combination]
    quantities: list[Quantity]
    end: float
    every: float
    notes: list[str] = field(default_factory=list)

    def axis(self, path: str) -> Axis | None:
        """The axis that varies a key of the scene."""
        return next((axis for axis in self.axes if axis.path == path), None)

    def sample_times(self) -> list[float]:
        """[s], ascending, from 0 to the end."""
        count = math.floor(self.end / self.every * (1.0 + LANDING))
        times = [number * self.every for number in range(count + 1)]
        return times if self.end - times[-1] <= LANDING * self.every else [*times, self.end]

    def overrides(self, chosen: Choice) -> tuple[str, ...]:
        """What makes the scene with these values of axes, and with what the whole study sets."""
        further = f"output.every={self.every!r}", *overrides(self.base, chosen)
        return (*self.request.settings, *LEAN, *further)

    def scene(self, case: StudyCase) -> Scene:
        """The scene of a case.

        Raises
        ------
        InputError
            If its settings do not go together.
        """
        return scene_of(self.request.scene, case.overrides, trust_mesh=self.request.trust_mesh)


def make_plan(request: Request) -> Plan:
    """Plan a requested study; reads the scene and its meshes, runs and writes nothing. For rank 0.

    Raises
    ------
    InputError
        Whatever in the request, the scene or its meshes cannot be used.
    """
    if request.repeats < 1:
        raise InputError(f"must be at least 1, not {request.repeats}", key="--repeats")
    axes = parse_axes(request.vary)
    base = request.with_changes([])
    quantities = chosen(request.quantities, base.probes)
    notes: list[str] = []
    axes = axes or default_axes(base, notes)
    for axis in axes:
        if axis.path in ("output.every", "time.end", "time.analysis"):
            raise InputError("decides when errors are sampled and cannot vary", key=f"--vary {axis.key}")
        _refuse_fixed(axis)
        _check_alone(request, base, axis)
        if axis.path == "mesh":
            notes += _numbered_vertices(base)
    end = petsc_number("ts_max_time", base.time.end)
    every = _sampling(base, axes, end, notes)
    plan = Plan(request, base, axes, combinations(axes), quantities, end, every, notes)
    plan.combinations = [_timed(plan, combination) for combination in plan.combinations]
    return plan


def _timed(plan: Plan, combination: Combination) -> Combination:
    """The combination with what it takes to run it."""
    settings = {axis.path: value for axis, value in combination.chosen}
    step = settings.get("time.step", plan.base.time.step)
    if isinstance(step, str) or "time.tolerance" in settings:
        step = plan.end / AUTO_STEPS
    weight = plan.request.repeats / step / float(settings.get("mesh", 1.0)) ** 2
    words = (value for value in combination.values if isinstance(value, str))
    return replace(
        combination,
        overrides=plan.overrides(combination.chosen),
        weight=weight,
        repeats=plan.request.repeats,
        kernels=("combination", *words),
    )


def default_axes(base: Scene, notes: list[str]) -> list[Axis]:
    """Without ``--vary``: integrators and halved steps (or tolerances); for an equilibrium, meshes."""
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
    return count >= 1.0 - LANDING and abs(count - round(count)) <= LANDING * max(1.0, count)


def _sampling(base: Scene, axes: Sequence[Axis], end: float, notes: list[str]) -> float:
    """Time between samples [s]; tells of steps that do not fit in."""
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


def _numbered_vertices(base: Scene) -> list[str]:
    """A note on vertices picked by number, which differ from mesh to mesh."""
    picked = [f"handles[{i}]" for i, handle in enumerate(base.handles) if handle.nodes is not None]
    picked += [f"loads[{i}]" for i, load in enumerate(base.loads) if load.nodes is not None]
    picked += [f"probes.{name}" for name, probe in base.probes.items() if probe.nodes is not None]
    words = "vertices picked by number are others on another mesh; use group or box"
    return [f"{', '.join(picked)}: {words}"] if picked else []


def _refuse_fixed(axis: Axis) -> None:
    """An option on the command line wins over the scene, and the axis would vary nothing."""
    option = (axis.path.removeprefix("petsc."),) if axis.path.startswith("petsc.") else ()
    for name in filter(is_set, FIXED_BY.get(axis.path, option)):
        raise InputError(
            f"-{name} on the command line (or in PETSC_OPTIONS, .petscrc) would fix what varies; "
            "leave it out",
            key=f"--vary {axis.key}",
        )


def _check_alone(request: Request, base: Scene, axis: Axis) -> None:
    """Each value must be possible by itself; conflicts in combination are reported in the row."""
    seen: dict[tuple[str, ...], Value] = {}
    for value in axis.values:
        found = overrides(base, [(axis, value)])
        try:
            request.with_changes(found)
        except InputError:
            # a value may be allowed beside those of other axes only
            if len(request.vary) <= 1 or axis.path != "time.spectral_radius":
                raise
        if axis.path == "mesh" and (other := seen.setdefault(tuple(found), value)) != value:
            raise InputError(f"{other:g} and {value:g} m give the same grid", key=f"--vary {axis.key}")
