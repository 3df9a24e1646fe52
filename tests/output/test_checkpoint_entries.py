"""Checkpoints with the right check sums and the wrong content, as by another program."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, grid, scene_of, stepped

from lyra_petsc.errors import InputError
from lyra_petsc.output.checkpoint import ENTRIES, _encoded
from lyra_petsc.output.layout import CHECKPOINT, PREVIOUS
from lyra_petsc.output.recorder import Recorder
from lyra_petsc.output.stored import check_sum, import_h5py

SCENE = {
    "mesh": grid(0.2, 0.2, 2, 2),
    "material": CLOTH | {"bending": 1e-4, "bending_model": "midedge"},
    "contact": {"friction": 0.3, "gap": 5e-3},
    "obstacles": {"floor": {"plane": {"point": [0, 0, -6e-3], "normal": [0, 0, 1]}}},
    "gravity": [0, 0, -9.81],
    "time": {"end": 0.15, "step": 0.01, "integrator": "bdf2"},
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run whose only checkpoint has arrays of vertices, edges, elements, histories and terms."""
    folder = tmp_path_factory.mktemp("whole")
    with stepped(MPI.COMM_SELF, scene_of(SCENE)) as simulation:
        recorder = Recorder(simulation)
        recorder.begin(folder)
        while not simulation.finished:
            recorder.record(simulation.step())
        recorder.flush()
        recorder.close()
    (folder / PREVIOUS).unlink()
    return folder


def replaced(values: Any) -> Callable[[Any, str], None]:
    """Replaces an array by what a function of it returns, or by a value."""

    def work(file: Any, path: str) -> None:
        before = file[path][()]
        del file[path]
        file[path] = values(before) if callable(values) else values

    return work


def delete(file: Any, path: str) -> None:
    del file[path]


def lengthen(file: Any, path: str) -> None:
    """An array that claims to be longer than the file."""
    shape = (10**12, *file[path].shape[1:])
    del file[path]
    file.create_dataset(path, shape, "<f8", chunks=(1000, *shape[1:]))


def with_one(value: float) -> Callable[[Any], Any]:
    def work(before: Any) -> Any:
        before.flat[0] = value
        return before

    return work


DAMAGES: dict[str, Callable[[Any, str], None]] = {
    "missing": delete,
    "whole": replaced(lambda x: x.astype("<i8")),
    "nan": replaced(with_one(np.nan)),
    "huge": replaced(with_one(1e300)),
    "fewer": replaced(lambda x: x[:-1]),
    "endless": lengthen,
}
OF_NUMBERS = {
    "half": replaced(with_one(0.5)),
    "none": replaced(with_one(-1.0)),
    "beyond": replaced(with_one(1e4)),
}


def sign(file: Any, change: Callable[[dict[str, Any]], Any] = lambda scalars: None) -> None:
    """Change the entries, and renew all check sums."""
    entries = json.loads(file[ENTRIES][64:].tobytes())
    change(entries["scalars"])
    entries["sums"] = {
        f"{kind}/{name}": check_sum(np.asarray(data[()])) if data.size < 10**6 else 0
        for kind in ("vertices", "edges", "elements")
        for name, data in file.get(kind, {}).items()
    }
    del file[ENTRIES]
    file[ENTRIES] = np.frombuffer(_encoded(entries), np.uint8)


def test_every_array_has_its_type_shape_and_bounds(whole: Path, tmp_path: Path) -> None:
    with import_h5py().File(whole / CHECKPOINT) as file:
        kinds = {kind: list(file[kind]) for kind in ("vertices", "edges", "elements")}
    assert all(kinds.values())
    with stepped(MPI.COMM_SELF, scene_of(SCENE)) as simulation:
        for kind, names in kinds.items():
            for name, (damage, work) in product(names, (DAMAGES | OF_NUMBERS).items()):
                if damage in OF_NUMBERS and not (kind == "elements" and name.endswith(".vertices")):
                    continue
                if damage == "missing" and name not in ("position", "velocity"):
                    continue  # as of a scene without that term or history
                shutil.copytree(whole, tmp_path / "damaged")
                with import_h5py().File(tmp_path / "damaged" / CHECKPOINT, "a") as file:
                    work(file, f"{kind}/{name}")
                    sign(file)
                with pytest.raises(InputError, match=r"^[^\n]*run without --resume[^\n]*$"):
                    Recorder(simulation).resume(tmp_path / "damaged")
                shutil.rmtree(tmp_path / "damaged")


def test_entries_of_another_program_are_refused_in_one_line(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole, tmp_path / "other")
    with import_h5py().File(tmp_path / "other" / CHECKPOINT, "a") as file:
        sign(file, lambda scalars: scalars.pop("integrator"))
    with (
        stepped(MPI.COMM_SELF, scene_of(SCENE)) as simulation,
        pytest.raises(InputError, match=r"^[^\n]*does not hold what this program writes[^\n]*--resume$"),
    ):
        Recorder(simulation).resume(tmp_path / "other")
