"""history.csv: columns, rows, resumption, failures."""

import math
from functools import partial

import pytest

from lyra_petsc.errors import InputError, OutputError
from lyra_petsc.output.history import HISTORY_COLUMNS, History, vector_columns

pytestmark = pytest.mark.parallel(3)


def written(comm, path):
    """Text of the file, read when every rank has come here and before any continues."""
    comm.Barrier()
    text = path.read_text()
    comm.Barrier()
    return text


def test_header_is_the_documented_one(comm, shared_tmp):
    History(shared_tmp / "history.csv", HISTORY_COLUMNS, comm).close()
    assert written(comm, shared_tmp / "history.csv") == (
        "step,time,dt,newton_iterations,linear_iterations,rejected,kinetic_energy,membrane_energy,"
        "bending_energy,potential_energy,external_work,dissipation,residual,wall_seconds\n"
    )


def test_rows_are_on_disk_at_once_and_exact(comm, shared_tmp):
    path = shared_tmp / "probes.csv"
    history = History(path, vector_columns(["tip"]), comm)
    if comm.rank == 0:
        history.append({"step": 1, "time": 0.1 + 0.2, "tip_x": 1e-300, "tip_y": -2, "tip_z": math.pi})
    assert (
        written(comm, path)
        == "step,time,tip_x,tip_y,tip_z\n1,0.30000000000000004,1e-300,-2,3.141592653589793\n"
    )


def test_resume_removes_rows_after_the_checkpoint_and_incomplete_ones(comm, shared_tmp):
    path = shared_tmp / "history.csv"
    if comm.rank == 0:
        path.write_text("step,time\n0,0.0\n1,0.1\n2,0.2\n3,0.3\n4,0.")
    comm.Barrier()
    history = History(path, ("step", "time"), comm, resume_after=2)
    if comm.rank == 0:
        history.append({"step": 3, "time": 0.35})
    history.close()
    assert written(comm, path) == "step,time\n0,0.0\n1,0.1\n2,0.2\n3,0.35\n"
    History(path, ("step", "time"), comm, resume_after=99).close()
    assert written(comm, path) == "step,time\n0,0.0\n1,0.1\n2,0.2\n3,0.35\n"


def test_resume_removes_an_incomplete_last_row_of_an_early_step(comm, shared_tmp):
    path = shared_tmp / "history.csv"
    if comm.rank == 0:
        path.write_bytes(b"step,time\n0,0.0\n1,0.1\n2,\xff")
    comm.Barrier()
    History(path, ("step", "time"), comm, resume_after=9).close()
    assert written(comm, path) == "step,time\n0,0.0\n1,0.1\n"


def test_resume_with_other_columns_is_refused_without_changes(comm, shared_tmp):
    path = shared_tmp / "probes.csv"
    if comm.rank == 0:
        path.write_text("step,time,tip_x\n0,0.0,1.0\n")
    comm.Barrier()
    with pytest.raises(InputError, match="tip_x"):
        History(path, ("step", "time"), comm, resume_after=0)
    assert written(comm, path) == "step,time,tip_x\n0,0.0,1.0\n"
    assert [entry.name for entry in shared_tmp.iterdir()] == ["probes.csv"]


def test_resume_without_a_file_starts_a_new_one(comm, shared_tmp):
    History(shared_tmp / "history.csv", ("step", "time"), comm, resume_after=5).close()
    assert written(comm, shared_tmp / "history.csv") == "step,time\n"


def test_write_failures_are_output_errors_on_every_rank(comm, shared_tmp):
    with pytest.raises(OutputError, match=r"missing.history\.csv"):
        History(shared_tmp / "missing" / "history.csv", ("step", "time"), comm)


def test_a_full_disk_is_an_output_error_on_every_rank(comm, shared_tmp, monkeypatch):
    full = partial(open, "/dev/full", "wb")
    monkeypatch.setattr("lyra_petsc.output.history.open_output", lambda *_: full())
    with pytest.raises(OutputError, match="No space left"):
        History(shared_tmp / "history.csv", ("step", "time"), comm)
