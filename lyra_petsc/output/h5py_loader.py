"""The one place that imports h5py."""

from __future__ import annotations

import os
from contextlib import suppress
from threading import Thread
from typing import Any


def import_h5py() -> Any:
    """h5py, with HDF5's file locks off: they fail on some cluster file systems.

    Nothing is lost with them: files are written under a name that no other process opens, and have
    their final name only when complete. ``HDF5_USE_FILE_LOCKING`` set by the user stands.
    """
    os.environ.setdefault("HDF5_USE_FILE_LOCKING", "FALSE")
    import h5py

    return h5py


def import_ahead() -> None:
    """Let a thread import it while this one makes the mesh, which is gmsh's work and not Python's."""

    def work() -> None:
        with suppress(ImportError):  # told where it is needed
            import_h5py()

    Thread(target=work, name="lyra-petsc h5py").start()
