"""A fit as a whole: a scene with a block ``fit`` → numbers with intervals, kept on disk as it goes."""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.experiments.case import Watch, load_record, save_record
from lyra_petsc.experiments.fit.estimate import Conclusion, Trial, Unknown, conclude, refuse_idle, search
from lyra_petsc.experiments.fit.model import Model, check_keys
from lyra_petsc.experiments.fit.readings import Reading, readings_of
from lyra_petsc.output.run_folder import FolderKind
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.schema import Scene

Array = NDArray[np.float64]

TRIALS_FILE = "trials.json"

FARTHEST = 1e8
"""Uncertainties by which a start may miss a measurement: beyond, rounding errors of a simulation count."""


def _resumable(folder: Path) -> list[Path]:
    """The evaluations from which a fit can go on."""
    return [file for file in [folder / TRIALS_FILE] if file.is_file()]


FIT = FolderKind(
    "fit",
    Path("fits"),
    "fit.lock",
    re.compile(r"(trials\.json|fit\.(csv|json)|report\.(html|md)|[\w-]+\.(png|svg))(\.part)?"),
    _resumable,
    "no evaluations to go on from",
    folders=("plots",),
)


@dataclass
class Trials:
    """The evaluations of a fit, as they are kept.

    Attributes
    ----------
    fingerprint : str
        Of everything they depend on.
    """

    fingerprint: str
    trials: list[Trial] = field(default_factory=list)


class Observer:
    """Is told how far a fit is; to be overridden."""

    def trial(self, number: int, trial: Trial, *, resumed: bool) -> None:
        """An evaluation has ended, or was found on disk."""

    def progress(self, number: int, part: float) -> None:
        """Which part of an evaluation is done."""


@dataclass
class Fitted:
    """What came of a fit.

    Attributes
    ----------
    unknowns : list of Unknown
    conclusion : Conclusion
    readings : list of Reading
    before, after : (m,)
        Values of the readings at the start and at the end.
    trials : list of Trial
    words : str
        How the search ended.
    shapes : tuple of (V, 3) or None
        Positions [m] at the last measurement, before and after, on rank 0.
    triangles : (F, 3) or None
        On rank 0.
    runs : int
        Simulations, those with derivatives once.
    seconds : float
        Wall time.
    """

    unknowns: list[Unknown]
    conclusion: Conclusion
    readings: list[Reading]
    before: Array
    after: Array
    trials: list[Trial]
    words: str
    shapes: tuple[Array | None, Array | None]
    triangles: NDArray[np.int64] | None
    runs: int
    seconds: float

    @property
    def parameters(self) -> dict[str, float]:
        """The numbers found, by their keys: what ``Scene.changed`` takes."""
        return {estimate.key: estimate.value for estimate in self.conclusion.estimates}

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """Their 95 % intervals."""
        return {estimate.key: estimate.interval for estimate in self.conclusion.estimates}

    @property
    def measured(self) -> Array:
        """(m,)"""
        return np.concatenate([reading.measured for reading in self.readings])

    @property
    def uncertainty(self) -> Array:
        """(m,)"""
        return np.concatenate([reading.uncertainty for reading in self.readings])

    @property
    def labels(self) -> list[str]:
        """Of the m values."""
        return [label for reading in self.readings for label in reading.labels]

    @property
    def sensitivity(self) -> Array:
        """(m, n) of each value, in its uncertainties, to a change of each number by its size."""
        size = np.array([unknown.size for unknown in self.unknowns])
        best = min(self.trials, key=lambda trial: trial.cost)
        scaled: Array = best.jacobian * size
        return scaled


