"""A study worked out before anything runs: combinations, their scenes, sample times, what is measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from lyra_petsc.errors import InputError
from lyra_petsc.experiments.study.axes import Axis, Value, parse_axes
from lyra_petsc.experiments.study.combination import (
    Combination,
    combinations,
    mesh_overrides,
    overrides,
)
from lyra_petsc.experiments.study.quantities import Quantity, chosen
from lyra_petsc.experiments.study.request import Request
from lyra_petsc.linear.petsc_options import is_set, petsc_number
from lyra_petsc.mesh.build import mesh_of
from lyra_petsc.mesh.measures import mean_edge_length
from lyra_petsc.scene.schema import INTEGRATORS, Scene
from lyra_petsc.show.report.numbers import seconds

LANDING = 1e-6
"""Fraction of Δt by which a multiple of it may miss a sample time."""

FIXED_BY = {
    "time.step": ("ts_dt",),
    "time.integrator": ("ts_type",),
    "time.tolerance": ("ts_dt",),
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

    @property
    def static(self) -> bool:
        """Whether the scene asks for an equilibrium."""
        return is_static(self.base)

    def axis(self, path: str) -> Axis | None:
        """The axis that varies a key of the scene."""
        return next((axis for axis in self.axes if axis.path == path), None)

    def sample_times(self) -> list[float]:
        """[s], ascending, from 0 to the end."""
        count = math.floor(self.end / self.every * (1.0 + LANDING))
        times = [number * self.every for number in range(count + 1)]
        return times if self.end - times[-1] <= LANDING * self.every else [*times, self.end]

    def overrides(self, combination: Combination) -> list[str]:
        """What makes the combination of the study's scene."""
        further = overrides(self.base, combination.axes, combination.values)
        return [f"output.every={self.every!r}", *further]

    def scene(self, combination: Combination) -> Scene:
        """The scene of a combination.

        Raises
        ------
        InputError
            If its settings do not go together.
        """
        return self.request.with_changes(self.overrides(combination))


def is_static(scene: Scene) -> bool:
    """Whether a scene asks for an equilibrium."""
    return scene.time.analysis == "static"


def make_plan(request: Request) -> Plan:
    """Work a request out; reads the scene and its meshes, runs and writes nothing. For rank 0.

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
    if not axes:
        axes = default_axes(base, notes)
    for axis in axes:
        if axis.path in ("output.every", "time.end", "time.analysis"):
            raise InputError("decides when errors are sampled and cannot vary", key=f"--vary {axis.key}")
        _refuse_fixed(axis)
        _check_alone(request, base, axis)
        if axis.path == "mesh":
            notes += _numbered_vertices(base)
    end = petsc_number("ts_max_time", base.time.end)
    every = _sampling(base, axes, end, notes)
    return Plan(request, base, axes, combinations(axes), quantities, end, every, notes)


def default_axes(base: Scene, notes: list[str]) -> list[Axis]:
    """Without ``--vary``: integrators and halved steps (or tolerances); for an equilibrium, meshes."""
    if is_static(base):
        size = mean_edge_length(mesh_of(base))
        h = float(f"{_given_size(base) or size:.3g}")
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


def _given_size(base: Scene) -> float | None:
    source = base.mesh[0]
    if source.grid is not None:
        return source.grid.width / source.grid.nx
    return source.size


def _divides(step: float, every: float) -> bool:
    count = every / step
    return count >= 1.0 - LANDING and abs(count - round(count)) <= LANDING * max(1.0, count)


def _sampling(base: Scene, axes: Sequence[Axis], end: float, notes: list[str]) -> float:
    """Time between samples [s]; tells of steps that do not fit in."""
    if is_static(base):
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
    """A note on vertices picked by number, which are others on another mesh."""
    picked = [f"handles[{i}]" for i, handle in enumerate(base.handles) if handle.nodes is not None]
    picked += [f"loads[{i}]" for i, load in enumerate(base.loads) if load.nodes is not None]
    picked += [f"probes.{name}" for name, probe in base.probes.items() if probe.nodes is not None]
    if not picked:
        return []
    listed = ", ".join(picked)
    return [f"{listed}: vertices picked by number are others on another mesh; use group or box"]


def _refuse_fixed(axis: Axis) -> None:
    """An option on the command line wins over the scene, and the axis would vary nothing."""
    names = FIXED_BY.get(axis.path, ())
    if axis.path.startswith("petsc."):
        names = (axis.path.removeprefix("petsc."),)
    for name in names:
        if is_set(name):
            raise InputError(
                f"-{name} on the command line (or in PETSC_OPTIONS, .petscrc) would fix what varies; "
                "leave it out",
                key=f"--vary {axis.key}",
            )


def _check_alone(request: Request, base: Scene, axis: Axis) -> None:
    """Each value must be possible by itself; conflicts in combination are reported in the row."""
    seen: dict[tuple[str, ...], Value] = {}
    for value in axis.values:
        found = overrides(base, [axis], [value])
        try:
            request.with_changes(found)
        except InputError as error:
            if not _needs_company(request, axis):
                raise
            del error
        if axis.path == "mesh":
            other = seen.setdefault(tuple(found), value)
            if other != value:
                raise InputError(f"{other:g} and {value:g} m give the same grid", key=f"--vary {axis.key}")


def _needs_company(request: Request, axis: Axis) -> bool:
    """Whether a value may be allowed beside those of other axes only."""
    return len(request.vary) > 1 and axis.path == "time.spectral_radius"
