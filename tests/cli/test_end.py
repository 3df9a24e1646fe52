"""A process ends after its last line, without Python's garbage collection."""

from __future__ import annotations

import sys
from pathlib import Path

from launch import environment
from patience import run_program

PROGRAM = """
import atexit
from lyra_petsc.cli import app

class Held:
    def __del__(self):
        print("looked through")

def command_line(words):
    held = Held()
    held.itself = held
    print("last line")
    return 3

app.run_command_line = command_line
atexit.register(print, "handlers run")
from lyra_petsc.__main__ import main
main()
"""


def test_no_garbage_collection_at_the_end(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    ended = run_program([sys.executable, program], env=environment(), seconds=60)
    assert (ended.returncode, ended.stderr) == (3, "")
    assert ended.stdout.split("\n") == ["last line", "handlers run", ""]
