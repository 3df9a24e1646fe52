"""Which words of a command line are ours and which are PETSc's."""

from __future__ import annotations

import pytest

from lyra_petsc.cli.arguments import split


@pytest.mark.parametrize(
    ("line", "ours", "petsc"),
    [
        ("run a.yaml", "run a.yaml", ""),
        ("run -ksp_type cg a.yaml", "run a.yaml", "-ksp_type cg"),
        ("run -snes_monitor a.yaml -ts_monitor", "run a.yaml", "-snes_monitor -ts_monitor"),
        ("run -snes_monitor CONF.JSON", "run CONF.JSON", "-snes_monitor"),
        ("run a.yaml -vec_type mpi", "run a.yaml", "-vec_type mpi"),
        ("run -ts_dt -1e-3 a.yml", "run a.yml", "-ts_dt -1e-3"),
        ("run -ts_dt .5 --out -3", "run --out -3", "-ts_dt .5"),
        ("run -options_file my.yaml a.yaml", "run a.yaml", "-options_file my.yaml"),
        ("run --out d -log_view :log.txt --force", "run --out d --force", "-log_view :log.txt"),
        ("run -info --force a.yaml", "run --force a.yaml", "-info"),
        ("run -- -a -b", "run -- -a -b", ""),
        ("-help", "", "-help"),
        ("", "", ""),
    ],
)
def test_splits(line: str, ours: str, petsc: str) -> None:
    assert split(line.split()) == (ours.split(), petsc.split())
