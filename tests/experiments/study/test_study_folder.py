"""Which folder a study takes, and which it refuses; decided without touching the disk."""

from __future__ import annotations

from pathlib import Path

import pytest
from mpi4py import MPI

from lyra_petsc.errors import InputError
from lyra_petsc.experiments.study.folder import Lock, choose_folder, clear


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def begun(path: Path) -> Path:
    path.mkdir(parents=True)
    (path / "request.json").write_text("{}")
    return path


def test_a_free_name_is_found(here: Path) -> None:
    assert choose_folder("flag", None, force=False, resume=False).path == Path("studies/flag")
    begun(here / "studies" / "flag")
    choice = choose_folder("flag", None, force=False, resume=False)
    assert choice.path == Path("studies/flag-2")
    begun(here / "studies" / "flag-2")  # taken between the choice and the lock
    lock = Lock(MPI.COMM_SELF, choice)
    assert lock.path == Path("studies/flag-3")
    assert (lock.path / "cases").is_dir()
    lock.release()


def test_the_newest_is_resumed(here: Path) -> None:
    import os

    for number, name in enumerate(("flag", "flag-2", "flag-b")):
        path = begun(here / "studies" / name) / "request.json"
        os.utime(path, (1000.0 + number, 1000.0 + number))
    assert choose_folder("flag", None, force=False, resume=True).path == Path("studies/flag-2")
    with pytest.raises(InputError, match="no study of drape"):
        choose_folder("drape", None, force=False, resume=True)


@pytest.mark.parametrize(
    ("out", "flags", "words"),
    [
        ("", {}, "is empty"),
        ("file", {}, "is a file"),
        ("file/below", {}, "is a file"),
        ("there", {}, "exists; name another folder"),
        ("there", {"resume": True}, "holds no study"),
        ("nowhere", {"resume": True}, "holds no study"),
        ("there", {"resume": True, "force": True}, "give one of them"),
    ],
)
def test_folders_that_cannot_be(here: Path, out: str, flags: dict[str, bool], words: str) -> None:
    (here / "file").write_text("")
    (here / "there").mkdir()
    with pytest.raises(InputError, match=words):
        choose_folder("x", Path(out) if out else Path(" "), **({"force": False, "resume": False} | flags))


def test_force_removes_what_a_study_writes_and_nothing_else(here: Path) -> None:
    folder = begun(here / "mine")
    for name in ("study.csv", "report.html", "work-precision-energy.png", "convergence-dt-position-l2.svg"):
        (folder / name).write_text("")
    (folder / "cases" / "beuler-dt0.1").mkdir(parents=True)
    for name in ("notes.txt", "photo.png", "report.docx"):
        (folder / name).write_text("")
    clear(folder)
    assert sorted(path.name for path in folder.iterdir()) == ["notes.txt", "photo.png", "report.docx"]


def test_a_locked_folder_is_refused(here: Path) -> None:
    choice = choose_folder("x", Path("out"), force=False, resume=False)
    lock = Lock(MPI.COMM_SELF, choice)
    begun_again = choose_folder("x", Path("out"), force=True, resume=False)
    with pytest.raises(InputError, match="another study is at work"):
        Lock(MPI.COMM_SELF, begun_again)
    lock.release()
    Lock(MPI.COMM_SELF, begun_again).release()
