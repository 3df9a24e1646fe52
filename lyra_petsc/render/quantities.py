"""What a sheet can be coloured by: one function and one line each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.nearest import nearest
from lyra_petsc.results.announced import MESH_FILE
from lyra_petsc.results.run import Run
from lyra_petsc.results.sequence import read_array

Array = NDArray[np.float64]

COVERED = 99.5
"""Percentage of the values of a state that its range covers: one bad corner must not bleach the rest."""


@dataclass(frozen=True)
class Quantity:
    """A number on every vertex or triangle of every state.

    Attributes
    ----------
    name : str
        As it is asked for.
    label : str
        Name and unit for the bar.
    on_triangles : bool
    signed : bool
        Its zero belongs in the middle of the colours.
    values : callable
        Number of a state → (V,) or (F,).
    """

    name: str
    label: str
    on_triangles: bool
    signed: bool
    values: Callable[[int], Array]

    def span(self, state: int) -> tuple[float, float]:
        """Lowest and highest value that the colours of one state should tell apart."""
        values = self.values(state)
        if self.signed:
            largest = float(np.percentile(np.abs(values), COVERED))
            return -largest, largest
        low, high = np.percentile(values, [100.0 - COVERED, COVERED])
        return float(low), float(high)


def quantity(run: Run, name: str) -> Quantity:
    """The quantity of that name.

    Raises
    ------
    InputError
        If there is none, or the states do not hold what it is made of.
    """
    if name in DERIVED:
        return DERIVED[name](run, name)
    if name not in run.fields:
        known = [*DERIVED, *run.fields]
        raise InputError(
            f"no field {name!r}, {nearest(name, known)}; a scene's output.fields names further ones",
            file=run.folder,
            key="--field",
        )
    stored = run.field(name)
    principal = name in _PRINCIPAL
    reduce = _largest_principal if principal else _magnitude
    label = _label(f"largest principal {name}" if principal else name, run.field_units(name))
    on_triangles = run.field_on(name) == "triangle"
    return Quantity(name, label, on_triangles, name in _SIGNED, lambda i: reduce(np.asarray(stored[i])))


_PRINCIPAL = {"green_strain", "stress"}
_SIGNED = {"curvature"}


def _speed(run: Run, name: str) -> Quantity:
    if "velocity" not in run.fields:
        raise InputError(
            f"{name} needs the velocities, which this run did not write; add velocity to the scene's "
            "output.fields, or show displacement or strain",
            file=run.folder,
            key="--field",
        )
    stored = run.field("velocity")
    return Quantity(name, _label("speed", "m/s"), False, False, lambda i: _magnitude(stored[i]))


def _displacement(run: Run, name: str) -> Quantity:
    start = run.positions[0]
    return Quantity(name, _label(name, "m"), False, False, lambda i: _magnitude(run.positions[i] - start))


def _strain(run: Run, name: str) -> Quantity:
    triangles, inverse = run.triangles, np.linalg.inv(_edges(material_coordinates(run)))

    def values(state: int) -> Array:
        # deformation gradient, (F, 3, 2): the edges now from those at rest
        gradient = _edges(run.positions[state][triangles]) @ inverse
        metric = np.swapaxes(gradient, 1, 2) @ gradient
        strain = 0.5 * (metric[:, [0, 1, 0], [0, 1, 1]] - np.array([1.0, 1.0, 0.0]))
        return 100.0 * _largest_principal(strain)

    return Quantity(name, _label("largest principal strain", "%"), True, False, values)


DERIVED: dict[str, Callable[[Run, str], Quantity]] = {
    "speed": _speed,
    "displacement": _displacement,
    "strain": _strain,
}
"""Quantities that need not be written by the run."""


def material_coordinates(run: Run) -> Array:
    """(F, 3, 2) coordinates of the triangles' corners in the cloth [m]: its ``vt``, or laid out flat."""
    try:
        uv = read_array(run.folder, (MESH_FILE, "mesh/uv"))
    except InputError:
        return read_array(run.folder, (MESH_FILE, "mesh/corner_uv"))
    return np.asarray(uv[run.triangles])


def _edges(corners: Array) -> Array:
    """(F, d, 2) two edges of each triangle as columns, from its corners (F, 3, d)."""
    return np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)


def _largest_principal(symmetric: Array) -> Array:
    """(F,) larger eigenvalue of 2 × 2 tensors given as uu, vv, uv (F, 3)."""
    uu, vv, uv = symmetric.T
    largest: Array = (uu + vv) / 2.0 + np.hypot((uu - vv) / 2.0, uv)
    return largest


def _magnitude(values: Array) -> Array:
    values = np.asarray(values, dtype=np.float64)
    return values if values.ndim == 1 else np.linalg.norm(values.reshape(len(values), -1), axis=1)


def _label(name: str, unit: str) -> str:
    words = name.replace("_", " ")
    return words if unit == "1" else f"{words} [{unit}]"
