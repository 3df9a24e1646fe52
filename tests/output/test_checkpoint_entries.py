"""Checkpoints with the right check sums and the wrong content, as by a mistaken program."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from copy import deepcopy
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, grid, scene_of, stepped
from written_run import ENTRIES

from lyra_petsc.errors import InputError
from lyra_petsc.output.checkpoint import CHECKPOINT, PREVIOUS, Stored, _digest
from lyra_petsc.output.checkpoint_entries import check_entries
from lyra_petsc.output.recorder import Recorder
from lyra_petsc.output.stored import check_sum, import_h5py, text_attribute

WITH_HISTORIES = ENTRIES | {
    "scheme": "bdf2",
    "integrator": {"past_dt_0": 0.05, "past_dt_1": 0.05, "slope_dt": 0.05},
    "extrapolation": {"past_0": 0.1, "past_1": 0.2, "degree": 1},
    "late_starts": [0.15],
}
EQUILIBRIUM = ENTRIES | {
    "scheme": "static",
    "energy": None,
    "stability": {"stable": None},
    "equilibrium": {
        "scale": 1.0,
        "in_vain": 0,
        "sufficed": 1e300,
        "slid": 0,
        "slid_in": 0.0,
        "extrapolation": {"past_0": 0.1, "degree": 0},
    },
}
WRONG: dict[type, list[Any]] = {
    float: ["x", None, True, [], {}, np.nan, np.inf, -np.inf],
    int: ["x", None, True, [], {}, np.nan, -1, 10**30, 0.5],
    bool: ["x", None, 1, []],
    str: [1, None, []],
    list: ["x", None, 1, {}, [None]],
    dict: ["x", None, 1, [], {"unknown": {}}],
    tuple: ["x", None, [0], [0, 0.5]],
}
"""Values that no entry of a type may have."""

MAY_BE_NONE = {("least",), ("energy", "start"), ("stability", "stable")}

FREE = {("budget", "more"), ("stability",), ("obstacles",), ("repeated",), ("notes",), ("told",)}
"""Entries that may be empty, and whose content is not known beforehand."""


OPTIONAL = {
    *(("integrator", name) for name in ("past_dt_1", "slope_dt")),
    ("extrapolation",),
    ("extrapolation", "past_0"),
    ("extrapolation", "past_1"),
    ("equilibrium", "extrapolation", "past_0"),
}
"""Entries that may be missing."""


def entries(content: dict[str, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Path and value of each entry, nested ones included."""
    for name, value in content.items():
        yield (*above, name), value
        if isinstance(value, dict):
            yield from entries(value, (*above, name))


def changed(content: dict[str, Any], path: tuple[str, ...], *value: Any) -> dict[str, Any]:
    """A copy with another value of one entry, or without the entry."""
    content = deepcopy(content)
    *above, name = path
    block = content
    for each in above:
        block = block[each]
    if value:
        block[name] = value[0]
    else:
        del block[name]
    return content


@pytest.mark.parametrize("content", [ENTRIES, WITH_HISTORIES, EQUILIBRIUM], ids=lambda each: each["scheme"])
def test_every_entry_has_its_type_and_bounds(content: dict[str, Any]) -> None:
    check_entries(json.dumps(content))
    for path, value in entries(content):
        for wrong in WRONG.get(type(value), ()):
            allowed = (wrong is None and path in MAY_BE_NONE) or (wrong in ([], {}) and path in FREE)
            if not allowed and path[0] != "stability":
                with pytest.raises(ValueError, match=r"^[^\n]+$"):
                    check_entries(json.dumps(changed(content, path, wrong)))
        if path[:-1] not in FREE and path not in OPTIONAL:
            with pytest.raises(ValueError, match=r"^[^\n]+$"):
                check_entries(json.dumps(changed(content, path)))


@pytest.mark.parametrize("text", ["[" * 100000, "7", '{"step"', "{}", "null", '{"step": ' + "9" * 5000 + "}"])
def test_text_that_is_no_mapping_of_entries(text: str) -> None:
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        check_entries(text)


