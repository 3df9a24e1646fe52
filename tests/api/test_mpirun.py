"""Environment that a launcher inherits from the process that starts it."""

from __future__ import annotations

import sys

import pytest
from patience import run_program

from lyra_petsc.api.mpirun import environment, find_launcher

LEFT_BY_MPI_INIT = {
    "OMPI_MCA_ess": "singleton",
    "OMPI_MCA_orte_launch": "1",
    "OMPI_MCA_orte_ess_num_procs": "1",
    "OMPI_MCA_pmix": "^s1,s2,cray,isolated",
    "ORTE_SCHIZO_DETECTION": "ORTE",
    "PMIX_RANK": "0",
}
"""Variables that Open MPI 4 sets in a process without a launcher."""


def test_a_launcher_can_be_started_after_mpi_init(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in LEFT_BY_MPI_INIT.items():
        monkeypatch.setenv(name, value)
    code = "from mpi4py import MPI; print(MPI.COMM_WORLD.size)"
    command = [*find_launcher(2), sys.executable, "-c", code]
    done = run_program(command, env=environment(), seconds=60)
    assert (done.returncode, sorted(done.stdout.replace("\n", ""))) == (0, ["2", "2"]), done.stderr


def test_variables_of_the_user_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMPI_MCA_btl", "self,tcp")
    assert environment()["OMPI_MCA_btl"] == "self,tcp"
