"""The folder of a run: its name, --force, --resume, and locks."""

import os
from pathlib import Path

import pytest

from lyra_petsc.errors import InputError
from lyra_petsc.output.layout import LOCK_FILE
from lyra_petsc.output.run_folder import FolderLock, FolderLocked, RunDirectory, choose_folder

pytestmark = pytest.mark.parallel(3)


@pytest.fixture
def here(comm, shared_tmp, monkeypatch):
    """Working directory of every rank, in which ``make`` creates files before any rank continues."""
    monkeypatch.chdir(shared_tmp)

    def make(*names, age=0):
        if comm.rank == 0:
            for name in map(Path, names):
                name.parent.mkdir(parents=True, exist_ok=True)
                name.write_text("x")
                os.utime(name, (1e9 - age, 1e9 - age))
        comm.Barrier()

    yield make
    comm.Barrier()


def create(comm, choice, *names):
    """Create the folder of a run, write files with these names, and close it."""
    with RunDirectory(comm, choice) as directory:
        directory.clean()
        if comm.rank == 0:
            for name in names:
                (directory.path / name).write_text("x")
    comm.Barrier()
    return directory.path


def test_default_folder_is_the_first_free_one_and_choosing_touches_nothing(comm, here):
    assert choose_folder(comm, "flag").path == Path("runs/flag")
    assert not Path("runs").exists()
    comm.Barrier()
    for expected in ("flag", "flag-2", "flag-3"):
        path = create(comm, choose_folder(comm, "flag"), "history.csv")
        assert path == Path("runs", expected)
        assert [entry.name for entry in path.iterdir()] == ["history.csv"]


def test_a_default_folder_taken_meanwhile_becomes_the_next(comm, here):
    choice = choose_folder(comm, "flag")
    here("runs/flag/other")
    assert create(comm, choice) == Path("runs/flag-2")


def test_a_second_folder_taken_meanwhile_becomes_the_third(comm, here):
    here("runs/flag/other")
    choice = choose_folder(comm, "flag")
    here("runs/flag-2/other")
    assert create(comm, choice) == Path("runs/flag-3")


def test_a_given_folder_that_exists_is_refused(comm, here):
    here("out/notes.txt")
    with pytest.raises(InputError, match=r"out: --out: exists.*--resume.*--force"):
        choose_folder(comm, "flag", "out")
    choice = choose_folder(comm, "flag", "new/out")
    here("new/out/notes.txt")
    with pytest.raises(InputError, match=r"new/out: --out: exists"):
        create(comm, choice)


def test_force_removes_our_results_and_nothing_else(comm, here):
    ours = ["states-0000.h5", "states-12345.h5.part", "mesh.h5", "checkpoint.h5", "checkpoint-previous.h5"]
    ours += ["history.csv", "probes.csv", "reactions.csv", "scene.yaml", "summary.json", "states.xdmf"]
    others = ["notes.txt", "states-1.h5", "flag.geo", "picture.png", "my-history.csv"]
    here(*(f"out/{name}" for name in ours + others))
    choice = choose_folder(comm, "flag", "out", force=True)
    assert len(list(Path("out").iterdir())) == len(ours + others)
    comm.Barrier()
    assert create(comm, choice) == Path("out")
    assert sorted(path.name for path in Path("out").iterdir()) == sorted(others)


def test_force_without_a_name_takes_the_default_folder(comm, here):
    here("runs/flag/history.csv")
    path = create(comm, choose_folder(comm, "flag", force=True))
    assert path == Path("runs/flag")
    assert not list(path.iterdir())


def test_resume_finds_the_newest_run_of_the_scene(comm, here):
    here("runs/flag/checkpoint.h5", age=50)
    here("runs/flag-2/checkpoint-previous.h5", "runs/flag-2/history.csv.part", "runs/flag-2/mesh.h5", age=20)
    here("runs/flag-3/history.csv", "runs/flags/checkpoint.h5", "runs/flag-new/checkpoint.h5")
    choice = choose_folder(comm, "flag", resume=True)
    assert (choice.path, choice.resume) == (Path("runs/flag-2"), True)
    comm.Barrier()
    create(comm, choice)
    assert sorted(path.name for path in choice.path.iterdir()) == ["checkpoint-previous.h5", "mesh.h5"]


