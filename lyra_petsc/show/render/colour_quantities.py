"""What a sheet can be coloured by; a new quantity is one function and one line in ``DERIVED``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError, nearest
from lyra_petsc.output.read_run import Run

Array = NDArray[np.float64]

COVERED = 99.5
"""Percentage of a state's values within its range of colours, so that a few extreme values do not set it."""


@dataclass(frozen=True)
class ColourQuantity:
    """A number on every vertex or triangle of every state.

    Attributes
    ----------
    label : str
        Name and unit, shown at the bar of colours.
    values : callable
        Gives the values, (V,) or (F,), of the state with a number.
    on_triangles : bool
        Whether there is a value for each triangle; else for each vertex.
    signed : bool
        Whether zero belongs in the middle of the colours.
    """

    label: str
    values: Callable[[int], Array]
    on_triangles: bool = False
    signed: bool = False

    def span(self, state: int) -> tuple[float, float]:
        """Lowest and highest value that the colours should show in one state."""
        values = self.values(state)
        if self.signed:
            largest = float(np.percentile(np.abs(values), COVERED))
            return -largest, largest
        low, high = np.percentile(values, [100.0 - COVERED, COVERED])
        return float(low), float(high)


def quantity(run: Run, name: str) -> ColourQuantity:
    """The quantity of a name.

    Raises
    ------
    InputError
        If there is none of that name, or the states lack the field that it is computed from.
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
    return ColourQuantity(label, lambda i: reduce(np.asarray(stored[i])), on_triangles, name in _SIGNED)


_PRINCIPAL = {"green_strain", "stress"}
_SIGNED = {"curvature"}


def _speed(run: Run, name: str) -> ColourQuantity:
    if "velocity" not in run.fields:
        raise InputError(
            f"{name} needs the velocities, which this run did not write; add velocity to the scene's "
            "output.fields, or show displacement or strain",
            file=run.folder,
            key="--field",
        )
    stored = run.field("velocity")
    return ColourQuantity(_label("speed", "m/s"), lambda i: _magnitude(stored[i]))


def _displacement(run: Run, name: str) -> ColourQuantity:
    start = run.positions[0]
    return ColourQuantity(_label(name, "m"), lambda i: _magnitude(run.positions[i] - start))


def _strain(run: Run, name: str) -> ColourQuantity:
    triangles, inverse = run.triangles, np.linalg.inv(_edges(material_coordinates(run)))

    def values(state: int) -> Array:
        # deformation gradient (F, 3, 2), which maps material edges to current ones
        gradient = _edges(run.positions[state][triangles]) @ inverse
        metric = np.swapaxes(gradient, 1, 2) @ gradient
        strain = 0.5 * (metric[:, [0, 1, 0], [0, 1, 1]] - np.array([1.0, 1.0, 0.0]))
        return 100.0 * _largest_principal(strain)

    return ColourQuantity(_label("largest principal strain", "%"), values, on_triangles=True)


DERIVED: dict[str, Callable[[Run, str], ColourQuantity]] = {
    "speed": _speed,
    "displacement": _displacement,
    "strain": _strain,
}
"""Quantities computed from positions and velocities, besides the fields that the run has written."""


def material_coordinates(run: Run) -> Array:
    """(F, 3, 2) material coordinates of the triangles' corners [m]: ``vt``, or the flattened rest shape."""
    return run.mesh.corner_uv


def _edges(corners: Array) -> Array:
    """(F, d, 2) two edges of each triangle as columns; ``corners`` is (F, 3, d)."""
    return np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)


def _largest_principal(symmetric: Array) -> Array:
    """(F,) larger eigenvalue of symmetric 2 × 2 tensors with components uu, vv, uv (F, 3)."""
    uu, vv, uv = symmetric.T
    largest: Array = (uu + vv) / 2.0 + np.hypot((uu - vv) / 2.0, uv)
    return largest


def _magnitude(values: Array) -> Array:
    values = np.asarray(values, dtype=np.float64)
    return values if values.ndim == 1 else np.linalg.norm(values.reshape(len(values), -1), axis=1)


def _label(name: str, unit: str) -> str:
    words = name.replace("_", " ")
    return words if unit == "1" else f"{words} [{unit}]"
