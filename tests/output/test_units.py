"""HDF5 files name the units of their data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import pytest

import lyra_petsc
from lyra_petsc.scene.schema import FIELD_UNITS

SCENE = {
    "mesh": {"grid": {"width": 1.0, "height": 1.0, "nx": 2, "ny": 2}},
    "material": {"cloth": "gray-interlock", "damping": 0.01},
    "gravity": [0, 0, -9.81],
    "handles": [{"nodes": [0, 2]}],
    "time": {"end": 0.01, "step": 0.01},
    "output": {"fields": ["velocity", "stress", "green_strain", "membrane_energy", "curvature"]},
}


def units(path: Path) -> dict[str, str]:
    """Units by the names of datasets, without the groups."""
    found: dict[str, str] = {}

    def visit(name: str, data: Any) -> None:
        if isinstance(data, h5py.Dataset) and "units" in data.attrs:
            unit = data.attrs["units"]
            found[name.rpartition("/")[2]] = unit.decode() if isinstance(unit, bytes) else unit

    with h5py.File(path) as file:
        file.visititems(visit)
    return found


@pytest.mark.parametrize(("static", "time"), [(False, "s"), (True, "1")])
def test_states_and_mesh_have_units(tmp_path: Path, static: bool, time: str) -> None:
    changes = {"time": {"analysis": "static"}} if static else {}
    lyra_petsc.run(lyra_petsc.load(SCENE, changes), tmp_path / "run")
    fields = SCENE["output"]["fields"]
    expected = {"position": "m", "time": time} | {name: FIELD_UNITS[name] for name in fields}
    assert units(tmp_path / "run" / "states-0000.h5") == expected
    assert units(tmp_path / "run" / "mesh.h5") == {"rest": "m", "start": "m", "uv": "m"}
