"""Lets processes wait for a kernel that another process is compiling.

All processes of pytest-xdist, and the programs that they start, begin with the same empty cache. Each kernel
is compiled by one of them and loaded by the others.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
from pathlib import Path
from typing import Any
from zlib import crc32


def compile_once() -> None:
    """Enable this in the present process, and in those that are forked from it."""
    from numba.core.dispatcher import Dispatcher

    compile_it = Dispatcher.compile
    name = f"lyra-petsc-tests-{os.getuid()}-{crc32(__file__.encode()):x}.lock"
    file = os.open(Path(tempfile.gettempdir(), name), os.O_CREAT | os.O_RDWR, 0o600)

    def compile_alone(dispatcher: Any, signature: Any) -> Any:
        function = dispatcher.py_func
        place = crc32(f"{function.__module__}.{function.__qualname__}".encode())
        fcntl.lockf(file, fcntl.LOCK_EX, 1, place)
        try:
            return compile_it(dispatcher, signature)
        finally:
            fcntl.lockf(file, fcntl.LOCK_UN, 1, place)

    Dispatcher.compile = compile_alone
