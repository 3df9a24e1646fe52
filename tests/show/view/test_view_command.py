"""The command ``view``: start and end."""

import signal

import pytest
from launch import finish, lyra, refused
from written_run import Writer, written


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nowhere"], "nowhere: no such folder"),
        (["."], ".: is not the folder of a run"),
        (["file"], "file: is a file"),
        (["run", "--host", "192.0.2.1"], "--host: '192.0.2.1' is no address of this machine"),
        (["run", "--host", ""], "--host: '' is no address of this machine"),
        (["run", "--port", "70000"], "--port"),
        (["run", "--port", "x"], "--port"),
        (["run", "--prot", "1"], "--prot: no such option"),
        (["empty"], "empty: no state is written yet"),
        (["cut"], "cannot be read"),
        ([], "Missing argument 'RUN'"),
    ],
)
def test_bad_input_is_one_line(tmp_path, arguments, says):
    pytest.importorskip("trame")
    written(tmp_path / "run")
    (tmp_path / "file").touch()
    Writer(tmp_path / "empty")
    (tmp_path / "empty" / "run.lock").touch()
    (written(tmp_path / "cut") / "states-0000.h5").write_bytes(b"HDF")

    refused(["view", *arguments], tmp_path, says)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_a_signal_ends_it_without_a_traceback(serve, tmp_path, number, code):
    page = serve(written(tmp_path / "run"))
    page.process.send_signal(number)
    left = finish(page.process)

    assert left.code == code
    assert "Traceback" not in left.err
    assert left.ours == ([] if code == 0 else ["lyra-petsc: ended by SIGTERM"])


def test_under_mpirun_one_rank_serves_and_all_end_alike(serve, tmp_path):
    folder = written(tmp_path / "run")
    page = serve(folder, ranks=2)
    assert page.get("/?token=" + page.token)[0] == 302
    assert page.get("/")[0] == 403
    page.process.send_signal(signal.SIGINT)
    finish(page.process)

    left = lyra(["view", "nowhere"], tmp_path, ranks=2)
    assert left.code == 2
    assert len(left.ours) == 1


@pytest.mark.parametrize("option", [["--host", "127.0.0.1"], ["--port", "0"], ["--no-browser"]])
def test_options_of_the_page_without_live_are_refused(tmp_path, option):
    refused(["run", *option], tmp_path, f"{option[0]}: says where the page of --live is")
    assert not (tmp_path / "runs").exists()


def test_a_missing_extra_is_one_line_with_its_remedy(tmp_path):
    written(tmp_path / "run")
    left = lyra(["view", "run"], tmp_path, extra={"TESTS_WITHOUT": "trame_pyvista"})
    assert left.code == 2
    (line,) = left.ours
    assert "trame_pyvista is not installed; get the extra: pip install 'lyra-petsc[view]'" in line
