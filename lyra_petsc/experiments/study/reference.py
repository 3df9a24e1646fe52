"""Which reference each physical scene of a study gets; decided before anything runs, on rank 0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lyra_petsc.errors import InputError
from lyra_petsc.experiments.exact.body import Body
from lyra_petsc.experiments.exact.motion import Motion
from lyra_petsc.experiments.exact.registry import SOLUTIONS, exact_motion, matching
from lyra_petsc.experiments.study.axes import Value
from lyra_petsc.experiments.study.combination import Combination, overrides
from lyra_petsc.experiments.study.plan import Plan
from lyra_petsc.experiments.study.samples import Surface, read_here, read_surface
from lyra_petsc.mesh.build import mesh_of
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.schema import Scene

Physics = tuple[tuple[str, Value], ...]
"""The settings that make a scene another one, in the axes' order."""

NUMERICAL_BLOCKS = {"time", "output", "solver", "petsc", "title", "probes"}
"""Keys in which the scene of a run to compare with may differ without a note."""


@dataclass(frozen=True)
class Chosen:
    """The reference of one physical scene.

    Attributes
    ----------
    kind : str
        ``exact``, ``run`` or ``finer``.
    words : str
        What it is; empty for ``finer`` until it is known which run it became.
    motion : Motion or None
    folder : Path or None
    notes : tuple of str
    """

    kind: str
    words: str = ""
    motion: Motion | None = None
    folder: Path | None = None
    notes: tuple[str, ...] = ()


def physics_of(combination: Combination) -> Physics:
    """Key of the physical scene that a combination belongs to."""
    return tuple(combination.physics.items())


def physical_overrides(plan: Plan, physics: Physics) -> list[str]:
    """What makes one physical scene of the study's scene, with what the whole study sets."""
    axes = [axis for axis in plan.axes if axis.physical]
    return [f"output.every={plan.every!r}", *overrides(plan.base, axes, [value for _, value in physics])]


def choose_references(plan: Plan) -> dict[Physics, Chosen]:
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
            found[physics] = Chosen("exact", _exact_words(name), motion)
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


def _automatic(scene: Scene) -> Chosen:
    if scene.handles or scene.loads:
        return Chosen("finer")  # no exact solution has any: the mesh need not be built to know
    body = Body(scene)
    solution = matching(body)
    if solution is None:
        return Chosen("finer")
    return Chosen("exact", _exact_words(solution.name), solution.motion(body))


def _of_run(plan: Plan, folder: Path, key: str) -> Chosen:
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
        built = Surface(mesh.rest, mesh.triangles, np.ones(mesh.n_vertices))
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
    return Chosen("run", f"run {folder}", folder=folder, notes=(*notes, *_differences(plan, folder)))


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
