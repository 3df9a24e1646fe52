import os
from pathlib import Path

import pytest

from lyra_petsc.errors import InputError
from lyra_petsc.output.folder import choose, create

pytestmark = pytest.mark.parallel


@pytest.fixture
def here(comm, shared_tmp, monkeypatch):
    """Working directory of every rank; ``make`` puts files there before any rank goes on."""
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


def test_default_folder_is_the_first_free_one_and_choosing_touches_nothing(comm, here):
    assert choose(comm, "flag").path == Path("runs/flag")
    assert not Path("runs").exists()
    comm.Barrier()
    for expected in ("flag", "flag-2", "flag-3"):
        path = create(comm, choose(comm, "flag"))
        assert path == Path("runs", expected)
        assert path.is_dir()


def test_a_default_folder_taken_meanwhile_becomes_the_next(comm, here):
    choice = choose(comm, "flag")
    here("runs/flag/other")
    assert create(comm, choice) == Path("runs/flag-2")


def test_a_second_folder_taken_meanwhile_becomes_the_third(comm, here):
    here("runs/flag/other")
    choice = choose(comm, "flag")
    here("runs/flag-2/other")
    assert create(comm, choice) == Path("runs/flag-3")


def test_a_given_folder_that_exists_is_refused(comm, here):
    here("out/notes.txt")
    with pytest.raises(InputError, match=r"out: --out: exists.*--resume.*--force"):
        choose(comm, "flag", "out")
    choice = choose(comm, "flag", "new/out")
    here("new/out/notes.txt")
    with pytest.raises(InputError, match="cannot be created"):
        create(comm, choice)


def test_force_removes_our_results_and_nothing_else(comm, here):
    ours = ["states-0000.h5", "states-12345.h5.part", "mesh.h5", "checkpoint.h5", "checkpoint-previous.h5"]
    ours += ["history.csv", "probes.csv", "reactions.csv", "scene.yaml", "summary.json", "states.xdmf"]
    others = ["notes.txt", "states-1.h5", "flag.geo", "picture.png", "my-history.csv"]
    here(*(f"out/{name}" for name in ours + others))
    choice = choose(comm, "flag", "out", force=True)
    assert len(list(Path("out").iterdir())) == len(ours + others)
    comm.Barrier()
    assert create(comm, choice) == Path("out")
    assert sorted(path.name for path in Path("out").iterdir()) == sorted(others)


def test_force_without_a_name_takes_the_default_folder(comm, here):
    here("runs/flag/history.csv")
    path = create(comm, choose(comm, "flag", force=True))
    assert path == Path("runs/flag")
    assert not list(path.iterdir())


def test_resume_finds_the_newest_run_of_the_scene(comm, here):
    here("runs/flag/checkpoint.h5", age=50)
    here("runs/flag-2/checkpoint-previous.h5", "runs/flag-2/history.csv.part", "runs/flag-2/mesh.h5", age=20)
    here("runs/flag-3/history.csv", "runs/flags/checkpoint.h5", "runs/flag-new/checkpoint.h5")
    choice = choose(comm, "flag", resume=True)
    assert (choice.path, choice.resume) == (Path("runs/flag-2"), True)
    comm.Barrier()
    create(comm, choice)
    assert sorted(path.name for path in choice.path.iterdir()) == ["checkpoint-previous.h5", "mesh.h5"]


def test_what_cannot_be_resumed(comm, here):
    here("empty/history.csv")
    with pytest.raises(InputError, match="--resume: no run of flag"):
        choose(comm, "flag", resume=True)
    with pytest.raises(InputError, match="empty: --resume: holds no checkpoint"):
        choose(comm, "flag", "empty", resume=True)
    with pytest.raises(InputError, match="missing: --resume: does not exist"):
        choose(comm, "flag", "missing", resume=True)
    with pytest.raises(InputError, match="one of them"):
        choose(comm, "flag", "empty", resume=True, force=True)


@pytest.mark.parametrize("force", [False, True])
def test_names_that_cannot_be_folders(comm, here, force):
    here("file")
    for name, words in {
        "file": "is a file",
        "file/below/it": "is a file",
        "": "is empty",
        "x" * 300: "too long",
        "/proc/nowhere": "cannot be",
    }.items():
        with pytest.raises(InputError, match=words) as caught:
            create(comm, choose(comm, "flag", name, force=force))
        assert "\n" not in str(caught.value)


def test_no_permission(comm, here, monkeypatch):
    """Root may write everywhere, so the answer of the system is given here."""
    here("closed/file")
    closed = Path("closed").absolute()
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != closed)
    with pytest.raises(InputError, match=r"no permission to write in .*closed"):
        choose(comm, "flag", "closed/out")
    assert choose(comm, "flag", "open/out").path == Path("open/out")