def unknowns_of(scene: Scene) -> list[Unknown]:
    """The numbers that a scene wants to be found.

    Raises
    ------
    InputError
        Without a block ``fit``, or where a key is no number of the scene.
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
    observer: Observer | None = None,
    measured: Sequence[Array] | None = None,
) -> Fitted:
    """Find the numbers that a scene's block ``fit`` names; collective.

    Parameters
    ----------
    comm : MPI.Comm
    scene : Scene
    folder : Path, optional
        Where evaluations are kept; those that are there are not made again.
    watch : callable
        Called before every step.
    observer : Observer, optional
    measured : sequence of arrays, optional
        In place of the measured values of each reading, in their order.

    Raises
    ------
    InputError
        What cannot be fitted.
    SolverError
        A simulation that failed.
    """
    began = time.monotonic()
    seen = observer or Observer()
    unknowns = on_root(comm, lambda: unknowns_of(scene))
    assert scene.fit is not None
    readings = on_root(comm, lambda: readings_of(scene, scene.fit.measurements if scene.fit else ()))
    model = Model(comm, scene, {unknown.key: unknown.size for unknown in unknowns}, readings, watch)
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
    kept = Trials(_fingerprint(scene, target, sigma))
    if folder is not None:
        path = folder / TRIALS_FILE
        kept = on_root(comm, lambda: _read(path, kept))
    stored = {trial.numbers.tobytes(): trial for trial in kept.trials}
    trials: list[Trial] = []
    shapes: dict[bytes, Array | None] = {}

    def evaluate(numbers: Array) -> Trial:
        numbers = comm.bcast(numbers)
        number = len(trials) + 1
        trial = stored.get(numbers.tobytes())
        resumed = trial is not None
        if trial is None:
            found = model.evaluate(numbers.tolist(), progress=lambda part: seen.progress(number, part))
            assert found.jacobian is not None
            # decisions are one rank's
            trial = comm.bcast(
                Trial(numbers, (found.values - target) / sigma, found.jacobian / sigma[:, None])
            )
            shapes[numbers.tobytes()] = model.shape
            if number == 1:
                refuse_idle(unknowns, trial, scene.source)
                _refuse_far(model.readings, trial, scene)
            if folder is not None:
                kept.trials.append(trial)
                on_root(comm, lambda: save_record(folder / TRIALS_FILE, kept))
        trials.append(trial)
        seen.trial(number, trial, resumed=resumed)
        return trial

    best, words = search(unknowns, evaluate)
    first = trials[0]
    for trial in (first, best):
        if trial.numbers.tobytes() not in shapes:
            model.evaluate(trial.numbers.tolist(), derivatives=False)
            shapes[trial.numbers.tobytes()] = model.shape
    return Fitted(
        unknowns,
        conclude(unknowns, best),
        model.readings,
        first.residuals * sigma + target,
        best.residuals * sigma + target,
        trials,
        words,
        (shapes[first.numbers.tobytes()], shapes[best.numbers.tobytes()]),
        None if model.mesh is None else model.mesh.triangles,
        model.runs,
        time.monotonic() - began,
    )


def _refuse_far(readings: Sequence[Reading], trial: Trial, scene: Scene) -> None:
    """Refuse measurements whose squares are no numbers, or leave none to all others."""
    keys = [reading.key for reading in readings for _ in reading.parts]
    worst = int(np.argmax(np.abs(trial.residuals)))
    if not abs(trial.residuals[worst]) < FARTHEST:
        raise InputError(
            f"is missed by {abs(trial.residuals[worst]):.2g} uncertainties; check value and uncertainty, "
            "and their units",
            file=scene.source,
            key=keys[worst],
        )


def _fingerprint(scene: Scene, target: Array, sigma: Array) -> str:
    text = dump_scene(scene) + json.dumps([target.tolist(), sigma.tolist()])
    return hashlib.sha256(text.encode()).hexdigest()


def _read(path: Path, new: Trials) -> Trials:
    """The evaluations in a file, if they are of the same fit."""
    if not path.is_file():
        return new
    try:
        found = load_record(path, Trials)
    except (OSError, ValueError):
        raise InputError("cannot be read; begin anew with --force", file=path) from None
    if found.fingerprint != new.fingerprint:
        raise InputError(
            "holds evaluations of another scene or other measurements; begin anew with --force, or name "
            "another folder",
            file=path,
        )
    for trial in found.trials:
        for name in ("numbers", "residuals", "jacobian"):
            setattr(trial, name, np.asarray(getattr(trial, name), dtype=np.float64))
    return found
