"""Files and processes that are left by a run which ended early."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from contextlib import suppress
from pathlib import Path

import h5py
import meshio
import numpy as np
from launch import read_csv, wait_until

from lyra_petsc.errors import InputError
from lyra_petsc.output.read_run import stored_states

SHEET = """\
mesh: {grid: {width: 1.0, height: 1.0, nx: 4, ny: 4}}
material: {density: 0.15, membrane: {c11: 800, c22: 800, c12: 160, c33: 240}, bending: 2.0e-5, damping: 0.005}
gravity: [0, 0, -9.81]
handles: [{nodes: [0, 4]}]
time: {end: %s, step: 0.005}
output: {every: 0.02, fields: [velocity]}
"""
"""A hanging square of 25 vertices; tests fill in its end."""

ENDLESS = SHEET % 1000


def announced(out: Path) -> list[float]:
    """Times of the states in ``states.xdmf``, each read and found complete."""
    times = []
    for grid in ElementTree.parse(out / "states.xdmf").findall(".//Grid[@GridType='Uniform']"):
        times.append(float(grid.find("Time").attrib["Value"]))
        for item in grid.iter("DataItem"):
            name, path = item.text.strip().split(":")
            with h5py.File(out / name, "r") as file:
                assert np.isfinite(file[path][()]).all()
                assert file[path].shape == tuple(map(int, item.attrib["Dimensions"].split()))
    with meshio.xdmf.TimeSeriesReader(out / "states.xdmf") as reader:
        reader.read_points_cells()
        read = [reader.read_data(k)[0] for k in range(reader.num_steps)]
        assert read[: len(times)] == times  # a running simulation may have listed more
    assert times == sorted(set(times))
    return times


def steps(out: Path, name: str = "history.csv") -> list[int]:
    """Step numbers of a table."""
    return [int(row["step"]) for row in read_csv(out / name)]


def ranks_in(folder: Path) -> list[int]:
    """Processes of the program, without mpirun, that still run in a folder."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            if (
                entry.name.isdigit()
                and int(entry.name) != os.getpid()
                and (entry / "cwd").readlink() == folder.resolve()
                and b"mpirun" not in (entry / "cmdline").read_bytes()
            ):
                found.append(int(entry.name))
        except OSError:  # gone meanwhile
            continue
    return found


def wait_for_states(out: Path, number: int, patience: float = 60.0) -> None:
    """Wait until a number of states are on disk."""

    def enough() -> bool:
        with suppress(InputError):
            return len(stored_states(out)) >= number
        return False

    wait_until(enough, patience=patience)
