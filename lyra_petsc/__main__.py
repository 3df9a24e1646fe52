"""``python -m lyra_petsc`` and the command ``lyra-petsc``."""

from __future__ import annotations

import gc
import os
import sys


def main() -> None:
    """Run the command line and leave with its exit code."""
    from lyra_petsc.cli.signals import leave_at_once

    leave_at_once()  # the imports that follow take a second
    from lyra_petsc.cli.app import run_command_line

    code = run_command_line(sys.argv)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:  # the reader is gone; Python would try again and complain
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    # Python would look through all objects, and destroy them, after the last line: half a second of processor
    # time, many on a busy machine; PETSc's in an order that need not be the same on all ranks
    gc.freeze()
    sys.exit(code)


if __name__ == "__main__":
    main()