def test_what_cannot_be_resumed(comm, here):
    here("empty/history.csv")
    with pytest.raises(InputError, match="--resume: no run of flag"):
        choose_folder(comm, "flag", resume=True)
    with pytest.raises(InputError, match="empty: --resume: holds no checkpoint"):
        choose_folder(comm, "flag", "empty", resume=True)
    with pytest.raises(InputError, match="missing: --resume: does not exist"):
        choose_folder(comm, "flag", "missing", resume=True)
    with pytest.raises(InputError, match="one of them"):
        choose_folder(comm, "flag", "empty", resume=True, force=True)


@pytest.mark.parametrize("force", [False, True])
def test_invalid_names_are_refused(comm, here, force):
    here("file")
    for name, words in {
        "file": "is a file",
        "file/below/it": "is a file",
        "": "is empty",
        "x" * 300: "too long",
        "/proc/nowhere": "cannot be",
    }.items():
        with pytest.raises(InputError, match=words) as caught:
            create(comm, choose_folder(comm, "flag", name, force=force))
        assert "\n" not in str(caught.value)


def test_a_folder_without_permission_is_refused(comm, here, monkeypatch):
    """Root may write everywhere, so the system's answer is simulated."""
    here("closed/file")
    closed = Path("closed").absolute()
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != closed)
    with pytest.raises(InputError, match=r"no permission to write in .*closed"):
        choose_folder(comm, "flag", "closed/out")
    assert choose_folder(comm, "flag", "open/out").path == Path("open/out")


def test_a_run_that_writes_nothing_leaves_nothing(comm, here):
    here("mine/notes.txt")
    with RunDirectory(comm, choose_folder(comm, "flag", "mine/deep/out")) as directory:
        assert directory.path.is_dir()
        comm.Barrier()  # one rank takes it away again
    comm.Barrier()
    assert os.listdir("mine") == ["notes.txt"]
    comm.Barrier()
    create(comm, choose_folder(comm, "flag", "mine", force=True))
    assert os.listdir("mine") == ["notes.txt"]


@pytest.mark.parametrize("options", [{}, {"force": True}, {"resume": True}], ids=str)
def test_a_second_run_into_a_folder_is_refused(comm, here, options):
    here("out/checkpoint.h5")
    with RunDirectory(comm, choose_folder(comm, "flag", "out", force=True)):
        with pytest.raises(InputError, match=r"another run is at work|exists; name another") as caught:
            RunDirectory(comm, choose_folder(comm, "flag", "out", **options))
        assert "\n" not in str(caught.value)
    comm.Barrier()
    assert os.listdir("out") == ["checkpoint.h5"]


def test_a_second_run_is_refused_while_the_first_sets_up(comm, here):
    with RunDirectory(comm, choose_folder(comm, "flag", "out")):
        for _ in range(2):
            with pytest.raises(
                InputError, match=rf"another run.*process {os.getpid() if comm.size == 1 else ''}"
            ):
                RunDirectory(comm, choose_folder(comm, "flag", "out"))
        comm.Barrier()
        assert create(comm, choose_folder(comm, "flag")) == Path("runs/flag")
    comm.Barrier()
    assert not os.listdir(".")


def test_two_runs_without_a_name_get_two_folders(comm, here):
    both = [choose_folder(comm, "flag"), choose_folder(comm, "flag")]
    with RunDirectory(comm, both[0]) as first, RunDirectory(comm, both[1]) as second:
        assert (first.path.name, second.path.name) == ("flag", "flag-2")


def test_leftovers_of_a_kill_during_the_set_up_are_ignored(comm, here):
    here(f"out/{LOCK_FILE}")
    path = create(comm, choose_folder(comm, "flag", "out"), "history.csv")
    assert os.listdir(path) == ["history.csv"]


def test_a_lock_file_without_a_process_does_not_lock(comm, here):
    here(f"out/{LOCK_FILE}", "out/checkpoint.h5")
    assert create(comm, choose_folder(comm, "flag", "out", resume=True)) == Path("out")
    assert os.listdir("out") == ["checkpoint.h5"]


def test_a_file_system_without_locks_is_noted(comm, here, monkeypatch):
    def refuse(descriptor, operation):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr("fcntl.flock", refuse)
    with RunDirectory(comm, choose_folder(comm, "flag", "out")) as directory:
        assert "no locks" in directory.note
    comm.Barrier()


def test_releasing_a_lock_leaves_a_newer_lock_file_alone(comm, tmp_path):
    first = FolderLock(tmp_path)
    with pytest.raises(FolderLocked, match=f"process {os.getpid()} on "):
        FolderLock(tmp_path)
    first.path.unlink()
    second = FolderLock(tmp_path)
    first.release()  # must leave the second's file alone
    assert os.listdir(tmp_path) == [LOCK_FILE]
    second.release()
    assert os.listdir(tmp_path) == []
