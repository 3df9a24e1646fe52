"""Files of a run that refer to data outside its folder are refused by all readers."""

from __future__ import annotations

import os
import shutil
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
import pytest
from mpi4py import MPI
from written_run import written

from lyra_petsc.errors import InputError
from lyra_petsc.experiments.study.comparison import read_samples
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.output.run_folder import choose_folder
from lyra_petsc.output.stored import open_stored
from lyra_petsc.show.render.sheet_geometry import HeldVertices

POSITION = "states/000001/position"


def _external_storage(folder: Path, secret: Path) -> None:
    with h5py.File(folder / "states-0000.h5", "r+") as file:
        del file[POSITION]
        file.create_dataset(POSITION, (8, 3), "f8", external=[(str(secret), 0, 192)])


def _external_link(folder: Path, secret: Path) -> None:
    with h5py.File(folder / "states-0000.h5", "r+") as file:
        del file[POSITION]
        file[POSITION] = h5py.ExternalLink(str(secret), "/secret")


def _external_link_above(folder: Path, secret: Path) -> None:
    with h5py.File(folder / "states-0000.h5", "r+") as file:
        del file["states"]
        file["states"] = h5py.ExternalLink(str(secret), "/states")


def _soft_link_over_an_external_one(folder: Path, secret: Path) -> None:
    with h5py.File(folder / "states-0000.h5", "r+") as file:
        del file[POSITION]
        file["aside"] = h5py.ExternalLink(str(secret), "/")
        file[POSITION] = h5py.SoftLink("/aside/secret")


def _virtual(folder: Path, secret: Path) -> None:
    layout = h5py.VirtualLayout((8, 3), "f8")
    layout[:] = h5py.VirtualSource(str(secret), "secret", (8, 3))
    with h5py.File(folder / "states-0000.h5", "r+") as file:
        del file[POSITION]
        file.create_virtual_dataset(POSITION, layout)


def _symbolic_link(folder: Path, secret: Path) -> None:
    shutil.move(folder / "states-0000.h5", secret.parent / "other.h5")
    os.symlink(secret.parent / "other.h5", folder / "states-0000.h5")


ATTACKS = {
    "external storage": _external_storage,
    "external link": _external_link,
    "external link above": _external_link_above,
    "soft link": _soft_link_over_an_external_one,
    "virtual dataset": _virtual,
    "symbolic link": _symbolic_link,
}


def attacked(folder: Path, attack: str) -> Path:
    """A run's folder with a reference to a file outside."""
    run = written(folder / "run")
    with h5py.File(folder / "secret.h5", "w") as file:
        file["secret"] = np.ones((8, 3))
        file["states/000001/position"] = np.ones((8, 3))
    ATTACKS[attack](run, folder / "secret.h5")
    return run


@pytest.mark.parametrize("attack", ATTACKS)
def test_references_to_states_elsewhere_are_refused(tmp_path: Path, attack: str) -> None:
    folder = attacked(tmp_path, attack)
    with pytest.raises(InputError) as caught:
        _ = StoredRun(folder).positions[1]
    assert "a run's folder must hold all of its results" in str(caught.value)
    assert str(folder / "states") in str(caught.value)


@pytest.mark.parametrize("attack", ["external storage", "external link", "virtual dataset", "symbolic link"])
def test_studies_and_resumed_runs_refuse_them_too(tmp_path: Path, attack: str) -> None:
    folder = attacked(tmp_path, attack)
    with pytest.raises(InputError, match="all of its results"):
        open_stored(folder / "states-0000.h5").__enter__()
    with pytest.raises(InputError, match="all of its results"):
        read_samples(folder, (0.0, 0.1), 0.1)


@pytest.mark.parametrize(
    "name", ["mesh.h5", "history.csv", "scene.yaml", "summary.json", "states.xdmf", "failure.txt"]
)
def test_links_out_of_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    folder = written(tmp_path / "run")
    (tmp_path / "secret").write_text("secret")
    (folder / name).unlink(missing_ok=True)
    os.symlink("../secret", folder / name)
    with pytest.raises(InputError, match=f"{name}: is a link out of the folder"):
        StoredRun(folder)


