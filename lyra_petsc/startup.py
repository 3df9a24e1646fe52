"""Starting MPI, PETSc, and further processes of Python.

The working directory may be a stranger's: nothing in it is run because of its name. Therefore PETSc's files
of options are read from the home folder alone, or where the user names one, and processes get the import path
of this one.
"""

from __future__ import annotations

import ctypes
import glob
import itertools
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lyra_petsc.errors import InputError
from lyra_petsc.parallel import restore_signal_handlers

if TYPE_CHECKING:
    from mpi4py import MPI

PETSCRC = "--petscrc="
"""Beginning of the word that names a file of PETSc options."""

LAUNCHER_VARIABLES = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "PMI_RANK", "PMIX_RANK", "MPI_LOCALNRANKS")
"""Environment variables of processes that a launcher has started."""

DISTRIBUTION = "/usr/lib/petscdir/*/*-real/lib/python3/dist-packages/petsc4py"
"""Debian's petsc4py, whose folder is not on the import path."""


def python_command(code: str) -> list[str]:
    """Words that run a program in another Python with the import path of this one.

    Python itself would search the working directory first.
    """
    package = str(Path(__file__).parents[1])
    folders = [folder for folder in sys.path if folder]
    folders = folders if package in folders else [package, *folders]
    return [sys.executable, "-c", f"import sys; sys.path[:] = {folders!a}; {code}"]


def module_command(module: str) -> list[str]:
    """As `python_command`, for a module of this package."""
    return python_command(f"import runpy; runpy.run_module({module!r}, run_name='__main__', alter_sys=True)")


def is_launched(environment: Mapping[str, str]) -> bool:
    """Whether this process was started by mpirun, mpiexec or srun."""
    if environment.get("OMPI_MCA_ess") == "singleton":  # child of a process without a launcher
        return False
    if any(name in environment for name in LAUNCHER_VARIABLES):
        return True
    # only within srun: a batch script may have the first of these variables as well
    return "SLURM_STEP_NUM_TASKS" in environment and "SLURM_PROCID" in environment


def start_mpi() -> MPI.Comm:
    """Start MPI unless it has started; returns COMM_WORLD."""
    # without a launcher Open MPI would start a daemon, which is only needed to spawn processes
    settings = {"OMPI_MCA_ess_singleton_isolated": "1"}
    ranks, here = map(os.environ.get, ("OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_LOCAL_SIZE"))
    if not is_launched(os.environ) or (ranks is not None and ranks == here):
        # on one machine shared memory suffices; other transports would listen on all network interfaces
        settings |= {"OMPI_MCA_pml": "ob1", "OMPI_MCA_btl": "self,vader"}
    added = {name: value for name, value in settings.items() if name not in os.environ}
    os.environ.update(added)
    try:
        from mpi4py import MPI
    except ImportError as error:
        raise _missing(error) from None
    finally:
        for name in added:  # a launcher that this process starts may use several machines
            del os.environ[name]
    return MPI.COMM_WORLD


def start_petsc(words: Sequence[str] = ()) -> None:
    """Start MPI and PETSc unless PETSc has started.

    Parameters
    ----------
    words : sequence of str
        PETSc options, and ``--petscrc=FILE`` for a file of options.

    Raises
    ------
    InputError
        If PETSc is missing or would fail or crash with its options.
    """
    start_mpi()
    if "petsc4py.PETSc" in sys.modules:
        return
    options = _all_options(words)
    # PETSc's own message of some twenty lines is replaced by that of PetscErrorMessage
    try:
        import petsc4py
        import petsc4py.lib

        # by default petsc4py takes the build that petsc.cfg of the working directory names
        folder = os.path.dirname(petsc4py.lib.__file__)
        build = petsc4py.lib.getPathArch(folder, None, "PETSC_ARCH", os.path.join(folder, "petsc.cfg"))[1]
        library = ctypes.CDLL(petsc4py.lib.ImportPETSc(build).__file__)
    except ImportError as error:
        raise _missing(error) from None
    printing = ctypes.c_void_p.in_dll(library, "PetscErrorPrintf")
    usual, silent = printing.value, ctypes.cast(library.PetscErrorPrintfNone, ctypes.c_void_p).value
    printing.value = silent
    try:
        petsc4py.init([sys.argv[0], *options], build)
    except RuntimeError as error:  # PETSc.Error does not exist before PETSc has started
        texts = ctypes.c_char_p(), ctypes.c_char_p()
        library.PetscErrorMessage(error.args[0], *map(ctypes.byref, texts))
        reason = "; ".join(text.value.decode("utf-8", "replace") for text in texts if text.value)
        raise InputError(f"PETSc does not start with its options: {reason}") from None
    finally:
        if printing.value == silent:  # unless an option has changed it
            printing.value = usual
    restore_signal_handlers()


