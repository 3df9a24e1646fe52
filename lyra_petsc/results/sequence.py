"""Arrays of a run, one for each written state, read when they are asked for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.output.agreement import HDF5_ERRORS, reason
from lyra_petsc.output.h5py_loader import import_h5py
from lyra_petsc.results.announced import Place


class StateArrays(Sequence[NDArray[Any]]):
    """What all states hold under one name: ``[i]`` reads one array, ``[i:j]`` reads nothing yet.

    ``numpy.asarray`` of it reads them all, stacked along a first axis.

    Parameters
    ----------
    folder : Path
        The run's folder.
    name : str
    places : sequence of (str, str)
        File and dataset of each state.
    """

    def __init__(self, folder: Path, name: str, places: Sequence[Place]) -> None:
        self._folder, self._name, self._places = folder, name, places

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, index: int) -> NDArray[Any]: ...

    @overload
    def __getitem__(self, index: slice) -> StateArrays: ...

    def __getitem__(self, index: int | slice) -> NDArray[Any] | StateArrays:
        """Read the array of a state, or choose states.

        Raises
        ------
        IndexError
            If there is no such state.
        InputError
            If its file is gone or damaged.
        """
        if isinstance(index, slice):
            return StateArrays(self._folder, self._name, self._places[index])
        return read_array(self._folder, self._places[index])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        if not self._places:
            raise ValueError(f"no states of {self._name} to stack")
        return np.stack([np.asarray(array, dtype=dtype) for array in self])

    def __repr__(self) -> str:
        return f"<{self._name} of {len(self)} states in {self._folder}>"


def read_array(folder: Path, place: Place) -> NDArray[Any]:
    """A whole dataset.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    file, dataset = place
    try:
        with import_h5py().File(folder / file, "r") as opened:
            array: NDArray[Any] = opened[dataset][()]
    except HDF5_ERRORS as error:
        why = reason(error) if (folder / file).exists() else "no such file"
        raise InputError(f"{dataset.lstrip('/')} cannot be read: {why}", file=folder / file) from None
    return array
