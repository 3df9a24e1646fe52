"""Reading the results of a run from Python."""

import subprocess
import sys

import numpy as np
import pytest
from written_run import REST, TRIANGLES, Writer, position, tensor, velocity, written

from lyra_petsc.errors import InputError
from lyra_petsc.output import read_run as tables
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.scene.schema import FIELDS


def test_states_are_read_as_they_were_written(tmp_path):
    run = StoredRun(written(tmp_path / "run", states=4))

    assert len(run) == len(run.positions) == 4
    np.testing.assert_array_equal(run.times, [0.0, 0.1, 0.2, 0.1 * 3])
    np.testing.assert_array_equal(run.triangles, TRIANGLES)
    np.testing.assert_array_equal(run.rest, REST)
    np.testing.assert_array_equal(run.positions[-1], position(3))
    np.testing.assert_array_equal(np.asarray(run.positions), [position(i) for i in range(4)])
    assert run.fields == ("velocity", "stress")
    np.testing.assert_array_equal(run.velocities[1], velocity(1))
    np.testing.assert_array_equal(run.field("stress")[2], tensor(2))
    assert len(REST) == len(TRIANGLES)  # the number of rows does not tell
    assert (run.field_on("velocity"), run.field_on("stress")) == ("vertex", "triangle")
    assert run.name == "run"


def test_a_slice_of_states_is_lazy(tmp_path):
    run = StoredRun(written(tmp_path, states=6))
    chosen = run.positions[1:-1:3]
    (tmp_path / "states-0004.h5").unlink()

    assert len(chosen) == 2
    np.testing.assert_array_equal(chosen[0], position(1))
    with pytest.raises(InputError, match=r"states-0004\.h5: .*: no such file$"):
        chosen[1]
    with pytest.raises(IndexError):
        chosen[2]


def test_nearest_state(tmp_path):
    run = StoredRun(written(tmp_path, states=4))
    assert [run.at(time) for time in (-1.0, 0.0, 0.14, 0.16, 9.0)] == [0, 0, 1, 2, 3]


@pytest.mark.parametrize("vt", ["none", "each vertex", "seam"])
def test_texture_coordinates(tmp_path, vt):
    run = StoredRun(written(tmp_path, vt=vt))
    expected = REST[TRIANGLES][..., :2] / 3.0
    if vt == "none":
        assert run.uv is None
        assert run.corner_uv is None
    elif vt == "seam":
        expected[3] += 0.25
        assert run.uv is None
        np.testing.assert_array_equal(run.corner_uv, expected)
    else:
        np.testing.assert_array_equal(run.uv, REST[:, :2] / 3.0)
        np.testing.assert_array_equal(run.corner_uv, expected)


def test_a_run_that_continues(tmp_path):
    writer = Writer(tmp_path)
    with pytest.raises(InputError, match="no state is written yet"):
        StoredRun(tmp_path)

    writer.write()
    run = StoredRun(tmp_path)
    assert len(run.history["step"]) == 1
    assert not run.refresh()
    writer.write()
    writer.write()
    assert len(run) == 1
    assert run.refresh()
    assert len(run) == 3
    assert len(run.history["step"]) == 3
    np.testing.assert_array_equal(run.positions[-1], position(2))
    assert run.summary == {}
    assert not run.finished
    (tmp_path / "summary.json").write_text('{"outcome": "done"}')
    run.refresh()
    assert run.finished


@pytest.mark.parametrize("pandas", [True, False])
def test_history_is_a_pandas_frame_if_pandas_is_installed(tmp_path, monkeypatch, pandas):
    if pandas:
        pytest.importorskip("pandas")
    else:
        monkeypatch.setattr(tables.importlib.util, "find_spec", lambda name: None)
    folder = written(tmp_path, states=3)
    with (folder / "history.csv").open("a") as half:
        half.write("3,0.30000000000000004,0.1")
    run = StoredRun(folder)

    assert isinstance(run.history, dict) is not pandas
    assert list(run.history["step"]) == [0, 1, 2]
    assert run.history["newton_iterations"].dtype == np.int64
    assert list(run.energies)[:2] == ["time", "kinetic_energy"]
    assert list(run.iterations["newton_iterations"]) == [2, 2, 2]
    assert len(run.reactions) == 0


def test_dataset(tmp_path):
    pytest.importorskip("xarray")
    data = StoredRun(written(tmp_path, states=5)).dataset(every=2)
    np.testing.assert_array_equal(data.time, [0.0, 0.2, 0.4])
    np.testing.assert_array_equal(data.position.sel(time=0.4), position(4))
    np.testing.assert_array_equal(data.velocity.sel(axis="z", time=0.2), velocity(2)[:, 2])
    np.testing.assert_array_equal(data.stress[1], tensor(2))
    assert data.stress.dims == ("time", "triangle", "component")
    assert data.stress.attrs["units"] == "N/m"
    np.testing.assert_array_equal(data.triangles, TRIANGLES)


def test_units_of_all_fields(tmp_path):
    run = StoredRun(written(tmp_path))
    assert [run.field_units(name) for name in ("position", "velocity", "stress")] == ["m", "m/s", "N/m"]
    assert all(run.field_units(name) for name in FIELDS)


def test_the_scene_is_read_without_its_mesh_file(tmp_path):
    folder = written(tmp_path)
    text = (folder / "scene.yaml").read_text()
    start, end = text.index("- grid"), text.index("material:")
    (folder / "scene.yaml").write_text(text[:start] + "- {file: /nowhere/flag.geo}\n" + text[end:])
    assert str(StoredRun(folder).scene.mesh[0].file) == "/nowhere/flag.geo"


def test_folders_that_are_no_runs_are_refused(tmp_path):
    folder = written(tmp_path / "a")
    file = tmp_path / "file"
    file.touch()
    for path, words in (
        (tmp_path / "none", "no such folder"),
        (file, "is a file"),
        (tmp_path, "not the folder"),
    ):
        with pytest.raises(InputError, match=words):
            StoredRun(path)
    with pytest.raises(InputError, match=r"no field 'velocit', did you mean 'velocity'"):
        StoredRun(folder).field("velocit")
    with pytest.raises(InputError, match="positions alone"):
        _ = StoredRun(written(tmp_path / "b", fields=False)).velocities
    (folder / "states-0000.h5").write_bytes(b"")
    with pytest.raises(InputError, match=r"states-0000\.h5: cannot be read, or is damaged"):
        StoredRun(folder)


def test_reading_needs_neither_mpi_nor_petsc(tmp_path):
    folder = written(tmp_path)
    program = f"""
import sys
from lyra_petsc.output.read_run import StoredRun
assert not {{"h5py", "pydantic", "pandas"}} & sys.modules.keys()
run = StoredRun({str(folder)!r})
run.positions[-1], run.history, run.scene, run.uv, run.summary
assert not any(name.startswith(("mpi4py", "petsc4py")) for name in sys.modules)
"""
    subprocess.run([sys.executable, "-c", program], check=True)