def test_the_folder_itself_may_be_a_link_and_hold_links(tmp_path: Path) -> None:
    folder = written(tmp_path / "run")
    os.rename(folder / "history.csv", folder / "steps.csv")
    os.symlink("steps.csv", folder / "history.csv")
    os.symlink("run", tmp_path / "link")
    run = StoredRun(tmp_path / "link")
    assert len(run.positions[1]) == 8
    assert len(run.history) == 3 or len(run.history["time"]) == 3


def test_no_reader_waits_for_a_pipe(tmp_path: Path) -> None:
    folder = written(tmp_path / "run")
    (folder / "history.csv").unlink()
    os.mkfifo(folder / "history.csv")
    with pytest.raises(InputError, match="is no plain file"):
        StoredRun(folder)


def test_links_in_the_mesh_are_refused_by_all_that_read_it(tmp_path: Path) -> None:
    folder = written(tmp_path / "run")
    with h5py.File(folder / "mesh.h5", "r+") as file:
        del file["start"]
        file["start"] = h5py.ExternalLink("other.h5", "/start")
    run = StoredRun(folder)
    for read in (
        lambda: run.triangles,
        lambda: run.uv,
        lambda: HeldVertices(run),
        lambda: read_samples(folder, (0.0,), 0.1),
    ):
        with pytest.raises(InputError, match="'/start' is a link to elsewhere"):
            read()


def test_groups_that_contain_themselves_are_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["a/b"] = 1.0
        file["a/c"] = file["a"]
    with pytest.raises(InputError, match="a group in several places"), open_stored(tmp_path / "x.h5"):
        pass


def test_groups_with_exponentially_many_paths_are_refused_at_once(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "x.h5", "w") as file:
        groups = [file.create_group(f"g{number}") for number in range(7)]
        for above, below in pairwise(groups):
            for number in range(60):  # 60⁶ paths
                above[f"{number}"] = below
    with pytest.raises(InputError, match="a group in several places"), open_stored(tmp_path / "x.h5"):
        pass


def test_a_changed_file_is_checked_again(tmp_path: Path) -> None:
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as file:
        file["a"] = np.zeros(3)
    with open_stored(path) as file:
        assert list(file) == ["a"]
    with h5py.File(path, "r+") as file:
        file["b"] = h5py.ExternalLink("other.h5", "/b")
    with pytest.raises(InputError, match="'/b' is a link to elsewhere"), open_stored(path):
        pass


@pytest.mark.parallel(2)
def test_a_resumed_run_follows_no_link(shared_tmp: Path, comm: MPI.Comm) -> None:
    if comm.rank == 0:
        for name, linked in (("one", "vertices/position"), ("two", None)):
            folder = shared_tmp / name
            folder.mkdir()
            with h5py.File(folder / "checkpoint.h5", "w") as file:
                file["vertices/velocity"] = np.zeros((4, 3))
                if linked:
                    file[linked] = h5py.ExternalLink("other.h5", "/x")
            if not linked:
                os.symlink("/etc/passwd", folder / "history.csv")
    comm.Barrier()
    with pytest.raises(InputError, match="'/vertices/position' is a link to elsewhere"):
        choose_folder(comm, "scene", shared_tmp / "one", resume=True)
    with pytest.raises(InputError, match=r"history\.csv: is a link out of the folder"):
        choose_folder(comm, "scene", shared_tmp / "two", resume=True)
    from lyra_petsc.output.hdf5 import read_slab

    order = FileOrder(comm, np.arange(4) if comm.rank == 0 else np.arange(0), 4)
    with pytest.raises(InputError, match="is a link to elsewhere"):
        read_slab(shared_tmp / "one" / "checkpoint.h5", "vertices/velocity", order)
