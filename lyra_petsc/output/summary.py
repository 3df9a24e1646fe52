"""summary.json: the scene's sizes and options, versions, wall times and outcome of a run."""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic_core import to_jsonable_python

import lyra_petsc
from lyra_petsc.errors import InputError
from lyra_petsc.output.file_operations import reason, replace_text
from lyra_petsc.output.stored import import_h5py
from lyra_petsc.parallel import on_root

if TYPE_CHECKING:
    from mpi4py import MPI


REMEDY = "remove it: the run can be read without"


def write_summary(path: str | os.PathLike[str], content: Mapping[str, Any], comm: MPI.Comm) -> None:
    """Write a summary atomically, so that a reader finds either the old or the new one.

    Parameters
    ----------
    path : path
        ``summary.json`` of the run's folder.
    content : mapping
        Numbers, text, arrays, lists and mappings; a number that is not finite becomes ``null``.
        Read on rank 0.
    comm : MPI.Comm
        All ranks; collective.

    Raises
    ------
    OutputError
        On every rank, if the file cannot be written.
    """

    def work() -> None:
        plain = to_jsonable_python(dict(content), inf_nan_mode="null", fallback=lambda array: array.tolist())
        replace_text(path, json.dumps(plain, indent=2, ensure_ascii=False) + "\n")

    on_root(comm, work)


def read_summary(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The content of a summary; empty if the file is missing. Call on one rank.

    Raises
    ------
    InputError
        If the file is damaged: it is not JSON, or an entry has the wrong type.
    """
    try:
        with open(path, encoding="utf-8") as file:
            content = json.load(file)
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise InputError(f"cannot be read: {reason(error)}", file=path) from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"is damaged: {reason(error)}; {REMEDY}", file=path) from None
    if not isinstance(content, dict):
        raise InputError(f"is damaged: no mapping; {REMEDY}", file=path)
    from pydantic import ValidationError

    from lyra_petsc.output.summary_entries import Summary

    try:
        Summary.model_validate(content, strict=True)
    except ValidationError as error:
        key = str(error.errors()[0]["loc"][0])
        raise InputError(f"is damaged, holds what no run writes; {REMEDY}", file=path, key=key) from None
    return content


def library_versions() -> dict[str, str]:
    """Versions of this program and its libraries by name; numba's only if a term has loaded it."""
    import mpi4py
    import petsc4py
    from mpi4py import MPI
    from petsc4py import PETSc

    h5py = import_h5py()
    versions = {
        "lyra_petsc": lyra_petsc.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "petsc": ".".join(map(str, PETSc.Sys.getVersion())),
        "petsc4py": petsc4py.__version__,
        "mpi4py": mpi4py.__version__,
        "mpi": MPI.Get_library_version().split("\n")[0].split(",")[0].strip("\0 "),
        "h5py": f"{h5py.version.version} ({'MPI' if h5py.get_config().mpi else 'serial'})",
        "hdf5": h5py.version.hdf5_version,
    }
    if "numba" in sys.modules:
        versions["numba"] = sys.modules["numba"].__version__
    return versions
