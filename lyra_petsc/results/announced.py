"""Which states a run has announced: what its ``states.xdmf`` says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias
from xml.etree.ElementTree import Element, ParseError, parse

from lyra_petsc.errors import InputError
from lyra_petsc.output.agreement import reason

XDMF_FILE = "states.xdmf"
MESH_FILE = "mesh.h5"

Place: TypeAlias = tuple[str, str]
"""File, relative to the run's folder, and name of a dataset in it."""


@dataclass(frozen=True)
class State:
    """A written state.

    Attributes
    ----------
    time : float
        [s], or the load factor of a static analysis.
    position : tuple of str
        Where the positions are.
    fields : mapping of str to tuple of str
        Where what else the state holds is.
    on : mapping of str to str
        ``vertex`` or ``triangle``: what the rows of each field belong to.
    """

    time: float
    position: Place
    fields: Mapping[str, Place]
    on: Mapping[str, str]


def announced_states(folder: Path) -> list[State]:
    """The states of a run in the order of time.

    Raises
    ------
    InputError
        If the folder is none of a run, nothing is written yet, or the announcement is damaged.
    """
    path = folder / XDMF_FILE
    try:
        root = parse(path).getroot()
        states = [_state(grid) for grid in root.iterfind("./Domain/Grid/Grid")]
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(_absent(folder), file=folder) from None
    except OSError as error:
        raise InputError(f"cannot be read: {reason(error)}", file=path) from None
    except (ParseError, ValueError, AttributeError, UnicodeDecodeError):
        raise InputError("is damaged, or was not written by a run", file=path) from None
    if not states:
        raise InputError("no state is written yet", file=folder)
    return states


def _absent(folder: Path) -> str:
    if not folder.exists():
        return "no such folder; give the folder of a run, as in runs/flag"
    if not folder.is_dir():
        return "is a file; give the folder of a run, as in runs/flag"
    if (folder / "run.lock").exists():
        return f"no state is written yet (no {XDMF_FILE})"
    return f"is not the folder of a run (no {XDMF_FILE})"


def _state(grid: Element) -> State:
    time, geometry = grid.find("Time"), grid.find("Geometry")
    if time is None or geometry is None:
        raise ValueError
    fields = {a.attrib["Name"]: a for a in grid.iterfind("Attribute") if a.get("Name") != "rest"}
    return State(
        float(time.attrib["Value"]),
        _place(geometry),
        {name: _place(field) for name, field in fields.items()},
        {name: "triangle" if field.get("Center") == "Cell" else "vertex" for name, field in fields.items()},
    )


def _place(element: Element) -> Place:
    file, colon, dataset = (element.findtext("DataItem") or "").strip().rpartition(":")
    if not colon:
        raise ValueError
    return file, dataset