def _missing(error: ImportError) -> InputError:
    """The error for a Python without petsc4py or mpi4py."""
    folders = map(os.path.dirname, sorted(glob.glob(DISTRIBUTION)))
    absent = [folder for folder in folders if folder not in sys.path]
    remedy = "use 'bash scripts/run.sh', or see docs/install.md for Debian, conda, clusters and PyPI"
    if absent and "petsc4py" in str(error):
        remedy = f"the distribution's is in {absent[-1]}: add this folder to PYTHONPATH"
    return InputError(f"{error}: this Python ({sys.executable}) has no working petsc4py and mpi4py; {remedy}")


def _all_options(words: Sequence[str]) -> list[str]:
    """The options of files and of the command line, in the order in which PETSc is to read them.

    Raises
    ------
    InputError
        If PETSc would fail or crash with them.
    """
    named = [word.removeprefix(PETSCRC) for word in words if word.startswith(PETSCRC)]
    options = [word for word in words if not word.startswith(PETSCRC)]
    variable = os.environ.get("PETSC_OPTIONS", "").split()
    home = os.path.expanduser("~/.petscrc")
    usual = [home] if os.path.isfile(home) and "-skip_petscrc" not in [*variable, *options] else []
    for file in [*usual, *named]:
        if why := options_error(["-options_file", file]):
            raise InputError(why.removeprefix("-options_file: "), key="--petscrc" if file in named else None)
    if why := options_error([*variable, *options]):
        raise InputError(why)
    files = [word for file in [*usual, *named] for word in ("-options_file", file)]
    # PETSc reads the command line after its variable, which is to override the files
    return ["-skip_petscrc", *files, *(variable if files else []), *options]


def options_error(options: Sequence[str], files: Sequence[str] = ()) -> str:
    """Message if PETSc would fail or crash when it reads these options; ``files`` include them."""
    for option, value in itertools.pairwise([*options, ""]):
        if option != option.encode("utf-8", "replace").decode():
            return f"{option}: must be text in UTF-8"
        if not option.startswith("-"):
            continue
        name = option.lstrip("-").lower()
        if name in ("options_file", "options_file_yaml"):
            try:
                text = Path(value).read_text(encoding="utf-8")
            except (OSError, ValueError) as error:
                why = getattr(error, "strerror", None) or "it is no text"
                return f"-{name}: cannot read '{value}': {why}"
            path = os.path.realpath(value)
            if path in files:
                return f"-{name}: '{value}' includes itself"
            if name == "options_file":
                why = _syntax_error(text) or options_error(_read_words(text), [*files, path])
                if why:
                    return f"-{name}: {value}: {why}"
        if name == "python":
            return "-python: starts a program of Python's own; leave it out"
        if name == "history":
            folder = Path(value).parent if value and not value.startswith("-") else Path.home()
            if not os.access(folder, os.W_OK):
                return f"-history: cannot write into '{folder}'"
        if name == "fp_trap" and value.lower() not in ("0", "false", "no", "off"):
            return "-fp_trap: ends Python at numbers that overflow, which here make a step fail; leave it out"
    return ""


def _read_words(text: str) -> list[str]:
    """Words of an options file without its comments."""
    lines = (line.split("#")[0].split() for line in text.splitlines())
    return [word for words in lines if words and words[0][0] not in "!%" for word in words]


def _syntax_error(text: str) -> str:
    """Message about the first line of an options file that PETSc does not understand, if any."""
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#")[0].split()
        if words and not (words[0][0] in "-!%" or words[0].lower() in ("alias", "mpi")):
            return f"line {number}: '{words[0]}' is no option; one begins with a dash, a comment with #"
    return ""
