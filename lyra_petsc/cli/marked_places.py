"""Files that show the places of an error."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from lyra_petsc.errors import MarkedError, OutputError
from lyra_petsc.parallel import on_root

if TYPE_CHECKING:
    from mpi4py import MPI


@contextmanager
def places_shown(comm: MPI.Comm) -> Iterator[None]:
    """A context whose `MarkedError`, which all ranks raise, is shown in files of the working folder; its
    message then names them. Collective where there is one.
    """
    try:
        yield
    except MarkedError as error:
        places = error.places

        def write() -> str:
            from lyra_petsc.contact.start_crossings import StartCrossings
            from lyra_petsc.show.crossing_places import write_places

            assert isinstance(places, StartCrossings)
            try:
                return write_places(places, Path())
            except OutputError as problem:
                return f"its places are in no file ({problem})"

        error.message += f"; {on_root(comm, write)}"
        raise
