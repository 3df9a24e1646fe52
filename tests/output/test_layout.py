"""Files laid out one after the other are what each would be alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest

from lyra_petsc.output import layout
from lyra_petsc.output.layout import Attributes, lay_out


@pytest.fixture(autouse=True)
def nothing_kept() -> Iterator[None]:
    def forget() -> None:
        while layout._kept:
            layout._kept.popitem()[1].content.close()

    forget()
    yield
    forget()


def check(path: Path, rows: dict[str, int], attributes: Attributes, columns: int = 3) -> int:
    """Lay a file out, fill its places, and read all back; its size."""
    slabs = {name: np.random.default_rng(n).random((n, columns)) for name, n in rows.items()}
    places = lay_out(path, slabs, list(rows.values()), attributes)
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
            assert dict(file[owner].attrs) == values
            for key, value in values.items():
                assert isinstance(file[owner].attrs[key], str) == isinstance(value, str)
    return path.stat().st_size


def test_states_one_after_the_other(tmp_path: Path) -> None:
    sizes = set()
    for number in (0, 1, 2, 9999, 10000, 123456):
        group = f"states/{number:04d}"
        attributes: Attributes = {
            group: {"time": 0.1 * number, "step": number},
            f"{group}/position": {"time": 0.1 * number, "step": number, "on": "vertex"},
        }
        rows = {f"{group}/position": 50, f"{group}/velocity": 50}
        sizes.add(check(tmp_path / f"{number}.h5", rows, attributes))
    assert len(layout._kept) == 1
    assert max(sizes) <= min(sizes) + layout.MOST_LOST


def test_a_group_elsewhere(tmp_path: Path) -> None:
    for group in ("a/x", "b/x", "a/y", "c", "a/x/deep"):
        check(tmp_path / "a.h5", {f"{group}/p": 5, f"{group}/q": 5}, {group: {"time": 1.0}})


def test_texts_that_change_do_not_make_files_grow(tmp_path: Path) -> None:
    sizes = []
    for number in range(60):
        attributes: Attributes = {
            "/": {"format": 1, "scalars": "é" * (300 + 7 * (number % 5)) + str(number)},
            "vertices/position": {"sum": str(2**63 + number)},
        }
        sizes.append(check(tmp_path / "checkpoint.h5", {"vertices/position": 20}, attributes))
    assert max(sizes) <= min(sizes) + layout.MOST_LOST + 4096


def test_what_differs_is_another_file(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    check(path, {"g/a": 5}, {"g": {"x": 1.0}})
    check(path, {"g/a": 6}, {"g": {"x": 1.0}})
    check(path, {"g/a": 5}, {"g": {"x": 1}})
    check(path, {"g/a": 5}, {"g": {"x": "1"}})
    assert len(layout._kept) == layout.KEPT
    check(path, {"g/a": 5}, {"g": {"x": 1.0}}, columns=2)
    check(path, {"g/a": 0, "h/a": 3}, {"/": {"x": 1.0}, "h": {"y": "no"}, "g/a": {"z": 2}})
    assert len(layout._kept) == layout.KEPT
    check(path, {"g/a": 5}, {"g": {"x": 2.0}})


@pytest.mark.parametrize("limit", ["MOST_IN_MEMORY", "MOST_KEPT"])
def test_large_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str) -> None:
    monkeypatch.setattr(layout, limit, 100)
    for number in range(3):
        check(tmp_path / "a.h5", {f"g{number}/a": 50}, {f"g{number}": {"x": 1.0 * number, "s": "t" * number}})
    assert not layout._kept
