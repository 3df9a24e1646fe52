"""``python -m lyra_petsc``, ``python FOLDER/lyra_petsc`` and the command ``lyra-petsc``."""

import gc
import io
import os
import sys

if __package__ == "":  # started by the name of the folder, which Python has put on the import path
    sys.path[0] = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))


def leave_working_directory() -> None:
    """Remove the working directory from the import path: a stranger's folder may hold modules of any name."""
    try:
        here = os.getcwd()
    except OSError:  # it was removed
        here = ""
    own = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    # last, so that nothing beside the program hides an installed module where it is the working directory
    sys.path[:] = [*(folder for folder in sys.path if folder not in ("", here, own)), own]
    os.environ["PYTHONSAFEPATH"] = "1"  # for processes that libraries start


def main() -> None:
    """Run the command line and leave with its exit code."""
    leave_working_directory()
    from lyra_petsc.cli.signals import exit_on_signals

    exit_on_signals()  # before the imports that follow, which take a second
    for stream in (sys.stdout, sys.stderr):
        # a name that the terminal cannot show does not end a run
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")
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
