"""Separation of a command line into options of the program and of PETSc."""

from __future__ import annotations

import click
import pytest

from lyra_petsc.cli.arguments import move_help, split
from lyra_petsc.cli.verbs import verbs


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
def test_arguments_are_separated(line: str, ours: str, petsc: str) -> None:
    assert split(line.split()) == (ours.split(), petsc.split())


@pytest.mark.parametrize("verb", [None, *verbs.commands])
def test_help_of_every_verb_shows_an_example_that_can_be_parsed(verb: str | None) -> None:
    ours, petsc = move_help(*split([verb, "-help"] if verb else ["-help"]))
    assert (ours, petsc) == ([verb, "--help"] if verb else ["--help"], [])
    command = verbs.commands[verb] if verb else verbs
    text = command.get_help(click.Context(command, info_name="lyra-petsc", max_content_width=300))
    examples = text.partition("Example")[2].splitlines()[1:]
    assert examples
    for line in examples:
        words = split(line.partition("lyra-petsc ")[2].split())[0]
        assert words[0] == verb or (verb is None and words[0] in verbs.commands)
        with verbs.commands[words[0]].make_context(words[0], words[1:]):
            pass


def test_help_after_a_scene_is_passed_to_petsc() -> None:
    assert move_help(*split(["run", "a.yaml", "-help"])) == (["run", "a.yaml"], ["-help"])
    assert move_help(*split(["render", "runs/a", "-help"])) == (["render", "--help"], [])
