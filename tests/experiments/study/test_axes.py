"""``--vary`` and ``--quantities``: meaning and refusals."""

from __future__ import annotations

import re

import pytest

from lyra_petsc.errors import InputError
from lyra_petsc.experiments.study.plan import (
    make_combinations,
    parse_axes,
    parse_quantities,
)

MANY = ",".join(str(k + 1) for k in range(101))


def test_short_names_options_and_paths_of_keys() -> None:
    axes = parse_axes(
        ["dt=0.02,1e-2", "integrator=beuler,bdf2", "ksp_rtol=1e-3", "solver.force_tolerance=1e-4", "mesh=0.1"]
    )
    assert [(axis.key, axis.path) for axis in axes] == [
        ("dt", "time.step"),
        ("integrator", "time.integrator"),
        ("ksp_rtol", "petsc.ksp_rtol"),
        ("solver.force_tolerance", "solver.force_tolerance"),
        ("mesh", "mesh"),
    ]
    assert axes[0].values == (0.02, 0.01)
    assert [axis.numeric for axis in axes] == [True, False, True, True, True]
    assert not any(axis.physical for axis in axes)


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        (["dt"], "must read key=value"),
        (["=1"], "must read key=value"),
        (["dt="], "no values"),
        (["dt= , "], "no values"),
        (["dt=0.1,,0.2"], "empty value"),
        (["dt=0.1,x"], "'x' is no number"),
        (["dt=inf"], "'inf' is no number"),
        (["dt=0.01,1e-2"], "has the value 1e-2 twice"),
        (["integrator=bdf2,bdf2"], "twice"),
        (["dt=0.1", "time.step=0.2"], "varies what dt varies already"),
        (["dt=0.1", "tolerance=1e-3"], "vary one of them"),
        (["integrator=buler"], "did you mean 'beuler'"),
        (["integratr=beuler"], "did you mean 'integrator'"),
        (["timestep=0.1"], "unknown key"),
        (["ts_dt=0.1"], "unknown key"),
        (["ksp_rtol=tight"], "'tight' is no number"),
        (["solver.force_tolerance=tight"], "'tight' is no number"),
        (["dt=" + MANY, "mesh=" + MANY], "more than 10000 combinations"),
    ],
)  # fmt: skip
def test_invalid_axes_are_refused(texts: list[str], words: str) -> None:
    with pytest.raises(InputError, match=words):
        parse_axes(texts)


def test_combinations_vary_the_last_axis_fastest() -> None:
    combinations = make_combinations(parse_axes(["integrator=beuler,bdf2", "dt=0.02,0.01"]))
    assert [c.name for c in combinations] == ["beuler-dt0.02", "beuler-dt0.01", "bdf2-dt0.02", "bdf2-dt0.01"]
    assert combinations[3].title == "bdf2, Δt 10 ms"
    assert combinations[3].settings == {"integrator": "bdf2", "dt": 0.01}


def test_names_are_unique_file_names() -> None:
    texts = ["gravity=[0,0,-9.81],[0 0 -9.81]", "dt=0.0166666666,0.0166666667", "pc_type=lu,gamg"]
    names = [c.name for c in make_combinations(parse_axes(texts))]
    assert len(set(names)) == 8
    assert all(re.fullmatch(r"[\w.+-]{1,120}", name) for name in names)
    assert names[0].startswith("gravity-_0_0_-9.81_-dt0.0166666666-pc_type-lu")


def test_quantities() -> None:
    names = ["tip", "edge"]
    assert [q.name for q in parse_quantities("", names)] == [
        "position_l2", "position_max", "energy", "probe_tip", "probe_edge"
    ]  # fmt: skip
    assert [q.name for q in parse_quantities("", [])] == ["position_l2", "position_max", "energy"]
    assert [q.name for q in parse_quantities("edge,energy", names)] == ["probe_edge", "energy"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("positions", "did you mean 'position'"),
        ("position,", "empty name"),
        ("tip,tip", "twice"),
        ("probes,tip", "twice"),
        ("tpi", "did you mean 'tip'"),
    ],
)
def test_unknown_quantities_are_refused(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        parse_quantities(text, ["tip"])
