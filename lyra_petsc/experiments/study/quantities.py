"""Quantities whose errors are measured: ``--quantities``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from lyra_petsc.errors import InputError, nearest

KINDS = ("position", "energy", "probes")


@dataclass(frozen=True)
class Quantity:
    """One error that is measured of each combination.

    Attributes
    ----------
    name : str
        ``position_max``, ``position_l2``, ``energy`` or ``probe_<name>``: columns are ``error_<name>``.
    title : str
        In words.
    probe : str or None
        The scene's probe it is about.
    """

    name: str
    title: str
    probe: str | None = None


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
    names = list(probes)
    key = "--quantities"
    words = [word.strip() for word in text.split(",")] if text.strip() else []
    if not words:
        words = ["position", "energy", *(["probes"] if names else [])]
    found: list[Quantity] = []
    for word in words:
        if not word:
            raise InputError("has an empty name between its commas", key=key)
        new = _of(word, names)
        if any(quantity in found for quantity in new):
            raise InputError(f"names '{word}' twice", key=key)
        found += new
    return found


def _of(word: str, probes: Sequence[str]) -> list[Quantity]:
    if word == "position":
        return list(POSITION)
    if word == "energy":
        return [ENERGY]
    if word == "probes":
        if not probes:
            raise InputError(
                "the scene has no probes; add some, as in probes: {tip: {group: tip}}", key="--quantities"
            )
        return [probe_quantity(name) for name in probes]
    if word in probes:
        return [probe_quantity(word)]
    raise InputError(f"unknown quantity '{word}', {nearest(word, [*KINDS, *probes])}", key="--quantities")
