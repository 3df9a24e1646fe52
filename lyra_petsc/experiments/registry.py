"""Entries by name, whose modules are imported when they are asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Generic, TypeVar, cast

from lyra_petsc.errors import InputError, nearest

T = TypeVar("T")


@dataclass(frozen=True)
class Registry(Generic[T]):
    """Names on the command line, in their order, and the modules that define what they stand for.

    Attributes
    ----------
    package : str
        In which the modules are.
    modules : mapping of name → module
        Entry ``some-name`` is the variable ``some_name`` of its module.
    what : str
        What an entry is, for the message about an unknown name.
    """

    package: str
    modules: Mapping[str, str]
    what: str = "unknown case"

    def load(self, name: str, *, key: str | None = None) -> T:
        """The entry of that name.

        Raises
        ------
        InputError
            For a name that is not listed, with the nearest that is; ``key`` is the option that gave it.
        """
        if name not in self.modules:
            raise InputError(f"{self.what}, {nearest(name, self.modules)}", key=key or name)
        module = import_module(f"{self.package}.{self.modules[name]}")
        return cast(T, getattr(module, name.replace("-", "_")))

    def all(self) -> list[T]:
        """Every entry, in the order of the names."""
        return [self.load(name) for name in self.modules]
