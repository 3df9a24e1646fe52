"""A lock on a folder: held by one process at a time, and gone with it however it ends."""

from __future__ import annotations

import fcntl
import os
import socket
import time
from contextlib import suppress
from pathlib import Path

LOCK_FILE = "run.lock"


class Busy(Exception):
    """Another process holds the lock; the text says which."""


class FolderLock:
    """Lock a folder; for one rank.

    The lock is the kernel's (``flock``) on a file of its own in the folder. A process that is
    killed leaves the file behind and the lock free; one that ends by itself removes the file.

    Parameters
    ----------
    folder : Path
        An existing folder.

    Attributes
    ----------
    held : bool
        False where the file system knows no locks.

    Raises
    ------
    Busy
        If another process holds it.
    OSError
        If the file cannot be created.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / LOCK_FILE
        while True:
            self._descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
            try:
                self.held = self._lock()
                if self._stands():
                    break
            except BaseException:
                os.close(self._descriptor)
                raise
            os.close(self._descriptor)  # its former holder removed it meanwhile
        with suppress(OSError):  # on a full disk the lock holds without words
            os.ftruncate(self._descriptor, 0)
            since = time.strftime("%Y-%m-%d %H:%M:%S")
            os.pwrite(
                self._descriptor, f"process {os.getpid()} on {socket.gethostname()}, {since}".encode(), 0
            )

    def _lock(self) -> bool:
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise Busy(self._holder()) from None
        except OSError:
            return False
        return True

    def _holder(self) -> str:
        text = os.pread(self._descriptor, 200, 0).decode("utf-8", "replace")
        return "".join(c for c in text if c.isprintable()) or "a process that has not said which"

    def _stands(self) -> bool:
        """Whether the file locked is still the one that others would find."""
        try:
            return os.path.samestat(os.fstat(self._descriptor), os.stat(self.path))
        except FileNotFoundError:
            return False

    def release(self) -> None:
        """Remove the file, then let go."""
        with suppress(OSError):  # the folder itself may be gone
            if self._stands():
                self.path.unlink()
        with suppress(OSError):
            os.close(self._descriptor)


def in_use(folder: Path) -> bool:
    """Whether a process holds the lock of a folder; also True where the file system knows no locks."""
    try:
        descriptor = os.open(folder / LOCK_FILE, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)  # lets go at once
    return False
