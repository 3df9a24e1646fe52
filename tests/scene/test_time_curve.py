"""Values that change in time: points in the scene or in a file, their checks, and what follows from them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from lyra_petsc.scene.time_curve import MAX_POINTS, NumberInTime, TimeCurve, VectorInTime, acts, largest

pytestmark = pytest.mark.quick


def checked(kind: Any, value: Any, folder: Path | None = None) -> Any:
    context = {} if folder is None else {"directory": folder}
    return TypeAdapter(kind).validate_python(value, context=context)


def test_values_between_before_and_after_the_points() -> None:
    curve = TimeCurve.of(checked(NumberInTime, [[1, 2], [2, 6], [4, 0]]))
    assert [float(curve.at(t)) for t in (-1.0, 1.0, 1.25, 2.0, 3.5, 4.0, 9.0)] == [2, 2, 3, 6, 1.5, 0, 0]
    wind = TimeCurve.of(checked(VectorInTime, [[0, [0, 0, 0]], [2, [4, 0, -2]]]))
    assert np.array_equal(wind.at(0.5), [1.0, 0.0, -0.5])
    assert np.array_equal(wind.largest, [4.0, 0.0, -2.0])


def test_plain_values_are_constant() -> None:
    assert TimeCurve.of(checked(NumberInTime, 3)).at(7.0) == 3.0
    gravity = TimeCurve.of(checked(VectorInTime, [0, 0, -9.81]))
    assert np.array_equal(gravity.at(-1.0), [0.0, 0.0, -9.81])
    assert gravity.kinks == []


def test_kinks_are_where_the_slope_changes() -> None:
    assert TimeCurve.of(((0.0, 1.0), (1.0, 1.0), (2.0, 3.0), (3.0, 5.0), (4.0, 5.0))).kinks == [1.0, 3.0]
    straight = tuple((0.1 * i, 0.3 * i) for i in range(11))  # but for round-off
    assert TimeCurve.of(straight).kinks == [0.0, 1.0]
    assert TimeCurve.of(((1.0, 5.0),)).kinks == []


def test_the_largest_value_is_that_of_largest_magnitude() -> None:
    assert largest(((0.0, 2.0), (1.0, -5.0))) == -5.0
    assert largest(None) == 0.0
    assert [acts(value) for value in (None, 0.0, ((0.0, 0.0), (1.0, 0.0)), ((0.0, 0.0), (1.0, 1.0)))] == [
        False, False, False, True,
    ]  # fmt: skip


@pytest.mark.parametrize("separator", [",", ";", "\t", " , "])
def test_a_file_holds_a_heading_and_points(tmp_path: Path, separator: str) -> None:
    rows = ["t [s] velocity", "", "# calm", *(separator.join(row) for row in (("0", "0"), ("0.5", "-2e1")))]
    (tmp_path / "gust.csv").write_text("\n".join(rows))
    assert checked(NumberInTime, "gust.csv", tmp_path) == ((0.0, 0.0), (0.5, -20.0))
    (tmp_path / "wind.CSV").write_text('"t","x","y","z"\n0,1,2,3\n1,4,5,6\n')
    assert checked(VectorInTime, "wind.CSV", tmp_path) == ((0.0, (1.0, 2.0, 3.0)), (1.0, (4.0, 5.0, 6.0)))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0,1\n1,2\n", "line 1: put a heading before the numbers"),
        ("t,p\n0,1\n1,x\n", "line 3: must be 2 finite numbers with decimal points, time [s] and value, not"),
        ("t,p\n0,1\n1,2,3\n", "line 3: must be 2 finite numbers"),
        ("t,p\n0,nan\n", "line 2: must be 2 finite numbers"),
        ("t,p\n0,1e999\n", "line 2: must be 2 finite numbers"),
        ("t,p\n0,1\n\n0,2\n", "line 4: time 0 is not later than 0 before it; sort by time"),
        ("t,p\n", "has 0 points"),
        ("", "is empty"),
        ("t,p\n" + "".join(f"{i},0\n" for i in range(MAX_POINTS + 1)), f"give 1 to {MAX_POINTS}"),
    ],
)  # fmt: skip
def test_bad_rows_are_named_by_file_and_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "ramp.csv").write_text(text)
    with pytest.raises(ValidationError) as caught:
        checked(NumberInTime, "ramp.csv", tmp_path)
    said = caught.value.errors()[0]["msg"]
    assert message in said
    assert "ramp.csv" in said


@pytest.mark.parametrize(
    ("kind", "value", "message"),
    [
        (NumberInTime, [[0, 1], [0, 2]], "point 2: time 0 is not later than 0 before it"),
        (NumberInTime, [[1, 1], [0, 2]], "point 2: time 0 is not later than 1 before it"),
        (NumberInTime, [[0, [1, 2, 3]]], "point 1: must be a number, not [1, 2, 3]"),
        (NumberInTime, [[0, 1], [1, float("nan")]], "point 2: must be a finite number"),
        (NumberInTime, [[0, 1, 2]], "point 1 must be [time, value], as in [[0, 0], [1, 5]]"),
        (NumberInTime, [1, 2], "point 1 must be [time, value]"),
        (NumberInTime, [], "the curve has 0 points"),
        (NumberInTime, "5", "must be a number, not '5' (text; write it without quotes)"),
        (NumberInTime, [[0, -1e308], [1, 1e308]], "has slopes that are no numbers"),
        (NumberInTime, "missing.csv", "no such file"),
        (VectorInTime, [[0, 1], [1, 2]], "point 1: must be three numbers"),
        (VectorInTime, [0, 1], "must be three numbers"),
        (VectorInTime, [[0, [1, 2, 3]], [True, [1, 2, 3]]], "point 2: must be a number, not true"),
    ],
)
def test_bad_points_are_named(kind: Any, value: Any, message: str) -> None:
    with pytest.raises(ValidationError) as caught:
        checked(kind, value)
    assert message in caught.value.errors()[0]["msg"]
