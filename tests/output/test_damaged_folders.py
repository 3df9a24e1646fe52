"""Damaged files of a run give one line that names the file, and no other exception."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from written_run import ENTRIES, REST, TRIANGLES, position, written

from lyra_petsc.errors import InputError
from lyra_petsc.output.checkpoint import read_checkpoint, write_checkpoint
from lyra_petsc.output.layout import CHECKPOINT
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.output.stored import import_h5py

pytestmark = pytest.mark.quick

ORDER = FileOrder(MPI.COMM_SELF, np.arange(len(REST)), len(REST))
SUMMARY = {"outcome": "done", "ranks": 2, "terms": ["membrane"], "wall_seconds": {"solve": 1.5}, "notes": []}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A folder with states, tables, a summary and two checkpoints."""
    folder = written(tmp_path_factory.mktemp("whole") / "run", states=3)
    (folder / "summary.json").write_text(json.dumps(SUMMARY), encoding="utf-8")
    for step in (6, 7):
        arrays = {"position": position(step), "velocity": -position(step)}
        write_checkpoint(folder, ORDER, arrays, ENTRIES | {"step": step})()
    return folder


@pytest.fixture
def run(whole, tmp_path):
    return Path(shutil.copytree(whole, tmp_path / "run"))


def read_all(folder):
    """Read all of a run's folder, and check that the values are those that were written."""
    run = StoredRun(folder)
    for i in range(len(run)):
        run.positions[i]
        assert np.isfinite(run.positions[i]).all()
    for name in run.fields:
        run.field_units(name)
        np.asarray(run.field(name))
    assert run.triangles.max() < len(run.rest)
    _ = run.uv, run.corner_uv, run.mesh.groups, run.mesh.start
    _ = run.energies, run.iterations, run.scene, run.finished
    return run


def one_line(caught):
    text = str(caught.value)
    assert "\n" not in text
    assert caught.value.exit_code == 2
    return text


def test_an_undamaged_folder_is_read(run):
    found = read_all(run)
    np.testing.assert_array_equal(found.positions[2], position(2))
    assert read_checkpoint(run, ORDER).scalars["step"] == 7


def states_file(folder):
    return next(iter(sorted(folder.glob("states-*.h5"))))


