"""Functions compiled by numba and cached on disk, safe with many ranks and with a disk that fails.

Numba stores compiled functions beside the source, in the user's cache directory if the source's is not
writable, or in ``NUMBA_CACHE_DIR``; if it finds no place, every run compiles anew.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from glob import escape
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit, types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.datamodel.models import OpaqueModel
from numba.core.registry import cpu_target
from numba.core.sigutils import normalize_signature
from numba.extending import register_model, typeof_impl

from lyra_petsc.kernels.compilation import COMPILATION

Index = np.uintp
"""Type of indices in kernels: it is never negative, so that numba does not test for indices from the end."""

# otherwise the first function loads this on rank 0 alone, while the others wait for its mesh
cpu_target.target_context.refresh()


@cache
def digest(package: Path) -> str:
    """Digest of all modules of a package, and of ``kernels``, whose kernels others call.

    A compiled function contains the functions of other modules that it calls, but numba checks only its own
    module.
    """
    packages = sorted({package, Path(__file__).parent})
    files = [file for package in packages for file in sorted(package.rglob("*.py"))]
    return sha256(b"\0".join(file.read_bytes() for file in files)).hexdigest()[:16]


class KernelCache(FunctionCache):
    """Numba's cache of one function, with the digest in the names of its files.

    Numba registers an entry before it writes the file, so that a file of the same name from an older source
    would be taken for it.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        file, program = Path(inspect.getfile(function)), Path(__file__).parents[1]
        within = file.is_relative_to(program)
        self._stamp = digest(program / file.relative_to(program).parts[0] if within else file.parent)
        name = f"{self._impl.filename_base}-{self._stamp}"
        self._cache_file = IndexDataCacheFile(self._cache_path, name, self._stamp)  # type: ignore[no-untyped-call]

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        """Numba's key, but with the names of functions in the closure instead of their pickled contents.

        These differ between processes. A change of the functions changes the digest.
        """
        function = self._py_func
        parts = [
            getattr(cell.cell_contents, "py_func", cell.cell_contents) for cell in function.__closure__ or ()
        ]
        names = [f"{getattr(part, '__module__', '')}.{getattr(part, '__qualname__', part)}" for part in parts]
        code = sha256(function.__code__.co_code).hexdigest()
        return sig, codegen.magic_tuple(), (code, tuple(names))

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled function for argument types ``sig``; None if there is none or the file is damaged."""
        try:
            overload = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except Exception:  # reading a damaged file may raise anything
            with suppress(OSError):
                self.flush()  # type: ignore[no-untyped-call]
            return None
        # ranks that compile for different types at the same time may choose the same name
        types = normalize_signature(sig)[0]  # type: ignore[no-untyped-call]
        return overload if overload is not None and overload.signature.args == types else None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store a compiled function if the disk permits."""
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
            self._remove_outdated()
        except OSError:
            COMPILATION.all_cached = False

    def _remove_outdated(self) -> None:
        """Remove the files of older sources of this function, whatever its line was."""
        function, line = self._impl.filename_base.rsplit("-", 1)
        version = line.partition(".")[2]
        for file in Path(self._cache_path).glob(f"{escape(function)}-*.{version}-*.nb[ci]"):
            if f"-{self._stamp}." not in file.name:
                file.unlink(missing_ok=True)


KERNELS: dict[str, Any] = {}
"""Kernels of the modules that are imported, by `kernel_name`."""


def kernel_name(kernel: Any) -> str:
    """Module and name of a kernel."""
    return f"{kernel.py_func.__module__}:{kernel.py_func.__qualname__}"


def cached(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator like ``numba.njit(cache=True)``; ``options`` are numba's."""

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = njit(**options | {"no_cfunc_wrapper": True})(function)
        KERNELS[kernel_name(dispatcher)] = dispatcher
        try:
            dispatcher._cache = KernelCache(function)
        except RuntimeError:  # numba found no place for the cache
            COMPILATION.all_cached = False
        return dispatcher

    return compiled


class InnerFunction:
    """A function that is compiled only as a part of other functions; Python calls ``py_func``, not compiled.

    Otherwise numba would compile code by which Python calls it, too, which takes as long as the function.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self.py_func = function
        wrappers = dict.fromkeys(("no_cfunc_wrapper", "no_cpython_wrapper"), True)
        self.dispatcher: Any = njit(**options | wrappers)(function)

    def __call__(self, *args: Any) -> Any:
        return self.py_func(*args)


class InnerFunctionType(types.Dispatcher):
    """Numba's type of an `InnerFunction`, which is not compiled again for each literal number."""

    def get_call_type(self, context: Any, args: Any, keywords: Any) -> Any:
        """Signature for these types of arguments."""
        kinds = tuple(map(types.unliteral, args))
        return super().get_call_type(context, kinds, keywords)


register_model(InnerFunctionType)(OpaqueModel)


@typeof_impl.register(InnerFunction)
def _type_of_inner(function: InnerFunction, context: Any) -> InnerFunctionType:
    return InnerFunctionType(function.dispatcher)


def inner(**options: Any) -> Callable[[Callable[..., Any]], InnerFunction]:
    """Decorator for functions that only compiled functions call; ``options`` are numba's."""
    return lambda function: InnerFunction(function, options)
