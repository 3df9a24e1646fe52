"""``lyra_petsc.fit`` and ``lyra_petsc.gradient``."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.api.scenes import SceneLike, load
from lyra_petsc.errors import InputError, in_python
from lyra_petsc.experiments.fit.model import Model, check_keys, value_of
from lyra_petsc.experiments.fit.readings import readings_without_values
from lyra_petsc.experiments.fit.work import FIT, Fitted, fit_scene
from lyra_petsc.output.run_folder import RunDirectory, choose
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.fit_block import Quantity
from lyra_petsc.scene.messages import checked
from lyra_petsc.scene.overrides import plain
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.values import shown

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Gradient:
    """A quantity and its derivatives.

    Attributes
    ----------
    labels : tuple of str
        Of its m values.
    value : (m,)
        In its unit.
    derivatives : dict of str to (m,)
        By each number of the scene, over the number's unit.
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
    """Derivatives of what a simulation ends in with respect to numbers of its scene; collective.

    ::

        lyra_petsc.gradient("flag.yaml", {"probe": "corner", "axes": ["z"]}, ["material.bending"])

    Parameters
    ----------
    scene : Scene, path or mapping
    quantity : str or mapping
        What a measurement of a scene's block ``fit`` can say beside its values: probe, points, overhang,
        drape or force, with axes and at; or the name of a probe.
    parameters : sequence of str, or mapping of str to float
        Keys of the numbers, as in ``material.bending``; or also their values, in place of the scene's.

    Raises
    ------
    InputError
        What the scene does not have.
    SolverError
        If the simulation fails.
    """
    comm = MPI.COMM_WORLD if comm is None else comm
    with in_python():
        loaded = on_root(comm, lambda: load(scene, trust_mesh=trust_mesh))

        def prepare() -> Any:
            values = _values(loaded, parameters)
            return readings_without_values(loaded, _quantity(quantity)), values

        readings, values = on_root(comm, prepare)
        sizes = {key: abs(value) or 1.0 for key, value in values.items()}
        model = Model(comm, loaded, sizes, readings)
        found = model.evaluate(list(values.values()))
        assert found.jacobian is not None
        columns = dict(zip(values, found.jacobian.T, strict=True))
        return Gradient(tuple(model.labels), found.values, columns)


def _quantity(quantity: Any) -> Quantity:
    asked = {"probe": quantity} if isinstance(quantity, str) else quantity
    try:
        return checked(Quantity, asked, file=None, context={"directory": Path.cwd()})
    except InputError as error:
        key = ".".join(part for part in ("quantity", error.key) if part)
        raise InputError(error.message, key=key) from None


def _values(scene: Scene, parameters: Any) -> dict[str, float]:
    """The numbers by their keys, those that are given and those of the scene."""
    whole = isinstance(parameters, str) or not isinstance(parameters, Iterable)
    keys = [] if whole else list(dict.fromkeys(parameters))
    if not keys or not all(isinstance(key, str) for key in keys):
        raise InputError(
            f"must be keys as in ['material.bending'], not {shown(parameters)}", key="parameters"
        )
    check_keys(scene, keys, at="parameters")
    given = parameters if isinstance(parameters, Mapping) else {}
    values = {}
    for key in keys:
        value = plain(given[key]) if key in given else value_of(scene, key, at="parameters")
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
    """Find the numbers that a scene's block ``fit`` names; collective.

    Parameters
    ----------
    scene : Scene, path or mapping
    out : path, optional
        Folder in which evaluations are kept, so that ``resume`` goes on with them; without, in memory.
    force, resume, trust_mesh
        As of `lyra_petsc.run`.

    Returns
    -------
    Fitted
        ``parameters`` are the numbers found, ``intervals`` their 95 % intervals, ``conclusion`` all else.

    Raises
    ------
    InputError
        What cannot be fitted.
    SolverError
        If a simulation fails.
    """
    comm = MPI.COMM_WORLD if comm is None else comm
    with in_python():
        loaded = on_root(comm, lambda: load(scene, trust_mesh=trust_mesh))
        if out is None:
            if resume:
                raise InputError("needs the folder, out, that holds evaluations", key="resume")
            return fit_scene(comm, loaded)
        choice = choose(comm, "scene", out, force=force, resume=resume, kind=FIT)
        with RunDirectory(comm, choice) as directory:
            directory.clean()
            return fit_scene(comm, loaded, folder=directory.path)
