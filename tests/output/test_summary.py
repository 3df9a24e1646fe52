"""summary.json."""

import json
import sys

import numpy as np
import pytest

from lyra_petsc.errors import OutputError
from lyra_petsc.output.summary import library_versions, write_summary

pytestmark = pytest.mark.parallel(3)


def test_numpy_values_and_paths_become_plain_json(comm, shared_tmp):
    path = shared_tmp / "summary.json"
    write_summary(path, {"outcome": "running"}, comm)
    content = {
        "outcome": "done",
        "vertices": np.int64(4),
        "seconds": {"solve": np.float64(0.5), "other": float("nan"), "left": -np.inf},
        "sizes": np.arange(3),
        "terms": ("membrane", "wind"),
        "folder": path.parent,
        "resumed": False,
    }
    write_summary(path, content, comm)
    comm.Barrier()
    assert json.loads(path.read_text()) == {
        "outcome": "done",
        "vertices": 4,
        "seconds": {"solve": 0.5, "other": None, "left": None},
        "sizes": [0, 1, 2],
        "terms": ["membrane", "wind"],
        "folder": str(path.parent),
        "resumed": False,
    }
    assert [entry.name for entry in shared_tmp.iterdir()] == ["summary.json"]


def test_a_summary_that_cannot_be_written_is_an_output_error_on_every_rank(comm, shared_tmp):
    with pytest.raises(OutputError, match="No such file"):
        write_summary(shared_tmp / "missing" / "summary.json", {}, comm)


def test_versions_of_all_libraries_are_listed(monkeypatch):
    from petsc4py import PETSc

    monkeypatch.delitem(sys.modules, "numba", raising=False)
    found = library_versions()
    assert found["petsc"] == "{}.{}.{}".format(*PETSc.Sys.getVersion())
    assert found["numpy"] == np.__version__
    assert found["python"] == sys.version.split()[0]
    assert found["h5py"].endswith(("(MPI)", "(serial)"))
    assert {"lyra_petsc", "petsc4py", "mpi4py", "mpi", "hdf5"} <= found.keys()
    assert "numba" not in found
