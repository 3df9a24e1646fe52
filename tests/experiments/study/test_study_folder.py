"""Choice of a study's folder, decided without touching the disk."""

from __future__ import annotations

from pathlib import Path

import pytest
from mpi4py import MPI

from lyra_petsc.errors import InputError
from lyra_petsc.experiments.study.jobs import STUDY
from lyra_petsc.output.run_folder import FolderChoice, RunDirectory, choose_folder


def chosen(stem: str, out: Path | None, *, force: bool = False, resume: bool = False) -> FolderChoice:
    return choose_folder(MPI.COMM_SELF, stem, out, force=force, resume=resume, kind=STUDY)


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def begun(path: Path) -> Path:
    path.mkdir(parents=True)
    (path / "request.json").write_text("{}")
    return path


def test_the_newest_is_resumed(here: Path) -> None:
    import os

    for number, name in enumerate(("flag", "flag-2", "flag-b")):
        path = begun(here / "studies" / name) / "request.json"
        os.utime(path, (1000.0 + number, 1000.0 + number))
    assert chosen("flag", None, resume=True).path == Path("studies/flag-2")
    with pytest.raises(InputError, match="no study of drape"):
        chosen("drape", None, resume=True)


def test_force_removes_what_a_study_writes_and_nothing_else(here: Path) -> None:
    folder = begun(here / "mine")
    for name in ("study.csv", "report.html", "work-precision-energy.png", "convergence-dt-position-l2.svg"):
        (folder / name).write_text("")
    (folder / "cases" / "beuler-dt0.1").mkdir(parents=True)
    for name in ("notes.txt", "photo.png", "report.docx"):
        (folder / name).write_text("")
    with RunDirectory(MPI.COMM_SELF, chosen("mine", folder, force=True)) as directory:
        directory.clean()
    assert sorted(path.name for path in folder.iterdir()) == ["notes.txt", "photo.png", "report.docx"]