def test_entries_that_do_not_fit_together() -> None:
    for content in (
        ENTRIES | {"unknown": 1},
        ENTRIES | {"scheme": "static"},
        ENTRIES | {"scheme": "euler"},
        EQUILIBRIUM | {"scheme": "bdf2"},
        WITH_HISTORIES | {"extrapolation": {"past_0": 0.2, "past_1": 0.2, "degree": 1}},
        WITH_HISTORIES | {"extrapolation": {"past_0": 0.2, "past_1": 0.31, "degree": 1}},
        WITH_HISTORIES | {"late_starts": [0.1, 0.1]},
        WITH_HISTORIES | {"late_starts": [0.4]},
        WITH_HISTORIES | {"integrator": {"past_dt_1": 0.1}},
    ):
        with pytest.raises(ValueError, match=r"^[^\n]+$"):
            check_entries(json.dumps(content))


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
    "big-endian": replaced(lambda x: x.astype(">f8")),
    "short": replaced(lambda x: x.astype("<f4")),
    "whole": replaced(lambda x: x.astype("<i8")),
    "text": replaced(b"text"),
    "scalar": replaced(1.0),
    "nan": replaced(with_one(np.nan)),
    "inf": replaced(with_one(-np.inf)),
    "huge": replaced(with_one(1e300)),
    "fewer": replaced(lambda x: x[:-1]),
    "more": replaced(lambda x: np.concatenate([x, x[:1]])),
    "deeper": replaced(lambda x: x[..., None]),
    "endless": lengthen,
}
OF_ELEMENTS = {
    "half": replaced(with_one(0.5)),
    "none": replaced(with_one(-1.0)),
    "beyond": replaced(with_one(1e4)),
}


def sign(path: Path) -> None:
    """Renew all check sums."""
    with import_h5py().File(path, "a") as file:
        stored = {}
        for kind in ("vertices", "edges", "elements"):
            for name, data in file.get(kind, {}).items():
                total = check_sum(np.asarray(data[()])) if data.size < 10**6 else 0
                data.attrs["sum"] = str(total)
                stored[f"{kind}/{name}"] = Stored(data.dtype.str, data.shape, total)
        content = text_attribute(file, "scalars")
        file.attrs["digest"] = _digest(int(file.attrs["n_vertices"]), content, stored)


def test_every_array_has_its_type_shape_and_bounds(tmp_path: Path) -> None:
    """With arrays of vertices, edges and elements, of histories and of terms."""
    scene = {
        "mesh": grid(0.2, 0.2, 2, 2),
        "material": CLOTH | {"bending": 1e-4, "bending_model": "midedge"},
        "contact": {"friction": 0.3, "gap": 5e-3},
        "obstacles": {"floor": {"plane": {"point": [0, 0, -6e-3], "normal": [0, 0, 1]}}},
        "gravity": [0, 0, -9.81],
        "time": {"end": 0.15, "step": 0.01, "integrator": "bdf2"},
    }
    whole, damaged = tmp_path / "whole", tmp_path / "damaged"
    whole.mkdir()
    with stepped(MPI.COMM_SELF, scene_of(scene)) as simulation:
        recorder = Recorder(simulation)
        recorder.begin(whole)
        while not simulation.finished:
            recorder.record(simulation.step())
        recorder.flush()
        recorder.close()
    (whole / PREVIOUS).unlink()
    with import_h5py().File(whole / CHECKPOINT) as file:
        kinds = {kind: list(file[kind]) for kind in ("vertices", "edges", "elements")}
    assert all(kinds.values())
    with stepped(MPI.COMM_SELF, scene_of(scene)) as simulation:
        for kind, names in kinds.items():
            for name, (damage, work) in product(
                names, (DAMAGES | (OF_ELEMENTS if kind == "elements" else {})).items()
            ):
                if kind == "elements" and damage in ("missing", "fewer", "more"):
                    continue  # pairs come and go
                if (name, damage) == ("friction.friction_work", "missing"):
                    continue  # as if the scene had had no friction then
                shutil.rmtree(damaged, ignore_errors=True)
                shutil.copytree(whole, damaged)
                with import_h5py().File(damaged / CHECKPOINT, "a") as file:
                    work(file, f"{kind}/{name}")
                sign(damaged / CHECKPOINT)
                with pytest.raises(InputError, match=r"^[^\n]*run without --resume[^\n]*$"):
                    Recorder(simulation).resume(damaged)