@pytest.mark.parametrize("name", ["mesh.h5", "states", "history.csv", "summary.json", "scene.yaml"])
def test_a_file_with_a_flipped_bit_is_read_or_refused_in_one_line(run, name):
    path = states_file(run) if name == "states" else run / name
    content = path.read_bytes()
    random = np.random.default_rng(len(content))
    said = []
    for place in random.integers(0, 8 * len(content), 25):
        damaged = bytearray(content)
        damaged[place // 8] ^= 1 << (place % 8)
        path.write_bytes(damaged)
        try:
            read_all(run)
        except InputError as error:
            said.append(str(error))
    if not name.endswith(".yaml"):
        assert said
    assert not any("\n" in text for text in said)


def test_flipped_bits_of_arrays_are_detected(run):
    """In positions and triangles all of them are."""
    mesh = run / "mesh.h5"
    for path, array in ((states_file(run), position(1)), (mesh, TRIANGLES), (mesh, REST)):
        content = path.read_bytes()
        place = content.find(array.tobytes())
        assert place > 0
        for bit in np.random.default_rng(1).integers(0, 8 * array.nbytes, 20):
            damaged = bytearray(content)
            damaged[place + bit // 8] ^= 1 << (bit % 8)
            path.write_bytes(damaged)
            with pytest.raises(InputError, match="damaged"):
                read_all(run)
        path.write_bytes(content)


def test_a_checkpoint_with_a_flipped_bit_is_replaced_by_the_previous_one(run):
    path = run / CHECKPOINT
    content = path.read_bytes()
    for place in np.random.default_rng(3).integers(0, 8 * len(content), 100):
        damaged = bytearray(content)
        damaged[place // 8] ^= 1 << (place % 8)
        path.write_bytes(damaged)
        found = read_checkpoint(run, ORDER)
        step = found.scalars["step"]
        assert (step == 7) == (found.note is None)
        assert found.scalars == ENTRIES | {"step": step}
        np.testing.assert_array_equal(found.arrays["position"], position(step))
        np.testing.assert_array_equal(found.arrays["velocity"], -position(step))


def change_mesh(name, values):
    def work(folder):
        with import_h5py().File(folder / "mesh.h5", "a") as file:
            del file[name]
            file[name] = values

    return work


@pytest.mark.parametrize(
    "damage",
    [
        change_mesh("mesh/triangles", np.where(TRIANGLES == 7, 8, TRIANGLES)),
        change_mesh("mesh/triangles", TRIANGLES - 1),
        change_mesh("mesh/triangles", TRIANGLES[:, :2]),
        change_mesh("mesh/triangles", TRIANGLES.ravel()),
        change_mesh("mesh/triangles", TRIANGLES.astype(float)),
        change_mesh("mesh/triangles", 3),
        change_mesh("mesh/rest", REST[:, :2]),
        change_mesh("mesh/rest", REST[:5]),
        change_mesh("mesh/rest", np.full_like(REST, np.nan)),
        change_mesh("mesh/rest", b"text"),
        change_mesh("mesh/uv", REST),
        change_mesh("mesh/rest/x", 1),
    ],
)
def test_mesh_of_another_shape(run, damage):
    try:
        damage(run)
    except KeyError:
        with import_h5py().File(run / "mesh.h5", "a") as file:
            del file["mesh/rest"]
            file["mesh/rest/x"] = 1
    with pytest.raises(InputError) as caught:
        read_all(run)
    assert "mesh.h5" in one_line(caught) or "states-" in one_line(caught)


@pytest.mark.parametrize(
    "values", [np.full((8, 3), np.nan), np.zeros((8, 2)), np.zeros(24), np.zeros((7, 3)), 1.0, b"text"]
)
def test_states_of_another_shape(run, values):
    with import_h5py().File(states_file(run), "a") as file:
        del file["states/000000/position"]
        file["states/000000/position"] = values
    with pytest.raises(InputError) as caught:
        read_all(run)
    assert "states-" in one_line(caught)


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100000,
        '{"notes":' * 100000,
        "[]",
        "7",
        "\x00",
        '{"outcome": 3}',
        '{"ranks": "two"}',
        '{"terms": 5}',
        '{"notes": [[]]}',
        '{"wall_seconds": {"solve": "long"}}',
        '{"wall_seconds": [1]}',
        '{"versions": []}',
        '{"resumed": [3]}',
        '{"resumed": {"step": 3}}',
        '{"failure": []}',
        '{"failure": {"advice": 3}}',
        '{"estimated_error": "small"}',
    ],
)
def test_mistyped_summaries(run, text):
    (run / "summary.json").write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        _ = StoredRun(run).summary
    assert "summary.json" in one_line(caught)
    assert StoredRun(run).positions[0].shape == REST.shape


@pytest.mark.parametrize(
    "text", ["", "\n", "{header}\n", "{header}\n1,2\n", "step,time\n0,0\n", "{header}\nx{row}\n"]
)
def test_truncated_tables(run, text):
    path = run / "history.csv"
    header, row, *_ = path.read_text(encoding="utf-8").splitlines()
    path.write_text(text.format(header=header, row=row), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        _ = StoredRun(run).history
    assert "history.csv" in one_line(caught)


def test_a_table_with_invalid_numbers(run):
    path = run / "history.csv"
    text = path.read_text(encoding="utf-8")
    for new in ("nan", "inf", "99999999999999999999999", ""):
        path.write_text(text.replace("0.5", new), encoding="utf-8")
        if new == "99999999999999999999999":
            _ = StoredRun(run).history
            continue
        with pytest.raises(InputError, match=r"history\.csv"):
            _ = StoredRun(run).history
