"""``python -m lyra_petsc`` and the command ``lyra-petsc``."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line and leave with its exit code."""
    from lyra_petsc.cli.app import run_command_line

    sys.exit(run_command_line(sys.argv))


if __name__ == "__main__":
    main()
