"""Collective writing of HDF5 files, through rank 0 and by all ranks, reading of slabs, and failures."""

import errno
import resource

import numpy as np
import pytest

from lyra_petsc.errors import InputError, OutputError
from lyra_petsc.output import hdf5
from lyra_petsc.output.hdf5 import read_slab, write_rows
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.stored import import_h5py

pytestmark = [pytest.mark.parallel(3), pytest.mark.quick]

h5py = import_h5py()


@pytest.fixture(params=["through rank 0", "by all ranks"])
def way(request, monkeypatch):
    """A way of writing rows."""
    if request.param == "by all ranks" and not h5py.get_config().mpi:
        pytest.skip("h5py is built without MPI")
    monkeypatch.setattr(hdf5, "on_one_machine", lambda comm: request.param == "through rank 0")
    monkeypatch.setattr(hdf5, "BLOCK", 1 << 9)


def whole(n):
    return np.random.default_rng(1).normal(size=(n, 3))


def slab_of(comm, array):
    n = len(array)
    return array[comm.rank * n // comm.size : (comm.rank + 1) * n // comm.size]


def write(comm, path, content, attributes=None):
    """Create a file for whole arrays, of which each rank writes its slab."""
    slabs = {name: slab_of(comm, rows) for name, rows in content.items()}
    write_rows(path, slabs, comm, create=attributes or {})


@pytest.mark.parametrize("n", [0, 1, 2, 1001])
def test_slabs_of_all_ranks_become_one_array(comm, shared_tmp, way, n):
    content = {"states/000000/x": whole(n), "states/000000/owner": np.arange(n, dtype=np.int32)}
    attributes = {
        "/": {"text": "é" * 3000},
        "states": {"time": 0.1, "step": 3, "none": ""},
        "states/000000/x": {"unit": "m"},
    }
    write(comm, shared_tmp / "a.h5", content, attributes)
    with h5py.File(shared_tmp / "a.h5", "r") as file:
        for name, rows in content.items():
            np.testing.assert_array_equal(file[name][()], rows)
            assert file[name].dtype == rows.dtype
        assert file.attrs["text"].decode() == "é" * 3000
        assert dict(file["states"].attrs) == {"time": 0.1, "step": 3, "none": b""}
        assert file["states/000000/x"].attrs["unit"] == b"m"
    comm.Barrier()
    assert [entry.name for entry in shared_tmp.iterdir()] == ["a.h5"]


def test_ranks_without_rows(comm, shared_tmp, way):
    path, x = shared_tmp / "a.h5", whole(100)
    mine = x if comm.rank == comm.size - 1 else x[:0]
    write_rows(path, {"x": mine}, comm, create={})
    np.testing.assert_array_equal(h5py.File(path, "r")["x"][()], x)


def test_reading_with_another_partition_of_rows(comm, shared_tmp, way):
    path, x = shared_tmp / "a.h5", whole(50)
    write(comm, path, {"x": x})
    mine = np.arange(comm.rank, 50, comm.size)[::-1]
    order = FileOrder(comm, mine, 50)
    np.testing.assert_array_equal(order.from_slab(read_slab(path, "x", order)), x[mine])
    with pytest.raises(InputError, match="cannot be read"):
        read_slab(path, "y", order)
    with pytest.raises(InputError, match="50 rows, 51 are expected"):
        read_slab(path, "x", FileOrder(comm, np.arange(comm.rank, 51, comm.size), 51))


def test_a_full_disk_leaves_the_old_file(comm, shared_tmp, way):
    """A limit on the size of files simulates a full disk."""
    path = shared_tmp / "a.h5"
    write(comm, path, {"x": whole(4)})
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    try:
        with pytest.raises(OutputError, match=r"a\.h5: cannot be written: File too large"):
            write(comm, path, {"x": whole(20_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [entry.name for entry in shared_tmp.iterdir()] == ["a.h5"]
    np.testing.assert_array_equal(h5py.File(path, "r")["x"][()], whole(4))
    comm.Barrier()
    write(comm, path, {"x": whole(20_000)})
    np.testing.assert_array_equal(h5py.File(path, "r")["x"][()], whole(20_000))


@pytest.mark.parametrize("place", ["creation", "rows"])
def test_a_failure_on_one_rank_is_one_on_all(comm, shared_tmp, way, monkeypatch, place):
    """Also where other ranks have more rows than are received."""
    path, x = shared_tmp / "a.h5", whole(500)
    write(comm, path, {"x": x, "y": x})

    def disk_full(*arguments):
        raise OSError(errno.ENOSPC, "as the library words it")

    if place == "creation":
        monkeypatch.setattr("os.posix_fallocate", disk_full)
    elif comm.rank in (0, comm.size - 1):
        monkeypatch.setattr(hdf5, "put_rows", disk_full)
    create = {} if place == "creation" else None
    with pytest.raises(OutputError, match=r"a\.h5: cannot be written: No space left on device"):
        write_rows(path, {"x": slab_of(comm, x), "y": slab_of(comm, x)}, comm, create)
    monkeypatch.undo()
    write_rows(path, {"x": slab_of(comm, -x)}, comm)
    np.testing.assert_array_equal(h5py.File(path, "r")["x"][()], -x)


def test_a_missing_folder_is_an_output_error_on_every_rank(comm, shared_tmp, way):
    with pytest.raises(OutputError, match=r"a\.h5: cannot be written: No such file or directory"):
        write(comm, shared_tmp / "missing" / "a.h5", {"x": whole(4)})
