"""Lists and dictionaries of a scene, which cannot be changed."""

from __future__ import annotations

from typing import Any, NoReturn

from lyra_petsc.errors import InputError


def refuse_change(*args: Any, **kwargs: Any) -> NoReturn:
    """Refuse to change a part of a scene.

    Raises
    ------
    InputError
    """
    raise InputError("scenes are immutable; scene.changed({…}) returns a changed copy", key="scene")


class SealedList(list[Any]):
    """A list that refuses changes."""

    append = extend = insert = pop = remove = clear = sort = reverse = refuse_change
    __setitem__ = __delitem__ = __iadd__ = __imul__ = refuse_change

    def __reduce__(self) -> tuple[Any, ...]:
        return SealedList, (list(self),)


class SealedDict(dict[Any, Any]):
    """A dictionary that refuses changes."""

    update = pop = popitem = clear = setdefault = refuse_change
    __setitem__ = __delitem__ = __ior__ = refuse_change

    def __reduce__(self) -> tuple[Any, ...]:
        return SealedDict, (dict(self),)


def sealed(value: Any) -> Any:
    """A value of which no list or dictionary can be changed."""
    if isinstance(value, list):
        return SealedList(map(sealed, value))
    if isinstance(value, dict):
        return SealedDict({key: sealed(entry) for key, entry in value.items()})
    return value
