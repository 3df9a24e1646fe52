"""Files and output of a run."""

from __future__ import annotations

import os
import pty
import select
import subprocess
from pathlib import Path

import h5py
import meshio
import numpy as np
import pytest
from launch import SCENE, command, done, environment, read_csv, read_json, write_scene
from patience import Patience

from lyra_petsc.output.history import HISTORY_COLUMNS
from lyra_petsc.output.read_run import stored_states
from lyra_petsc.scene.load import load_scene

pytestmark = pytest.mark.quick

ALL_FIELDS = (
    "[velocity, displacement, green_strain, stress, membrane_energy, bending_energy, curvature, rank]"
)
FULL = SCENE.replace("{every: 0.02}", "{every: 0.02, reactions: true, fields: " + ALL_FIELDS + "}")
FULL += "probes: {corner: {nodes: [20]}, edge: {nodes: [20, 24]}}\n"


@pytest.fixture(scope="module", params=[1, 2], ids=["one rank", "two ranks"])
def full(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("full")
    done(["run", write_scene(folder, FULL), "--out", "out"], folder, request.param)
    return folder / "out"


def test_a_run_writes_all_files(full: Path) -> None:
    names = {path.name for path in full.iterdir()}
    assert {"states.xdmf", "mesh.h5", "checkpoint.h5", "history.csv", "scene.yaml", "summary.json"} <= names
    assert {"probes.csv", "reactions.csv", "states-0000.h5"} <= names
    assert not [name for name in names if name.endswith(".part")]


def states(run: Path) -> dict[float, dict[str, np.ndarray]]:
    found = {}
    for number, state in enumerate(stored_states(run)):
        assert state.number == number
        with h5py.File(run / state.file, "r") as file:
            group = file[f"states/{number:06d}"]
            found[state.time] = {key: np.array(data) for key, data in group.items()}
    return found


def test_states_are_at_the_start_at_multiples_and_at_the_end(full: Path) -> None:
    found = states(full)
    assert sorted(found) == pytest.approx([0, 0.02, 0.04, 0.05], abs=1e-15)
    first = found[0.0]
    x, y = np.meshgrid(np.linspace(0, 1, 5), np.linspace(0, 1, 5))
    expected = np.column_stack([x.ravel(), y.ravel(), np.zeros(25)])
    np.testing.assert_allclose(first["position"], expected, atol=1e-15)
    shapes = {name: data.shape for name, data in first.items()}
    assert shapes == {
        "position": (25, 3),
        "velocity": (25, 3),
        "displacement": (25, 3),
        "green_strain": (32, 6),
        "stress": (32, 6),
        "membrane_energy": (32,),
        "bending_energy": (25,),
        "curvature": (25,),
        "rank": (25,),
    }
    for state in found.values():
        np.testing.assert_array_equal(state["position"][[0, 4]], expected[[0, 4]])


def test_fields_agree_with_the_history(full: Path) -> None:
    """Energy densities integrate to the energies of the same step; kinetic energy is ½ m v²."""
    last = states(full)[max(states(full))]
    row = read_csv(full / "history.csv")[-1]
    assert last["membrane_energy"].sum() / 32 == pytest.approx(float(row["membrane_energy"]), rel=1e-9)
    with h5py.File(full / "mesh.h5", "r") as file:
        triangles = np.array(file["mesh/triangles"])
        np.testing.assert_array_equal(np.array(file["mesh/rest"])[:, :2], np.array(file["mesh/uv"]))
    area = np.bincount(triangles.ravel(), minlength=25) / 32 / 3
    assert area @ last["bending_energy"] == pytest.approx(float(row["bending_energy"]), rel=1e-9)
    kinetic = 0.5 * 0.15 * area @ (last["velocity"] ** 2).sum(axis=1)
    assert kinetic == pytest.approx(float(row["kinetic_energy"]), rel=1e-9)
    fall = -0.15 * 9.81 * area @ (-last["position"][:, 2])
    assert fall == pytest.approx(float(row["potential_energy"]), rel=1e-9)


def test_the_time_series_can_be_read(full: Path) -> None:
    found = states(full)
    with meshio.xdmf.TimeSeriesReader(full / "states.xdmf") as reader:
        points, cells = reader.read_points_cells()
        assert cells[0].type == "triangle"
        assert len(cells[0].data) == 32
        assert reader.num_steps == len(found)
        times = [reader.read_data(step)[0] for step in range(reader.num_steps)]
    assert times == pytest.approx(sorted(found), abs=1e-12)
    assert len(points) == 25


def test_the_history_has_its_columns_and_each_step(full: Path) -> None:
    rows = read_csv(full / "history.csv")
    assert list(rows[0]) == list(HISTORY_COLUMNS)
    assert ",".join(HISTORY_COLUMNS) == (
        "step,time,dt,newton_iterations,linear_iterations,rejected,kinetic_energy,membrane_energy,"
        "bending_energy,potential_energy,external_work,dissipation,residual,wall_seconds"
    )
    assert [int(row["step"]) for row in rows] == list(range(6))
    assert all(np.isfinite(float(value)) for row in rows for value in row.values())


def test_probes_are_means_of_positions(full: Path) -> None:
    rows = read_csv(full / "probes.csv")
    last = states(full)[max(states(full))]["position"]
    for axis, name in enumerate("xyz"):
        assert float(rows[-1][f"corner_{name}"]) == pytest.approx(last[20, axis], abs=1e-14)
        assert float(rows[-1][f"edge_{name}"]) == pytest.approx(last[[20, 24], axis].mean(), abs=1e-14)


def test_the_written_scene_loads_as_the_same_scene(full: Path) -> None:
    assert load_scene(full / "scene.yaml", []) == load_scene(full.parent / "scene.yaml", [])


def test_the_summary_has_outcome_and_versions(full: Path) -> None:
    summary = read_json(full / "summary.json")
    assert summary["outcome"] == "done"
    assert summary["sizes"] == {"vertices": 25, "triangles": 32, "unknowns": 75}
    assert summary["terms"] == ["membrane", "bending", "gravity"]
    assert {"mesh", "partition", "assembly", "solve", "balance", "output"} <= set(summary["wall_seconds"])
    assert {"petsc", "mpi", "numpy", "lyra_petsc"} <= set(summary["versions"])
    rows = read_csv(full / "history.csv")
    assert summary["newton_iterations"] == sum(int(row["newton_iterations"]) for row in rows)


def test_reactions_of_a_sheet_at_rest_carry_its_weight(tmp_path: Path) -> None:
    scene = SCENE.replace("nodes: [0, 4]", "box: [[-1, -1, -1], [2, 0.1, 1]]").replace("0.005", "0.5")
    scene = scene.replace("{every: 0.02}", "{every: 1, reactions: true}").replace("end: 0.05", "end: 8")
    scene = scene.replace("step: 0.01", "step: 0.1").replace(
        "gravity: [0, 0, -9.81]", "gravity: [0, 9.81, 0]"
    )
    done(["run", write_scene(tmp_path, scene), "--out", "out"], tmp_path)
    assert float(read_csv(tmp_path / "out/history.csv")[-1]["kinetic_energy"]) < 1e-12
    force = [float(read_csv(tmp_path / "out/reactions.csv")[-1][f"handle0_{axis}"]) for axis in "xyz"]
    assert force == pytest.approx([0, -0.15 * 9.81, 0], abs=1e-4 * 0.15 * 9.81)


def on_a_terminal(folder: Path, *options: str) -> str:
    """All that a run prints to a terminal of 120 columns."""
    master, slave = pty.openpty()
    words = command(["run", write_scene(folder), "--out", "out", *options])
    extra = {"TERM": "xterm", "COLUMNS": "120", "LINES": "40"}
    process = subprocess.Popen(
        words, cwd=folder, env=environment(extra), stdin=slave, stdout=slave, stderr=slave
    )
    os.close(slave)
    shown, patience = b"", Patience()
    while not patience.over:
        if select.select([master], [], [], 0.1)[0]:
            try:
                part = os.read(master, 65536)
            except OSError:  # the other end is closed
                break
            if not part:
                break
            shown += part
        elif process.poll() is not None:
            break
    os.close(master)
    assert process.wait(timeout=600) == 0, shown
    return shown.decode()


def test_a_terminal_gets_a_bar_and_a_closing_table(tmp_path: Path) -> None:
    shown = on_a_terminal(tmp_path)
    assert "━" in shown
    assert "\x1b[" in shown
    assert "phase" in shown
    assert "paraview" in shown


def test_monitors_on_a_terminal_get_plain_lines(tmp_path: Path) -> None:
    shown = on_a_terminal(tmp_path, "-ts_monitor")
    assert "5 TS dt 0.01" in shown
    assert "━" not in shown


def test_without_a_terminal_there_are_plain_lines(tmp_path: Path) -> None:
    left = done(["run", write_scene(tmp_path), "--out", "out"], tmp_path)
    assert "\x1b" not in left.out + left.err
    assert "━" not in left.out + left.err
    assert "100%  t 0.05 of 0.05 s  step 5" in left.err
    assert "outcome      done" in left.out
