"""Content of the page: colours and plots."""

import numpy as np
import pytest
from written_run import TRIANGLES, velocity, written

from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.show.render.colour_quantities import ColourRange
from lyra_petsc.show.view import page_content as plots
from lyra_petsc.show.view.page_content import Palette, _number, names, sample


def test_colours_follow_the_values(tmp_path):
    run = StoredRun(written(tmp_path))
    assert {"speed", "displacement", "strain", "stress"} <= set(names(run))
    palette = Palette(run, "speed")
    colours, on_triangles = palette.colours(0)
    assert not on_triangles
    assert colours.shape == (8, 3)
    order = np.argsort(np.linalg.norm(velocity(0), axis=1))
    assert colours[order[0]].tolist() == [68, 1, 84]  # viridis begins there
    # viridis gets greener all the way up
    assert (np.diff(colours[order][:, 1].astype(int)) >= 0).all()


def test_the_bar_names_quantity_unit_and_range(tmp_path):
    run = StoredRun(written(tmp_path))
    bar = Palette(run, "speed").bar()
    assert bar["title"] == "speed [m/s]"
    ticks = [float(tick) for tick in bar["ticks"]]
    assert len(ticks) == 5
    assert ticks == sorted(ticks, reverse=True)
    largest = max(np.linalg.norm(velocity(i), axis=1).max() for i in range(3))
    assert ticks[0] == pytest.approx(largest, rel=0.05)
    assert bar["shades"].count("rgb(") == 16
    assert Palette(run, "stress", cells=True).colours(1)[1]
    assert Palette(run, "stress", cells=True).colours(1)[0].shape == (len(TRIANGLES), 3)
    assert Palette(run, "stress").colours(1)[0].shape == (8, 3)
    bar = Palette(run, "stress", ColourRange.parse("0,4"), "gray").bar()
    assert bar["ticks"] == ["4", "3", "2", "1", "0"]
    assert bar["shades"].startswith("rgb(0 0 0), rgb(17 17 17)")


@pytest.mark.parametrize(
    ("value", "span", "text"),
    [
        (2184.3, 2200.0, "2180"),
        (-1.9e-8, 2200.0, "0"),
        (0.00126, 0.3, "0.00126"),
        (0.0, 0.0, "0"),
        (3e7, 3e7, "3e+07"),
    ],
)
def test_numbers_of_the_bar_are_short(value, span, text):
    assert _number(value, span) == text


def test_without_velocities_there_is_no_speed(tmp_path):
    run = StoredRun(written(tmp_path, fields=False))
    assert names(run) == ["displacement", "strain"]
    run.fields = ("displacement", "stress")
    assert names(run) == ["displacement", "strain", "stress"]
    run.fields = ()
    assert Palette(run, "displacement").colours(0)[0].shape == (8, 3)


def test_a_uniform_quantity_has_a_colour(tmp_path):
    run = StoredRun(written(tmp_path, states=1))
    colours, _ = Palette(run, "displacement").colours(0)
    assert (colours == colours[0]).all()


@pytest.mark.parametrize("count", [1, 2, 11, 12, 13, 1000])
def test_samples_are_few_and_include_both_ends(count):
    chosen = sample(count, 12)
    assert chosen[0] == 0
    assert chosen[-1] == count - 1
    assert len(chosen) == min(count, 12)


def history(rows):
    columns = {
        f"{name}_energy": np.linspace(1, 2, rows) for name in ("kinetic", "membrane", "bending", "potential")
    }
    steps = np.arange(rows)
    return {
        "time": 0.1 * steps,
        **columns,
        "newton_iterations": steps % 7,
        "linear_iterations": np.where(steps == 123, 999, 5),
    }


def test_plots_have_units_and_few_points():
    figure = plots.energies(history(5000), "s")
    assert {line["name"] for line in figure["data"]} == {
        "kinetic",
        "membrane",
        "bending",
        "potential",
        "total",
    }
    for line in figure["data"]:
        assert len(line["x"]) == len(line["y"]) <= plots.MAX_POINTS
        assert line["x"][-1] == pytest.approx(499.9)
    potential = next(line for line in figure["data"] if line["name"] == "potential")
    assert potential["y"][0] == 0.0
    assert "[J]" in figure["layout"]["title"]["text"]
    assert figure["layout"]["xaxis"]["title"]["text"] == "time [s]"
    assert plots.energies(history(3), "")["layout"]["xaxis"]["title"]["text"] == "load factor"


def test_an_expensive_step_is_not_left_out():
    linear = plots.iterations(history(5000), "s")["data"][1]
    assert max(linear["y"]) == 999


def test_nan_values_are_gaps():
    columns = history(4)
    columns["kinetic_energy"][2] = np.nan
    kinetic = plots.energies(columns, "s")["data"][0]
    assert kinetic["y"][2] is None


def test_the_time_shown_is_marked():
    figure = plots.at_time(plots.energies(history(10), "s"), 0.25)
    (mark,) = figure["layout"]["shapes"]
    assert mark["x0"] == mark["x1"] == 0.25


def test_a_run_that_has_just_started_has_plots():
    for rows in (0, 1):
        for plot in (plots.energies, plots.iterations):
            assert all(len(line["x"]) == rows for line in plot(history(rows), "s")["data"])
