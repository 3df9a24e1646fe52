"""The command ``info``: its output here, and for installations whose parts do not fit together."""

import builtins
import sys

import numpy as np
import pytest

from lyra_petsc import startup
from lyra_petsc.cli import info as module
from lyra_petsc.cli.info import info, rank_problems
from lyra_petsc.errors import InputError


def test_info_lists_the_versions_in_use(comm):
    import numba
    from petsc4py import PETSc

    lines = dict(line.split(None, 1) for line in info(comm).splitlines() if "  " in line)
    assert lines["PETSc"].strip()
    text = info(comm)
    assert ".".join(map(str, PETSc.Sys.getVersion())) in text
    assert "float64 scalars" in text
    assert lines["numpy"].strip() == np.__version__
    assert lines["numba"].strip() == numba.__version__
    assert "gmsh's sandbox  " in text


@pytest.mark.parallel(2)
def test_all_ranks_return_the_same_text_and_count_the_ranks(comm):
    text = info(comm)
    assert comm.allgather(text) == [text] * comm.size
    (ranks,) = [line for line in text.splitlines() if line.startswith("ranks ")]
    assert sum(int(part.split()[0]) for part in ranks.split(None, 1)[1].split(", ")) == comm.size
    assert "each of them sees" not in text


def test_a_missing_part_is_named_with_its_remedy(comm, monkeypatch):
    genuine = builtins.__import__

    def without_h5py(name, *arguments, **keywords):
        if name.split(".")[0] == "h5py":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return genuine(name, *arguments, **keywords)

    monkeypatch.setattr(builtins, "__import__", without_h5py)
    text = info(comm)
    assert "h5py is missing: install it from" in text


def test_a_broken_part_is_one_line(comm, monkeypatch):
    def describe(problems):
        raise ImportError("libhdf5.so.103: cannot open\nshared object file")

    monkeypatch.setitem(module.PARTS, "h5py", describe)
    assert "- h5py is there but fails: libhdf5.so.103: cannot open shared object file." in info(comm)


def test_an_unsuitable_petsc_is_named(comm, monkeypatch):
    from petsc4py import PETSc

    monkeypatch.setattr(module, "OLDEST_PETSC", (99, 0))
    monkeypatch.setattr(PETSc, "ScalarType", np.complex128)
    monkeypatch.setattr(module, "loaded_mpi_libraries", lambda: ["/a/libmpi.so.12", "/b/libmpi.so.40"])
    text = info(comm)
    assert "- Two MPI libraries are loaded at once (/a/libmpi.so.12, /b/libmpi.so.40)" in text
    assert "is too old: 99.0 or newer is needed" in text
    assert "- PETSc was built with complex scalars" in text


@pytest.mark.parametrize(
    ("environment", "words"),
    [
        ({"OMPI_COMM_WORLD_SIZE": "4"}, ["started 4 ranks but each of them sees 2"]),
        ({"OMP_NUM_THREADS": "4"}, ["OMP_NUM_THREADS=4 on 2 ranks asks for more than the 4 cores"]),
        ({"OMPI_COMM_WORLD_SIZE": "2", "OMP_NUM_THREADS": "2"}, []),
        ({}, []),
        ({"PMI_SIZE": "3"}, ["started 3 ranks"]),
        ({"SLURM_STEP_NUM_TASKS": "8", "SLURM_PROCID": "0"}, ["started 8 ranks"]),
        ({"SLURM_NTASKS": "8"}, []),
        ({"OMPI_COMM_WORLD_SIZE": "many"}, []),
    ],
)
def test_ranks_that_do_not_fit_are_one_line(environment, words):
    problems = rank_problems(environment, 2, 2, 4)
    assert len(problems) == len(words)
    assert all(one in line for one, line in zip(words, problems, strict=True))


def test_the_folder_of_the_distributions_petsc4py_is_named(tmp_path, monkeypatch):
    """Debian's petsc4py lies beside its PETSc, where the Python of an environment does not look."""
    folder = tmp_path / "petsc3.18" / "x86-real" / "lib" / "python3" / "dist-packages"
    (folder / "petsc4py").mkdir(parents=True)
    monkeypatch.setattr(
        startup, "DISTRIBUTION", str(tmp_path / "*/*-real/lib/python3/dist-packages/petsc4py")
    )
    for name in [name for name in sys.modules if name.startswith("petsc4py")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "petsc4py", None)
    with pytest.raises(
        InputError, match=f"the distribution's is in {folder}: add this folder to PYTHONPATH$"
    ):
        startup.start_petsc()
    monkeypatch.syspath_prepend(folder)  # and broken all the same
    with pytest.raises(InputError, match=r"conda, clusters and PyPI$"):
        startup.start_petsc()
