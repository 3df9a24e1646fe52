"""A run's folder holds all of its results: files that lead out of it are refused.

Otherwise a folder from somebody else could make a program show or change the user's own files: HDF5 follows
links to other files and takes data from any file, and a symbolic link may lead anywhere.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Thread
from typing import Any

from lyra_petsc.errors import InputError


def import_h5py() -> Any:
    """h5py, with HDF5's file locks off: they fail on some cluster file systems.

    Nothing is lost with them: files are written under a name that no other process opens, and have
    their final name only when complete. ``HDF5_USE_FILE_LOCKING`` set by the user stands.
    """
    os.environ.setdefault("HDF5_USE_FILE_LOCKING", "FALSE")
    import h5py

    return h5py


def import_ahead() -> None:
    """Import h5py in a thread, while this one waits for gmsh's process."""

    def work() -> None:
        with suppress(ImportError):  # told where it is needed
            import_h5py()

    Thread(target=work, name="lyra-petsc h5py").start()


ENDINGS = (".h5", ".xdmf", ".vtkhdf", ".csv", ".yaml", ".json", ".txt", ".part")
"""Of what a run writes and its readers read."""

_REMEDY = "a run's folder must hold all of its results"


class OutsideFolderError(InputError):
    """A file that is no part of its folder, or takes data from elsewhere."""


def check_folder(folder: Path) -> None:
    """Refuse results outside of the run's folder.

    Raises
    ------
    InputError
        Naming the first one.
    """
    try:
        names = sorted(entry.name for entry in os.scandir(folder) if entry.name.endswith(ENDINGS))
    except OSError:  # reported where it is read
        return
    for name in names:
        check_file(folder / name)


def check_file(path: Path) -> None:
    """Refuse a file that stands outside the folder where it seems to be, or is no file.

    Raises
    ------
    InputError
    """
    try:
        target, kind = path.resolve(), path.stat().st_mode
        inside = target.is_relative_to(path.parent.resolve())
    except (OSError, ValueError, RuntimeError):  # missing, or a circle of links
        if path.is_symlink():
            raise OutsideFolderError(f"is a link that leads nowhere; {_REMEDY}", file=path) from None
        return
    if not inside:
        raise OutsideFolderError(f"is a link out of the folder; {_REMEDY}", file=path)
    if not stat.S_ISREG(kind) and not stat.S_ISDIR(kind):
        raise InputError("is no plain file", file=path)


def check_name(name: str, file: Path) -> None:
    """Refuse a name in ``file`` that is not that of another file in its folder.

    Raises
    ------
    InputError
    """
    if name in ("", ".", "..") or "\\" in name or os.path.basename(name) != name or not name.isprintable():
        raise OutsideFolderError(f"names {name[:80]!r}, which is no file in its folder; {_REMEDY}", file=file)


@contextmanager
def open_own(path: str | os.PathLike[str]) -> Iterator[Any]:
    """An HDF5 file of a run's folder, to read, whose data are all its own.

    Yields
    ------
    h5py.File

    Raises
    ------
    InputError
        For data of other files, and links to them.
    OSError and what else h5py raises
        If it cannot be read.
    """
    path = Path(path)
    check_file(path)
    with import_h5py().File(path, "r") as file:
        _check_content(file.id, path)
        yield file


_known: dict[Path, tuple[int, ...]] = {}


def _check_content(file: Any, path: Path) -> None:
    """Look at all links and datasets of a file, once as long as it does not change."""
    status = path.stat()
    stamp = status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns
    if _known.get(path) == stamp:
        return
    h5py = import_h5py()
    root = h5py.h5g.open(file, b"/")
    groups, seen = [("", root)], {h5py.h5o.get_info(root).addr}
    while groups:
        above, group = groups.pop()
        for name in group:
            where = f"{above}/{name.decode(errors='replace')}"[-80:]
            if group.links.get_info(name).type != h5py.h5l.TYPE_HARD:
                raise OutsideFolderError(f"{where!r} is a link to elsewhere; {_REMEDY}", file=path)
            member = h5py.h5o.open(group, name)
            if isinstance(member, h5py.h5g.GroupID):
                # hard links may make circles, and few groups look like very many
                address = h5py.h5o.get_info(member).addr
                if address in seen:
                    raise InputError(f"{where!r}: a group in several places; is no file of a run", file=path)
                seen.add(address)
                groups.append((where, member))
            elif isinstance(member, h5py.h5d.DatasetID):
                plan = member.get_create_plist()
                if plan.get_layout() == h5py.h5d.VIRTUAL or plan.get_external_count() > 0:
                    raise OutsideFolderError(
                        f"{where!r} takes its data from other files; {_REMEDY}", file=path
                    )
    _known[path] = stamp
