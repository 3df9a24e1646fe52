"""Fits of small scenes: parameters and intervals, measured quantities, resumption, ranks, refusals."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import lyra_petsc
from lyra_petsc.errors import InputError
from lyra_petsc.experiments.fit.estimate import Misfit, Unknown, conclude, search
from lyra_petsc.experiments.fit.fit_runner import FIT, FitObserver, fit_scene
from lyra_petsc.experiments.fit.model import Model
from lyra_petsc.experiments.fit.readings import readings_of

TRUE = 4.2e-5

STRIP: dict[str, Any] = {
    "mesh": {"grid": {"width": 0.08, "height": 0.02, "nx": 8, "ny": 2, "pattern": "alternating"}},
    "material": {
        "density": 0.15,
        "membrane": {"c11": 500.0, "c22": 500.0, "c12": 100.0, "c33": 100.0},
        "bending": TRUE,
        "bending_model": "midedge",
    },
    "gravity": [0.0, 0.0, -9.81],
    "handles": [{"box": [[-1, -1, -1], [0.0101, 1, 1]]}],
    "probes": {"edge": {"box": [[-1, -1, -1], [0.0001, 1, 1]]}, "tip": {"nodes": [8, 17, 26]}},
    "time": {"analysis": "static"},
    "petsc": {"snes_max_it": 50},
}

BENDING_KEY = ["material.bending"]
BENDING = {"material.bending": {"start": 2e-5, "bounds": [1e-6, 1e-3]}}


RAMP: dict[str, Any] = {
    "loads": [
        {"nodes": [17], "force": [[0.0, [0, 0, 0]], [0.3, [0, 0, 2e-4]], [1.0, [0, 0, 5e-5]]]},
    ]
}


def strip(*measurements: dict[str, Any], parameters: Any = BENDING, **more: Any) -> dict[str, Any]:
    return STRIP | more | {"fit": {"parameters": parameters, "measurements": list(measurements)}}


def hanging() -> tuple[np.ndarray, float, np.ndarray]:
    """Tip, angle and force of the clamp of the true strip."""
    tip = lyra_petsc.gradient(STRIP, "tip", ["material.bending"])
    angle = lyra_petsc.gradient(STRIP, {"overhang": {"edge": "edge", "tip": "tip"}}, ["material.bending"])
    force = lyra_petsc.gradient(STRIP, {"force": 0}, ["material.bending", "material.density"])
    return tip.value, float(angle.value[0]), force


def test_values_and_gradients() -> None:
    """The handle carries the weight whatever the stiffness; the angle is that of the tip."""
    tip, angle, force = hanging()
    assert angle == pytest.approx(np.degrees(np.arctan2(-tip[2], tip[0])), rel=1e-6)
    weight = 0.15 * 0.08 * 0.02 * 9.81
    assert force.value[2] == pytest.approx(weight, rel=1e-4)
    assert force.derivatives["material.density"][2] * 0.15 == pytest.approx(force.value[2], rel=1e-5)
    assert abs(force.derivatives["material.bending"][2]) * TRUE < 1e-6 * weight


@pytest.mark.parametrize("time", [{"analysis": "static"}, {"end": 0.04, "step": 0.002, "integrator": "bdf2"}])
def test_gradient_by_a_value_of_a_curve(time: dict[str, Any]) -> None:
    static, key = (
        "analysis" in time,
        "loads[0].force[1][1][2]" if "end" in time else "loads[0].force[2][1][2]",
    )
    scene, tip = STRIP | RAMP | {"time": time}, {"probe": "tip", "axes": ["z"]}
    gradient = lyra_petsc.gradient(scene, tip, [key])
    step, values = 1e-6, []
    for sign in (1.0, -1.0):
        changed = lyra_petsc.load(scene).changed({key: (5e-5 if static else 2e-4) + sign * step})
        values.append(lyra_petsc.gradient(changed, tip, [key]).value[0])
    assert gradient.derivatives[key][0] == pytest.approx((values[0] - values[1]) / (2.0 * step), rel=1e-3)
    assert abs(gradient.derivatives[key][0]) > 1.0


@pytest.mark.parametrize("kind", ["probe", "overhang", "points"])
def test_a_fit_finds_the_stiffness(kind: str, tmp_path: Path) -> None:
    tip, angle, _ = hanging()
    table = tmp_path / "points.csv"
    table.write_text(f"probe,x,z,uncertainty\ntip,{tip[0]!r},{tip[2]!r},1e-4\n".replace("np.float64", ""))
    measurement = {
        "probe": {"probe": "tip", "axes": ["z"], "value": float(tip[2]), "uncertainty": 1e-4},
        "overhang": {"overhang": {"edge": "edge", "tip": "tip"}, "value": angle, "uncertainty": 0.1},
        "points": {"points": str(table)},
    }[kind]
    fitted = lyra_petsc.fit(strip(measurement))
    (estimate,) = fitted.conclusion.estimates
    assert estimate.value == pytest.approx(TRUE, rel=2e-3)
    low, high = estimate.interval
    assert low < TRUE < high
    # the interval follows from the gradient
    name = "overhang" if kind == "overhang" else "probe"
    quantity = {k: v for k, v in measurement.items() if k in (name, "axes")} if kind != "points" else "tip"
    slope = lyra_petsc.gradient(STRIP, quantity, ["material.bending"]).derivatives["material.bending"]
    if kind != "points":
        sigma = measurement["uncertainty"]
        assert estimate.deviation == pytest.approx(sigma / abs(slope[0]), rel=0.02)


def test_drape_is_the_area_of_the_shadow() -> None:
    content = STRIP | {"gravity": None, "handles": [{"nodes": [0, 1, 9, 10]}]}
    drape = {"drape": {"radius": 0.03, "support": 0.01}}
    coefficient = lyra_petsc.gradient(content, drape, ["material.bending"])
    area, inner, outer = 0.08 * 0.02, np.pi * 1e-4, np.pi * 9e-4
    assert coefficient.value[0] == pytest.approx((area - inner) / (outer - inner), rel=1e-9)


@pytest.mark.parametrize("kind", ["brgn", "blmvm"])
def test_search_and_conclusion(kind: str) -> None:
    """A linear problem: solution, deviations and correlation are those of the normal equations."""
    from petsc4py import PETSc

    rng = np.random.default_rng(3)
    matrix, right = rng.standard_normal((12, 3)), rng.standard_normal(12)
    unknowns = [Unknown(name, 0.5, -10.0, 10.0) for name in "abc"]
    PETSc.Options()["tao_type"] = kind
    best, words = search(unknowns, lambda p: Misfit(p, matrix @ p - right, matrix))
    exact = np.linalg.lstsq(matrix, right, rcond=None)[0]
    covariance = np.linalg.inv(matrix.T @ matrix)
    deviation = np.sqrt(np.diag(covariance))
    assert words.startswith("the search ended")
    assert (np.abs(best.numbers - exact) < 0.3 * deviation).all()
    conclusion = conclude(unknowns, best)
    assert [e.deviation for e in conclusion.estimates] == pytest.approx(deviation)
    assert conclusion.correlation[0, 1] == pytest.approx(covariance[0, 1] / deviation[0] / deviation[1])


def test_a_search_ends_at_a_jump() -> None:
    """The cost jumps where a sheet buckles to the other side, and TAO finds no minimum."""
    rng = np.random.default_rng(5)
    matrix, right = rng.standard_normal((40, 2)), rng.standard_normal(40)
    best = np.linalg.lstsq(matrix, right, rcond=None)[0]
    matrix, right, tried = np.vstack([matrix, [0.0, 0.0]]), np.append(right, 0.0), []

    def jumps(numbers: np.ndarray) -> Misfit:
        tried.append(numbers)
        missed = matrix @ numbers - right
        missed[-1] = 9.0 * (numbers[0] > best[0] - 0.04)
        return Misfit(numbers, missed, matrix)

    end, words = search([Unknown("a", best[0] - 0.1, -9.0, 9.0), Unknown("b", best[1], -9.0, 9.0)], jumps)
    assert words.startswith("the search ended")
    assert best[0] - 0.1 < end.numbers[0] <= best[0] - 0.04
    assert len(tried) < 40


def test_a_parameter_at_its_bound_and_undetermined_parameters() -> None:
    matrix = np.array([[1.0, 1.0, 0.0], [2.0, 2.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 2.0]])
    right = np.array([1.0, 2.0, 5.0, 10.0])
    unknowns = [Unknown("a", 0.2, -10.0, 10.0), Unknown("b", 0.3, -10.0, 10.0), Unknown("c", 1.0, 0.0, 2.0)]
    best, _ = search(unknowns, lambda p: Misfit(p, matrix @ p - right, matrix))
    conclusion = conclude(unknowns, best)
    text = " ".join(conclusion.notes)
    assert "the data cannot tell a and b apart" in text
    assert conclusion.estimates[2].at_bound
    assert conclusion.estimates[2].value == pytest.approx(2.0)
    assert "c is at its bound 2" in text


def test_a_fit_resumes_without_repeating(tmp_path: Path) -> None:
    scene = lyra_petsc.load(strip({"probe": "tip", "axes": ["z"], "value": -0.06, "uncertainty": 1e-3}))

    class Stops(FitObserver):
        def evaluated(self, number: int, evaluation: Misfit, *, resumed: bool) -> None:
            if number == 2:
                raise KeyboardInterrupt

    class Counts(FitObserver):
        evaluations = resumed = 0

        def evaluated(self, number: int, evaluation: Misfit, *, resumed: bool) -> None:
            self.evaluations, self.resumed = self.evaluations + (not resumed), self.resumed + resumed

    comm = MPI.COMM_SELF
    with pytest.raises(KeyboardInterrupt):
        fit_scene(comm, scene, folder=tmp_path, observer=Stops())
    assert FIT.resumable(tmp_path)
    counts = Counts()
    resumed = fit_scene(comm, scene, folder=tmp_path, observer=counts)
    assert counts.resumed == 2
    again = fit_scene(comm, scene)
    assert resumed.parameters == again.parameters
    other = scene.changed({"material.density": 0.2})
    with pytest.raises(InputError, match="another scene"):
        fit_scene(comm, other, folder=tmp_path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fit": None}, "has no block fit"),
        ({"parameters": {"material.bendig": {"start": 1, "bounds": [0, 2]}}}, "did you mean 'bending'"),
        ({"parameters": {"time.end": {"start": 1, "bounds": [0.5, 2]}}}, "no number that can be varied"),
        ({"parameters": {"handles[0].box[0][0]": {"start": 0, "bounds": [-1, 1]}}}, "what box names"),
        ({"parameters": {"handles[0].from": {"start": 0, "bounds": [-1, 1]}}}, "what from names"),
        ({"parameters": {"material.bending": {"start": 1, "bounds": [2, 0]}}}, "lowest number first"),
        ({"parameters": {"material.bending": {"start": 3, "bounds": [0, 2]}}}, "within the bounds"),
        ({"parameters": {"material.bending": {"start": 1, "bounds": [-1, 2]}}}, "-1 cannot be taken"),
        ({"parameters": {"material.damping": {"start": 0.1, "bounds": [0, 2]}}}, "no measurement depends"),
        ({"measurements": [{"probe": "tap", "value": 1, "uncertainty": 1}]}, "did you mean 'tip'"),
        ({"measurements": [{"force": 1, "value": 1, "uncertainty": 1}]}, "has 1 handles"),
        ({"measurements": [{"probe": "tip", "value": 1, "uncertainty": 1}]}, "must hold 3 numbers"),
        ({"measurements": [{"probe": "tip", "at": 2, "value": [0, 0, 0], "uncertainty": 1}]}, "ends at 1"),
        ({"measurements": [{"probe": "tip", "at": 1e-14, "value": [0, 0, 0], "uncertainty": 1}]}, "are > 0"),
        ({"measurements": [{"probe": "tip", "axes": ["z", "z"], "value": 0, "uncertainty": 1}]}, "once"),
        ({"measurements": 2 * [{"force": 0, "value": [0, 0, 0], "uncertainty": 1}]}, "measurements[0] again"),
        (
            {"measurements": [{"probe": "tip", "value": [0, 0, 0], "uncertainty": 1e-300}]},
            "uncertainties; check",
        ),
        ({"parameters": BENDING | {"material[0].bending": BENDING["material.bending"]}}, "is the number"),
        ({"parameters": {"material[0.bending": BENDING["material.bending"]}}, "is no key of a scene"),
        ({"measurements": [{"length": 1}]}, "unknown key"),
        ({"measurements": [{"points": "none.csv"}]}, "none.csv"),
        ({"table": "vertx,x\n1,0\n"}, "neither a column 'vertex' nor 'probe'"),
        ({"table": "vertex,u\n1,0\n"}, "none of the columns x, y, z"),
        ({"table": "vertex,x\n1,0\n"}, "no column 'uncertainty'"),
        ({"table": "vertex,x,uncertainty\n99,0,1\n"}, "vertices 0 to 26"),
        ({"table": "vertex,x,uncertainty\n1,zero,1\n"}, "line 2: x must be a number"),
        ({"table": "vertex,x,uncertainty\n1,0\n"}, "line 2 has 2 columns"),
        ({"table": "vertex,x,uncertainty\n1,0,0\n"}, "uncertainty must be > 0"),
        ({"table": "vertex,x,x,uncertainty\n1,0,0,1\n"}, "two columns 'x'"),
        ({"table": 'vertex,x,uncertainty\n"1,0,1\n2,0,1\n'}, "line 2 has 1 columns"),
        ({"table": "vertex,x,uncertainty\n1,nan,1\n"}, "x must be a number"),
        ({"table": "vertex,x,uncertainty\n1,0,1\n2,0,1\n1,0,1\n"}, "line 4 is line 2 again"),
        ({"table": "vertex,probe,x,uncertainty\n1,tip,0,1\n"}, "columns 'vertex' and 'probe'"),
        ({"table": "vertex,tme,x,uncertainty\n1,1,0,1\n"}, "unknown column 'tme', did you mean 'time'"),
        ({"table": "vertex,x,uncertainty\n" + 100_001 * "1,0,1\n"}, "at most 100000"),
    ],
)
def test_invalid_fits_are_refused(change: dict[str, Any], words: str, tmp_path: Path) -> None:
    good = {"probe": "tip", "axes": ["z"], "value": -0.06, "uncertainty": 1e-3}
    content = strip(good)
    if "fit" in change:
        content = STRIP
    elif "table" in change:
        file = tmp_path / "points.csv"
        file.write_text(change["table"])
        content["fit"]["measurements"] = [{"points": str(file)}]
    else:
        content["fit"] |= change
    with pytest.raises(InputError) as raised:
        lyra_petsc.fit(content, tmp_path / "out")
    assert words in str(raised.value)
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("scene", "quantity", "parameters", "words"),
    [
        (
            STRIP | {"material": {"cloth": "gray-interlock"}},
            "tip",
            BENDING_KEY,
            "number that the scene gives",
        ),
        (5, "tip", BENDING_KEY, "scene: must be a file"),
        (STRIP, 5, BENDING_KEY, "quantity: must be a block"),
        (STRIP, {}, BENDING_KEY, "quantity: must have exactly one"),
        (STRIP, {"probe": "tip", "at": 2.0}, BENDING_KEY, "quantity: measures at load factor 2"),
        (STRIP, "tip", "material.bending", "parameters: must be keys as in"),
        (STRIP, "tip", [], "parameters: must be keys as in"),
        (STRIP, "tip", [5], "parameters: must be keys as in"),
        (STRIP, "tip", {"material.bending": "1"}, "parameters.material.bending: must be a number"),
        (STRIP, "tip", {"material.bending": -1.0}, "must be >= 0"),
        (STRIP, "tip", [*BENDING_KEY, "material[0].bending"], "is the number material.bending"),
        (
            STRIP | RAMP,
            "tip",
            ["loads[0].force[1][0]"],
            "only those of a curve can be varied, as in loads[0]",
        ),
        (STRIP | RAMP, "tip", ["loads[0].force[1]"], "is no value of a point"),
        (STRIP | RAMP, "tip", ["gravity[1][1][2]"], "is no number that the scene gives"),
    ],
)
def test_invalid_gradients_are_refused(scene: Any, quantity: Any, parameters: Any, words: str) -> None:
    with pytest.raises(InputError, match=re.escape(words)):
        lyra_petsc.gradient(scene, quantity, parameters)


def test_gradient_of_a_table_of_points(tmp_path: Path) -> None:
    """At all its times; tables without measured values have no uncertainty."""
    (tmp_path / "points.csv").write_text("time,probe,z\n0.5,tip,0\n1,tip,0\n")
    gradient = lyra_petsc.gradient(STRIP, {"points": str(tmp_path / "points.csv")}, BENDING_KEY)
    once = lyra_petsc.gradient(STRIP, {"probe": "tip", "axes": ["z"]}, BENDING_KEY)
    assert gradient.value[1] == pytest.approx(once.value[0], rel=1e-4)
    assert 0.0 > gradient.value[0] > gradient.value[1]


def test_values_are_in_the_order_of_their_axes() -> None:
    one, other = (
        lyra_petsc.gradient(STRIP, {"probe": "tip", "axes": axes}, BENDING_KEY)
        for axes in (["x", "z"], ["z", "x"])
    )
    assert one.labels == other.labels[::-1]
    np.testing.assert_array_equal(one.value, other.value[::-1])


@pytest.mark.parallel(2)
def test_any_number_of_ranks() -> None:
    scene = lyra_petsc.load(
        strip({"force": 0, "axes": ["x"], "at": 0.5, "value": 0.0, "uncertainty": 1.0},
              {"probe": "tip", "value": [0.035, 0.01, -0.06], "uncertainty": 1e-3})
    )  # fmt: skip
    fitted = fit_scene(MPI.COMM_WORLD, scene)
    assert fitted.parameters["material.bending"] == pytest.approx(2.6226479e-05, rel=1e-5)


def elastica(stiffness: float, weight: float, length: float, s: np.ndarray) -> np.ndarray:
    """Positions x, z (n, 2) [m] at arc lengths s (n,) [m] of a strip that hangs from a horizontal clamp.

    With B [N m] and weight per area [Pa]: B θ'' = weight (length − s) cos θ, θ(0) = 0, θ'(length) = 0.
    """

    def shot(curvature: float) -> Any:
        def rate(at: float, y: Any) -> list[float]:
            turn = weight * (length - at) * np.cos(y[0]) / stiffness
            return [y[1], turn, np.cos(y[0]), np.sin(y[0])]

        return solve_ivp(
            rate, (0.0, length), [0.0, curvature, 0.0, 0.0], rtol=1e-9, atol=1e-12, dense_output=True
        )

    lowest = -weight * length**2 / stiffness
    curvature = brentq(lambda start: shot(start).y[1, -1], lowest, 0.0)
    return np.asarray(shot(curvature).sol(s)[2:].T)


PAGE = Path(__file__).parents[3] / "docs" / "howto" / "fit.md"


def test_the_points_of_the_page_are_those_of_the_elastica() -> None:
    """But for half a millimetre."""
    rows = re.findall(r"^(\d+),([\d.-]+),([\d.-]+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    vertices, points = np.array(rows)[:, 0].astype(int), np.array(rows)[:, 1:].astype(float)
    exact = elastica(4.2e-5, 0.15 * 9.81, 0.08, 0.005 * (vertices % 17))
    assert 2e-4 < (points - exact).std() < 8e-4


@pytest.mark.parametrize(("stiffness", "cells"), [(3.6e-5, 24), (1.2e-4, 16)])
def test_intervals_of_an_overhang_hold_the_stiffness_of_the_elastica(stiffness: float, cells: int) -> None:
    tip = elastica(stiffness, 0.245 * 9.81, 0.06, np.array([0.06]))[0]
    angle = float(np.degrees(np.arctan2(-tip[1], tip[0])))
    overhang = {"overhang": {"edge": "edge", "tip": "tip"}, "value": angle, "uncertainty": 0.1}
    clamped = [[-1, -1, -1], [0, 1, 1]]
    content = strip(
        overhang,
        mesh={"grid": {"width": 0.06, "height": 0.025, "nx": cells, "ny": 4, "pattern": "alternating"}},
        material=STRIP["material"] | {"density": 0.245},
        handles=[{"box": clamped, "clamp": True}],
        probes={"edge": {"box": clamped}, "tip": {"box": [[0.06, -1, -1], [1, 1, 1]]}},
        petsc={},
    )
    fitted = lyra_petsc.fit(content)
    low, high = fitted.intervals["material.bending"]
    assert low < stiffness < high
    assert high - low < 0.05 * stiffness


HINGES = STRIP["material"] | {"bending_model": "hinge"}
TIP = {"probe": "tip", "axes": ["z"], "value": -0.03, "uncertainty": 1e-3}
SQUARE = {"grid": {"width": 0.08, "height": 0.06, "nx": 8, "ny": 2, "pattern": "alternating"}}


@pytest.mark.parametrize(
    ("key", "number", "words"),
    [
        ("material.bending", 2e-5, "add 'bending_model: midedge' to material[0]"),
        ("material.bending_scale", 1.0, "add 'bending_model: midedge' to material[0]"),
        ("material[0].bending[1]", 2e-5, "add 'bending_model: midedge' to material[0]"),
    ],
)
def test_bending_of_hinges_on_a_strip_is_refused(key: str, number: float, words: str) -> None:
    bending = {"bending": [TRUE] * 3} if key.endswith("]") else {}
    parameters = {key: {"start": number, "bounds": [0.5 * number, 2.0 * number]}}
    content = strip(TIP, material=HINGES | bending, parameters=parameters)
    with pytest.raises(InputError, match=re.escape(words)) as refused:
        lyra_petsc.fit(content)
    assert refused.value.key == f"fit.parameters.{key}"


def test_other_numbers_and_other_sheets_of_hinges_are_fitted() -> None:
    density = {"material.density": {"start": 0.14, "bounds": [0.1, 0.2]}}
    fitted = lyra_petsc.fit(strip(TIP, material=HINGES, parameters=density))
    assert not any("hinges" in note for note in fitted.conclusion.notes)
    nodes = {"edge": {"nodes": [0]}, "tip": {"nodes": [8]}}
    fitted = lyra_petsc.fit(strip(TIP, material=HINGES, mesh=SQUARE, probes=nodes))
    assert any("hinges on this mesh" in note for note in fitted.conclusion.notes)


@pytest.mark.slow
def test_contact_by_differences() -> None:
    """With contact, derivatives are differences of whole runs."""
    content = STRIP | {
        "contact": {"gap": 2e-3, "self": False},
        "obstacles": {"floor": {"plane": {"point": [0, 0, -0.02], "normal": [0, 0, 1]}}},
        "time": {"end": 0.04, "step": 0.02},
    }
    gradient = lyra_petsc.gradient(content, {"probe": "tip", "axes": ["z"]}, ["material.density"])
    assert np.isfinite(gradient.derivatives["material.density"]).all()


def test_report(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from lyra_petsc.experiments.fit.fit_report import FitView, outcome_of
    from lyra_petsc.experiments.results import Results

    scene = lyra_petsc.load(strip({"probe": "tip", "axes": ["z"], "value": -0.06, "uncertainty": 1e-3}))
    comm = MPI.COMM_SELF
    results: Any = Results(comm, tmp_path / "fit", FitView("A strip"), ranks=1, command=["fit"])
    outcome = outcome_of(fit_scene(comm, scene))
    results.run([outcome.case], lambda case: outcome)
    text = json.loads((tmp_path / "fit" / "fit.json").read_text())["cases"][0]
    assert text["parameters"][0]["key"] == "material.bending"
    assert text["measurements"][0]["after"] == pytest.approx(-0.06, abs=2e-4)
    page = (tmp_path / "fit" / "report.md").read_text()
    assert "95 % interval" in page
    assert "before and after the fit" in page
    assert (tmp_path / "fit" / "plots" / "shape-after.png").exists()


@pytest.mark.slow
def test_intervals_contain_the_true_values() -> None:
    """Fits to values with noise of 1 %: two misses in six seeds have probability 1/30."""
    true = {"material.membrane.c33": 8.0, "material.bending": 1e-3, "wind.density": 1.2}
    vertices, comm = (7, 9, 14, 20, 21, 30, 33, 35), MPI.COMM_SELF
    content: dict[str, Any] = {
        "mesh": {"grid": {"width": 0.5, "height": 0.5, "nx": 5, "ny": 5, "pattern": "alternating"}},
        "material": {
            "density": 0.2,
            "membrane": {"c11": 60.0, "c22": 50.0, "c12": 10.0, "c33": 8.0},
            "bending": 1e-3,
        },
        "gravity": [0.0, 0.0, -9.81],
        "wind": {"velocity": [0.5, 2.0, 1.0], "density": 1.2, "drag": 0.1},
        "handles": [{"nodes": [0, 5]}],
        "time": {"end": 0.4, "step": 0.05, "integrator": "bdf2"},
        "probes": {f"v{vertex}": {"nodes": [vertex]} for vertex in vertices},
        "fit": {
            "parameters": {
                key: {"start": start * true[key], "bounds": [0.05 * true[key], 5.0 * true[key]]}
                for key, start in zip(true, (1.15, 0.85, 0.9), strict=True)
            },
            "measurements": [
                {"probe": f"v{vertex}", "at": at, "value": [0.0, 0.0, 0.0], "uncertainty": 5e-3}
                for vertex in vertices
                for at in (0.1, 0.2, 0.3, 0.4)
            ],
        },
    }
    scene = lyra_petsc.load(content)
    assert scene.fit is not None
    model = Model(comm, scene, true, readings_of(scene, scene.fit.measurements))
    exact = model.evaluate(list(true.values()), derivatives=False).values
    ends = np.cumsum([len(reading.parts) for reading in model.readings])[:-1]
    covered = dict.fromkeys(true, 0)
    for seed in range(6):
        noise = 5e-3 * np.random.default_rng(seed).standard_normal(len(exact))
        fitted = fit_scene(comm, scene, measured=np.split(exact + noise, ends))
        for key, (low, high) in fitted.intervals.items():
            covered[key] += low <= true[key] <= high
    assert min(covered.values()) >= 5
