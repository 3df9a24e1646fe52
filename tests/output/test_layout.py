"""Files whose layout is created first, and whose data are then written at the given offsets."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from lyra_petsc.output.hdf5 import MAX_OVERHEAD, Attributes, preallocate
from lyra_petsc.output.stored import text_attribute


def check(path: Path, rows: dict[str, int], attributes: Attributes, columns: int = 3) -> int:
    """Create the layout of a file, write its data, and read everything back; returns its size."""
    slabs = {name: np.random.default_rng(n).random((n, columns)) for name, n in rows.items()}
    places = preallocate(path, slabs, list(rows.values()), attributes)
    with open(path, "r+b") as file:
        for place, slab in zip(places, slabs.values(), strict=True):
            file.seek(place)
            file.write(slab.tobytes())
    with h5py.File(path) as file:
        names: list[str] = []
        file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        assert sorted(names) == sorted(rows)
        for name, slab in slabs.items():
            np.testing.assert_array_equal(file[name][:], slab)
        for owner, values in attributes.items():
            texts = {key for key, value in values.items() if isinstance(value, str)}
            found = {
                k: text_attribute(file[owner], k) if k in texts else v for k, v in file[owner].attrs.items()
            }
            assert found == values
    return path.stat().st_size


def test_datasets_of_a_state(tmp_path: Path) -> None:
    group = "states/010000"
    attributes: Attributes = {
        group: {"time": 0.1, "step": 3},
        f"{group}/position": {"time": 0.1, "step": 3, "on": "vertex"},
    }
    size = check(tmp_path / "a.h5", {f"{group}/position": 50, f"{group}/velocity": 50}, attributes)
    assert size < 2 * 50 * 24 + MAX_OVERHEAD


def test_long_texts_and_groups_at_any_depth(tmp_path: Path) -> None:
    check(
        tmp_path / "a.h5",
        {"g/a": 0, "h/a": 3, "a/x/deep/b": 5},
        {"/": {"x": 1.0, "scalars": "é" * 3000}, "h": {"y": "no"}, "g/a": {"z": 2}, "empty": {"s": ""}},
        columns=2,
    )
