"""``python -m lyra_petsc`` and the command ``lyra-petsc``."""

from __future__ import annotations

import gc
import os
import sys


def main() -> None:
    """Run the command line and leave with its exit code."""
    from lyra_petsc.cli.signals import exit_on_signals

    exit_on_signals()  # before the imports that follow, which take a second
    from lyra_petsc.cli.app import run_command_line

    code = run_command_line(sys.argv)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:  # the reader is gone; Python would try again and complain
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    # keeps Python from destroying all objects at exit, which takes half a second or more, and frees PETSc's
    # objects in an order that may differ between ranks
    gc.freeze()
    sys.exit(code)


if __name__ == "__main__":
    main()
