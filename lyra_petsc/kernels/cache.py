"""Functions compiled by numba and kept on disk, safe with many ranks and with a disk that fails.

Numba keeps what it compiled beside the source, in the user's cache where that cannot be written, or in
``NUMBA_CACHE_DIR``; where it finds no place, every run compiles anew.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.registry import cpu_target
from numba.core.sigutils import normalize_signature

from lyra_petsc.kernels.compilation import COMPILATION

Index = np.uintp
"""Kernels look entries up by it: no number is negative then, which numba would count from the end."""

# what the first function would load: so all ranks do it at once, none while the others wait for its mesh
cpu_target.target_context.refresh()


@cache
def digest(room: Path) -> str:
    """Of all modules of a package, and of ``kernels``, whose kernels others call.

    A compiled function contains those of other modules that it calls, while numba looks at its own only.
    """
    rooms = sorted({room, Path(__file__).parent})
    files = [file for each in rooms for file in sorted(each.rglob("*.py"))]
    return sha256(b"\0".join(file.read_bytes() for file in files)).hexdigest()[:16]


class KernelCache(FunctionCache):
    """Numba's cache of one function.

    The digest stands in the file names: numba announces an entry before it writes it, and what an older
    source left under the same name would be taken for it.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        stamp = digest(Path(inspect.getfile(function)).parent)
        name = f"{self._impl.filename_base}-{stamp}"
        self._cache_file = IndexDataCacheFile(self._cache_path, name, stamp)  # type: ignore[no-untyped-call]

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        """As numba's, with compiled functions that a kernel is made from by their names.

        Numba would take their contents, in which every process has another number. A change of them changes
        the digest.
        """
        function = self._py_func
        parts = [
            getattr(cell.cell_contents, "py_func", cell.cell_contents) for cell in function.__closure__ or ()
        ]
        names = [f"{getattr(part, '__module__', '')}.{getattr(part, '__qualname__', part)}" for part in parts]
        code = sha256(function.__code__.co_code).hexdigest()
        return sig, codegen.magic_tuple(), (code, tuple(names))

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """What was compiled for the argument types ``sig``; None if there is nothing sound."""
        try:
            found = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except Exception:  # whatever reading half a file may raise
            with suppress(OSError):
                self.flush()  # type: ignore[no-untyped-call]
            return None
        # ranks that compile for different types at the same time may choose the same name
        types = normalize_signature(sig)[0]  # type: ignore[no-untyped-call]
        return found if found is not None and found.signature.args == types else None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep it, if the disk can."""
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        except OSError:
            COMPILATION.kept = False


def cached(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator like ``numba.njit(cache=True)``; ``options`` are numba's."""

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = njit(**options)(function)
        try:
            dispatcher._cache = KernelCache(function)
        except RuntimeError:  # numba's word for no place to keep it
            COMPILATION.kept = False
        return dispatcher

    return compiled
