"""Fits the numbers of a scene with a block ``fit``; evaluations are stored, so that a fit can be resumed.

Also ``lyra_petsc.fit`` and ``lyra_petsc.gradient``.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from lyra_petsc.api.scenes import SceneLike, load
from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError, python_argument_names
from lyra_petsc.experiments.case import Watch, load_record, save_record
from lyra_petsc.experiments.fit.estimate import (
    Conclusion,
    Misfit,
    Unknown,
    conclude,
    refuse_insensitive,
    search,
)
from lyra_petsc.experiments.fit.model import Model, check_keys, value_of
from lyra_petsc.experiments.fit.readings import Reading, readings_of, readings_without_values
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.mesh.select import select_triangles
from lyra_petsc.mesh.topology import connected_pieces
from lyra_petsc.output.run_folder import FolderKind, RunDirectory, choose_folder
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.fit_block import Quantity
from lyra_petsc.scene.materials.library import resolve_material
from lyra_petsc.scene.messages import validated
from lyra_petsc.scene.overrides import plain
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.values import shown

TRIALS_FILE = "trials.json"


FIT = FolderKind(
    "fit",
    Path("fits"),
    re.compile(r"(trials\.json|fit\.(csv|json)|report\.(html|md)|[\w-]+\.(png|svg))(\.part)?"),
    (TRIALS_FILE,),
    "no evaluations to go on from",
    folders=("plots",),
)


@dataclass
class StoredEvaluations:
    """The evaluations of a fit as stored in its folder.

    Attributes
    ----------
    fingerprint : str
        Digest of everything that they depend on.
    trials : list of Misfit
    """

    fingerprint: str
    trials: list[Misfit] = field(default_factory=list)


class FitObserver:
    """Is notified of the progress of a fit; to be overridden."""

    def evaluated(self, number: int, evaluation: Misfit, *, resumed: bool) -> None:
        """An evaluation has ended, or was found on disk."""

    def progress(self, number: int, part: float) -> None:
        """Completed fraction of an evaluation."""


@dataclass
class Fitted:
    """The result of a fit.

    Attributes
    ----------
    unknowns : list of Unknown
    conclusion : Conclusion
    readings : list of Reading
    before, after : (m,)
        Values of the readings at the start and at the end.
    evaluations : list of Misfit
    ending : str
        Text on how the search ended.
    shapes : tuple of (V, 3) or None
        Positions [m] at the last measurement, before and after, on rank 0.
    triangles : (F, 3) or None
        On rank 0.
    runs : int
        Number of simulations; one with derivatives counts once.
    seconds : float
        Wall time.
    """

    unknowns: list[Unknown]
    conclusion: Conclusion
    readings: list[Reading]
    before: Array
    after: Array
    evaluations: list[Misfit]
    ending: str
    shapes: tuple[Array | None, Array | None]
    triangles: Ints | None
    runs: int
    seconds: float

    @property
    def parameters(self) -> dict[str, float]:
        """The fitted numbers by their keys, as for ``Scene.changed``."""
        return {estimate.key: estimate.value for estimate in self.conclusion.estimates}

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """The 95 % intervals by keys."""
        return {estimate.key: estimate.interval for estimate in self.conclusion.estimates}

    @property
    def measured(self) -> Array:
        """Measured values (m,)."""
        return np.concatenate([reading.measured for reading in self.readings])

    @property
    def uncertainty(self) -> Array:
        """Standard deviations (m,) of the measured values."""
        return np.concatenate([reading.uncertainty for reading in self.readings])

    @property
    def labels(self) -> list[str]:
        """Labels of the m values."""
        return [label for reading in self.readings for label in reading.labels]

    @property
    def sensitivity(self) -> Array:
        """Derivatives (m, n) of each value over its uncertainty, by each number over its size."""
        size = np.array([unknown.size for unknown in self.unknowns])
        best = min(self.evaluations, key=lambda evaluation: evaluation.cost)
        return best.jacobian * size


def unknowns_of(scene: Scene) -> list[Unknown]:
    """The numbers to be fitted of a scene.

    Raises
    ------
    InputError
        If there is no block ``fit``, or a key is not a number of the scene.
    """
    if scene.fit is None:
        raise InputError(
            "has no block fit; add one with parameters and measurements", file=scene.source, key="fit"
        )
    parameters = scene.fit.parameters
    check_keys(scene, list(parameters), at="fit.parameters")
    for key, parameter in parameters.items():
        for value in (parameter.start, *parameter.bounds):
            try:
                scene.changed({key: value})
            except InputError as error:
                at = "" if error.key is None or error.key.startswith(key) else f"{error.key}: "
                raise InputError(
                    f"{value:g} cannot be taken there: {at}{error.message}",
                    file=scene.source,
                    key=f"fit.parameters.{key}",
                ) from None
    return [Unknown(key, p.start, *p.bounds) for key, p in parameters.items()]


def fit_scene(
    comm: MPI.Comm,
    scene: Scene,
    *,
    folder: Path | None = None,
    watch: Watch = lambda: None,
    observer: FitObserver | None = None,
    measured: Sequence[Array] | None = None,
) -> Fitted:
    """Fit the numbers that the block ``fit`` of a scene names; collective.

    Parameters
    ----------
    comm : MPI.Comm
    scene : Scene
    folder : Path, optional
        Folder in which evaluations are stored; stored ones are not repeated.
    watch : callable
        Called before every step.
    observer : FitObserver, optional
    measured : sequence of arrays, optional
        Replacements of the measured values of each reading, in their order.

    Raises
    ------
    InputError
        For a scene that cannot be fitted.
    SolverError
        If a simulation fails.
    """
    began = time.monotonic()
    listener = observer or FitObserver()
    unknowns = on_root(comm, lambda: unknowns_of(scene))
    assert scene.fit is not None
    readings = on_root(comm, lambda: readings_of(scene, scene.fit.measurements if scene.fit else ()))
    model = Model(comm, scene, {unknown.key: unknown.size for unknown in unknowns}, readings, watch)
    mesh_bends = on_root(comm, lambda: _bending_of_mesh(scene, unknowns, model))
    if measured is not None:
        for reading, values in zip(model.readings, measured, strict=True):
            reading.measured = np.asarray(values, dtype=np.float64)
    target = np.concatenate([reading.measured for reading in model.readings])
    sigma = np.concatenate([reading.uncertainty for reading in model.readings])
    if len(target) < len(unknowns):
        raise InputError(
            f"{len(target)} values cannot tell {len(unknowns)} numbers; measure more, or fix some",
            file=scene.source,
            key="fit.measurements",
        )
    kept = StoredEvaluations(_fingerprint(scene, target, sigma))
    if folder is not None:
        path = folder / TRIALS_FILE
        kept = on_root(comm, lambda: _read(path, kept))
    stored = {evaluation.numbers.tobytes(): evaluation for evaluation in kept.trials}
    evaluations: list[Misfit] = []
    shapes: dict[bytes, Array | None] = {}

    def evaluate(numbers: Array) -> Misfit:
        numbers = comm.bcast(numbers)
        number = len(evaluations) + 1
        evaluation = stored.get(numbers.tobytes())
        resumed = evaluation is not None
        if evaluation is None:
            values = model.evaluate(numbers.tolist(), progress=lambda part: listener.progress(number, part))
            assert values.jacobian is not None
            # all ranks use the numbers of rank 0, bit by bit
            evaluation = comm.bcast(
                Misfit(numbers, (values.values - target) / sigma, values.jacobian / sigma[:, None])
            )
            shapes[numbers.tobytes()] = model.shape
            if number == 1:
                refuse_insensitive(unknowns, evaluation, scene.source)
                _refuse_large_residuals(model.readings, evaluation, scene)
            if folder is not None:
                kept.trials.append(evaluation)
                on_root(comm, lambda: save_record(folder / TRIALS_FILE, kept))
        evaluations.append(evaluation)
        listener.evaluated(number, evaluation, resumed=resumed)
        return evaluation

    best, ending = search(unknowns, evaluate)
    first = evaluations[0]
    for evaluation in (first, best):
        if evaluation.numbers.tobytes() not in shapes:
            model.evaluate(evaluation.numbers.tolist(), derivatives=False)
            shapes[evaluation.numbers.tobytes()] = model.shape
    conclusion = conclude(unknowns, best)
    conclusion.notes += mesh_bends
    return Fitted(
        unknowns,
        conclusion,
        model.readings,
        first.residuals * sigma + target,
        best.residuals * sigma + target,
        evaluations,
        ending,
        (shapes[first.numbers.tobytes()], shapes[best.numbers.tobytes()]),
        None if model.mesh is None else model.mesh.triangles,
        model.runs,
        time.monotonic() - began,
    )


def _bending_of_mesh(scene: Scene, unknowns: Sequence[Unknown], model: Model) -> list[str]:
    """Notes on numbers that change the bending of hinges, which depends on the shape of the cells.

    Raises
    ------
    InputError
        On a strip, where it is another stiffness than the one that is found.
    """
    notes = []
    for unknown in unknowns:
        ends = [scene.changed({unknown.key: value}) for value in (unknown.low, unknown.high)]
        for number, blocks in enumerate(zip(*(end.material for end in ends), strict=True)):
            one, other = (resolve_material(block, file=scene.source)[0] for block in blocks)
            if one.model != "hinge" or one.bending == other.bending:
                continue
            assert model.mesh is not None
            hangs = any(reading.kind == "overhang" for reading in model.readings)
            if hangs or _has_strip(model.mesh, blocks[0].group):
                scaled = blocks[0].bending_scale != 1.0 and "bending_scale" not in unknown.key
                raise InputError(
                    "hinges bend a strip by the shape of its cells, so that the number would be wrong; add "
                    f"'bending_model: midedge' to material[{number}]"
                    + (", and take out bending_scale" if scaled else ""),
                    file=scene.source,
                    key=f"fit.parameters.{unknown.key}",
                )
            notes.append(
                f"{unknown.key} is that of hinges on this mesh: they bend by the shape of the cells; "
                "'bending_model: midedge' does not"
            )
    return notes


def _has_strip(mesh: Mesh, group: str | None) -> bool:
    """Whether a piece of a group of triangles, by default of all, is a strip."""
    triangles = mesh.triangles[select_triangles(mesh, group, key="material.group")]
    piece = connected_pieces(triangles)
    for number in np.unique(piece):
        points = mesh.rest[np.unique(triangles[piece == number])]
        axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
        length, width = np.ptp(points @ axes[:2].T, axis=0)
        # length over width of a strip
        if length >= 2.0 * width:
            return True
    return False


def _refuse_large_residuals(readings: Sequence[Reading], evaluation: Misfit, scene: Scene) -> None:
    """Refuse measurements whose residuals at the start are not finite, or dominate all others."""
    keys = [reading.key for reading in readings for _ in reading.parts]
    worst = int(np.argmax(np.abs(evaluation.residuals)))
    # largest residual of the start in uncertainties; beyond it round-off of a simulation would matter
    if not abs(evaluation.residuals[worst]) < 1e8:
        raise InputError(
            f"is missed by {abs(evaluation.residuals[worst]):.2g} uncertainties; check value, uncertainty "
            "and their units",
            file=scene.source,
            key=keys[worst],
        )


def _fingerprint(scene: Scene, target: Array, sigma: Array) -> str:
    text = dump_scene(scene) + json.dumps([target.tolist(), sigma.tolist()])
    return hashlib.sha256(text.encode()).hexdigest()


def _read(path: Path, new: StoredEvaluations) -> StoredEvaluations:
    """Read the stored evaluations, which must be of the same fit."""
    if not path.is_file():
        return new
    try:
        stored = load_record(path, StoredEvaluations)
    except (OSError, ValueError):
        raise InputError("cannot be read; begin anew with --force", file=path) from None
    if stored.fingerprint != new.fingerprint:
        raise InputError(
            "holds evaluations of another scene or other measurements; begin anew with --force, or name "
            "another folder",
            file=path,
        )
    return stored


@dataclass(frozen=True)
class Gradient:
    """A quantity and its derivatives.

    Attributes
    ----------
    labels : tuple of str
        Labels of its m values.
    value : (m,)
        Values in the unit of the quantity.
    derivatives : dict of str to (m,)
        Derivatives with respect to each number of the scene, by key.
    """

    labels: tuple[str, ...]
    value: Array
    derivatives: dict[str, Array]


def gradient(
    scene: SceneLike,
    quantity: str | Mapping[str, Any],
    parameters: Sequence[str] | Mapping[str, float],
    *,
    comm: MPI.Comm | None = None,
    trust_mesh: bool = False,
) -> Gradient:
    """Derivatives of a result of a simulation with respect to numbers of its scene; collective.

    ::

        lyra_petsc.gradient("flag.yaml", {"probe": "corner", "axes": ["z"]}, ["material.bending"])

    Parameters
    ----------
    scene : Scene, path or mapping
    quantity : str or mapping
        A measurement as in the block ``fit`` of a scene, without values: probe, points, overhang, drape or
        force, with axes and at; or the name of a probe.
    parameters : sequence of str, or mapping of str to float
        Keys of the numbers, as in ``material.bending``, optionally with values that replace the scene's.

    Raises
    ------
    InputError
        For a quantity or number that the scene does not have.
    SolverError
        If the simulation fails.
    """
    comm = MPI.COMM_WORLD if comm is None else comm
    with python_argument_names():
        loaded = on_root(comm, lambda: load(scene, trust_mesh=trust_mesh))

        def prepare() -> Any:
            values = _values(loaded, parameters)
            return readings_without_values(loaded, _quantity(quantity)), values

        readings, values = on_root(comm, prepare)
        sizes = {key: abs(value) or 1.0 for key, value in values.items()}
        model = Model(comm, loaded, sizes, readings)
        evaluation = model.evaluate(list(values.values()))
        assert evaluation.jacobian is not None
        columns = dict(zip(values, evaluation.jacobian.T, strict=True))
        return Gradient(tuple(model.labels), evaluation.values, columns)


def _quantity(quantity: Any) -> Quantity:
    asked = {"probe": quantity} if isinstance(quantity, str) else quantity
    try:
        return validated(Quantity, asked, file=None, context={"directory": Path.cwd()})
    except InputError as error:
        key = ".".join(part for part in ("quantity", error.key) if part)
        raise InputError(error.message, key=key) from None


def _values(scene: Scene, parameters: Any) -> dict[str, float]:
    """The numbers by their keys, as given or from the scene."""
    whole = isinstance(parameters, str) or not isinstance(parameters, Iterable)
    keys = [] if whole else list(dict.fromkeys(parameters))
    if not keys or not all(isinstance(key, str) for key in keys):
        raise InputError(
            f"must be keys as in ['material.bending'], not {shown(parameters)}", key="parameters"
        )
    check_keys(scene, keys, at="parameters")
    replaced = parameters if isinstance(parameters, Mapping) else {}
    values = {}
    for key in keys:
        value = plain(replaced[key]) if key in replaced else value_of(scene, key, at="parameters")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"must be a number, not {shown(value)}", key=f"parameters.{key}")
        values[key] = float(value)
    scene.changed(values)
    return values


def fit(
    scene: SceneLike,
    out: str | os.PathLike[str] | None = None,
    *,
    force: bool = False,
    resume: bool = False,
    trust_mesh: bool = False,
    comm: MPI.Comm | None = None,
) -> Fitted:
    """Fit the numbers that the block ``fit`` of a scene names; collective.

    Parameters
    ----------
    scene : Scene, path or mapping
    out : path, optional
        Folder in which evaluations are stored, so that ``resume`` can continue; None: not stored.
    force, resume, trust_mesh
        As of `lyra_petsc.run`.

    Returns
    -------
    Fitted
        ``parameters`` are the fitted numbers, ``intervals`` their 95 % intervals, ``conclusion`` all else.

    Raises
    ------
    InputError
        For a scene that cannot be fitted.
    SolverError
        If a simulation fails.
    """
    comm = MPI.COMM_WORLD if comm is None else comm
    with python_argument_names():
        loaded = on_root(comm, lambda: load(scene, trust_mesh=trust_mesh))
        if out is None:
            if resume:
                raise InputError("needs the folder, out, that holds evaluations", key="resume")
            return fit_scene(comm, loaded)
        choice = choose_folder(comm, "scene", out, force=force, resume=resume, kind=FIT)
        with RunDirectory(comm, choice) as directory:
            directory.clean()
            return fit_scene(comm, loaded, folder=directory.path)
