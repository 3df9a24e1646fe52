"""Collective writing of HDF5 files by every method, reading of slabs, and failures."""

import errno
import resource

import numpy as np
import pytest
from mpi4py import MPI

from lyra_petsc.errors import InputError, OutputError
from lyra_petsc.output import hdf5
from lyra_petsc.output.hdf5 import NewFile, read_slab, write_collective
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.stored import import_h5py

pytestmark = pytest.mark.parallel(3)

h5py = import_h5py()


METHODS = {"one machine": "_write_serial", "MPI-IO": "_write_with_mpi_io", "in turn": "_write_serial"}


@pytest.fixture(params=METHODS)
def method(request, monkeypatch):
    """A method of writing slabs, with the name of its function."""
    monkeypatch.setattr(hdf5, "on_one_machine", lambda comm: request.param == "one machine")
    monkeypatch.setenv(hdf5.TURNS_VARIABLE, "1" if request.param == "in turn" else "0")
    return METHODS[request.param]


def whole(n):
    return np.random.default_rng(1).normal(size=(n, 3))


def slab_of(comm, array):
    n = len(array)
    return array[comm.rank * n // comm.size : (comm.rank + 1) * n // comm.size]


def everything(path):
    with h5py.File(path, "r") as file:
        found = {}
        file.visititems(lambda name, item: found.update({name: item[()]} if hasattr(item, "shape") else {}))
        return found


def test_the_method_under_test_is_used(comm, shared_tmp, method, monkeypatch):
    taken = set()
    for name in METHODS.values():
        work = getattr(hdf5, name)

        def noted(*given, work=work, name=name, **keywords):
            taken.add(name)
            return work(*given, **keywords)

        monkeypatch.setattr(hdf5, name, noted)
    write_collective([NewFile(shared_tmp / "a.h5", {"x": slab_of(comm, whole(10))}, {})], comm)
    assert taken == {method}


def test_ranks_take_turns_where_mpi_io_opens_nothing(comm, shared_tmp, monkeypatch):
    class Closed:
        @staticmethod
        def Open(*arguments):
            raise MPI.Exception(MPI.ERR_FILE)

    x = whole(10)
    monkeypatch.setattr(hdf5, "on_one_machine", lambda comm: False)
    monkeypatch.setattr(hdf5.MPI, "File", Closed)
    write_collective([NewFile(shared_tmp / "a.h5", {"x": slab_of(comm, x)}, {})], comm)
    np.testing.assert_array_equal(everything(shared_tmp / "a.h5")["x"], x)


@pytest.mark.parametrize("n", [1, 2, 1001])
def test_slabs_of_all_ranks_become_one_array(comm, shared_tmp, method, n):
    x, owner = whole(n), np.arange(n, dtype=np.int32)
    attributes = {"states/000000": {"time": 0.1, "step": 3}, "states/000000/x": {"unit": "m"}}
    path = shared_tmp / "a.h5"
    datasets = {"states/000000/x": slab_of(comm, x), "states/000000/owner": slab_of(comm, owner)}
    write_collective([NewFile(path, datasets, attributes)], comm)
    found = everything(path)
    np.testing.assert_array_equal(found["states/000000/x"], x)
    np.testing.assert_array_equal(found["states/000000/owner"], owner)
    assert found["states/000000/owner"].dtype == np.int32
    with h5py.File(path, "r") as file:
        assert dict(file["states/000000"].attrs) == {"time": 0.1, "step": 3}
        assert file["states/000000/x"].attrs["unit"] == b"m"
    comm.Barrier()
    assert [entry.name for entry in shared_tmp.iterdir()] == ["a.h5"]


def test_ranks_without_rows(comm, shared_tmp, method):
    x = whole(10)
    mine = x if comm.rank == comm.size - 1 else x[:0]
    write_collective([NewFile(shared_tmp / "a.h5", {"x": mine}, {})], comm)
    np.testing.assert_array_equal(everything(shared_tmp / "a.h5")["x"], x)


def test_reading_with_another_partition_of_rows(comm, shared_tmp, method):
    x = whole(50)
    write_collective([NewFile(shared_tmp / "a.h5", {"x": x if comm.rank == 0 else x[:0]}, {})], comm)
    mine = np.arange(comm.rank, 50, comm.size)[::-1]
    order = FileOrder(comm, mine, 50)
    np.testing.assert_array_equal(order.from_slab(read_slab(shared_tmp / "a.h5", "x", order)), x[mine])
    with pytest.raises(InputError, match="cannot be read"):
        read_slab(shared_tmp / "a.h5", "y", order)
    with pytest.raises(InputError, match="50 rows, 51 are expected"):
        read_slab(shared_tmp / "a.h5", "x", FileOrder(comm, np.arange(comm.rank, 51, comm.size), 51))


def still_there(comm, path, x):
    comm.Barrier()
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    np.testing.assert_array_equal(everything(path)["x"], x)
    comm.Barrier()


def test_a_full_disk_leaves_the_old_file(comm, shared_tmp, method):
    """A limit on the size of files simulates a full disk."""
    path = shared_tmp / "a.h5"
    write_collective([NewFile(path, {"x": slab_of(comm, whole(4))}, {})], comm)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    try:
        with pytest.raises(OutputError, match=r"a\.h5: cannot be written: File too large"):
            write_collective([NewFile(path, {"x": slab_of(comm, whole(20_000))}, {})], comm)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    still_there(comm, path, whole(4))
    write_collective([NewFile(path, {"x": slab_of(comm, whole(20_000))}, {})], comm)
    still_there(comm, path, whole(20_000))


def test_a_failed_write_on_one_rank_leaves_the_old_file(comm, shared_tmp, method, monkeypatch):
    path = shared_tmp / "a.h5"
    write_collective([NewFile(path, {"x": slab_of(comm, whole(4))}, {})], comm)
    name = "_write_rows_collective" if method == "_write_with_mpi_io" else "_write_rows"
    right = getattr(hdf5, name)

    def write_and_fail(*arguments):
        right(*arguments)
        if comm.rank == comm.size - 1:
            raise OSError(errno.ENOSPC, "as the library words it")

    monkeypatch.setattr(hdf5, name, write_and_fail)
    with pytest.raises(OutputError, match=r"a\.h5: cannot be written: No space left on device"):
        write_collective(
            [NewFile(path, {"x": slab_of(comm, whole(100)), "y": slab_of(comm, whole(7))}, {})], comm
        )
    still_there(comm, path, whole(4))


def test_a_missing_folder_is_an_output_error_on_every_rank(comm, shared_tmp, method):
    with pytest.raises(OutputError, match="cannot be written"):
        write_collective([NewFile(shared_tmp / "missing" / "a.h5", {"x": slab_of(comm, whole(4))}, {})], comm)
