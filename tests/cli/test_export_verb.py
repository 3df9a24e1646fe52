"""The command ``export`` on one rank and on two."""

from __future__ import annotations

import signal
from pathlib import Path

import h5py
import numpy as np
import pytest
from launch import done, finish, refused, start, wait_until
from written_run import position, written


@pytest.mark.parametrize("ranks", [1, 2])
def test_states_are_exported_and_files_named(tmp_path: Path, ranks: int) -> None:
    written(tmp_path / "run", states=3)
    left = done(["export", "run", "--to", "npz", "--every", "2"], tmp_path, ranks)
    assert "2 states in run/npz: run.npz" in left.out
    found = np.load(tmp_path / "run" / "npz" / "run.npz")["position"]
    np.testing.assert_array_equal(found, [position(0), position(2)])


SLOW = """
import sys, time
from dataclasses import replace
from lyra_petsc.show.export import FORMATS
from lyra_petsc.cli.app import run_command_line

form = FORMATS["obj"]

def slowly(states, folder, name):
    form.write(states, folder, name)
    time.sleep(60)

FORMATS["obj"] = replace(form, write=slowly)
sys.exit(run_command_line(sys.argv))
"""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_leaves_no_files(tmp_path: Path, number: signal.Signals, code: int) -> None:
    written(tmp_path / "run")
    process = start(["export", "run", "--to", "obj", "--out", "out"], tmp_path, program=("-c", SLOW))
    wait_until((tmp_path / "out.part" / "run_0002.obj").exists)
    process.send_signal(number)
    left = finish(process)
    assert left.code == code
    assert f"stopped by {number.name}; nothing was written" in left.err
    assert [entry.name for entry in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("ranks", [1, 2])
def test_data_of_other_files_are_refused_in_one_line(tmp_path: Path, ranks: int) -> None:
    written(tmp_path / "run", states=2)
    (tmp_path / "secret").write_bytes(bytes(192))
    with h5py.File(tmp_path / "run" / "states-0000.h5", "r+") as file:
        del file["states/000001/position"]
        storage = [(str(tmp_path / "secret"), 0, 192)]
        file.create_dataset("states/000001/position", (8, 3), "f8", external=storage)
    refused(
        ["export", "run", "--to", "npz"],
        tmp_path,
        "states-0000.h5: '/states/000001/position' takes its data from other files",
        ranks=ranks,
    )
    assert not (tmp_path / "run" / "npz").exists()
