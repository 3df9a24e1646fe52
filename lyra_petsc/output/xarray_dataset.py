"""The states of a run as a labelled dataset of xarray."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lyra_petsc.extras import require
from lyra_petsc.output.tensors import COMPONENTS, TENSORS

if TYPE_CHECKING:
    from lyra_petsc.output.read_run import StoredRun

WIDTHS = {"velocity": "axis", "displacement": "axis"}
"""What the last axis of a vector counts; that of a tensor: components in the material axes."""


def dataset(run: StoredRun, states: Sequence[int]) -> Any:
    """Times, positions, rest shape, triangles and fields of some states, with units; see `Run.dataset`."""
    require("dataset", ("xarray",), "export")
    import xarray

    chosen = list(states)
    content = {
        "position": _variable(
            run, "position", ("state", "vertex", "axis"), [run.positions[i] for i in chosen]
        )
    }
    for name in run.fields:
        arrays = [run.field(name)[i] for i in chosen]
        last = (WIDTHS.get(name, "component"),) if arrays[0].ndim == 2 else ()
        content[name] = _variable(run, name, ("state", run.field_on(name), *last), arrays)
    content["rest"] = (("vertex", "axis"), run.rest, {"units": "m"})
    content["triangles"] = (("triangle", "corner"), run.triangles, {})
    axes = {"axis": list("xyz")}
    if tensors := [content[name][1] for name in run.fields if name in TENSORS]:
        axes["component"] = list(COMPONENTS[tensors[0].shape[-1]])
    time = ("state", run.times[chosen], {"units": "s"})
    return xarray.Dataset(content, {"time": time, **axes}, {"title": run.scene.title}).swap_dims(state="time")


def _variable(run: StoredRun, name: str, dimensions: tuple[str, ...], arrays: list[Any]) -> tuple[Any, ...]:
    return dimensions, np.stack(arrays), {"units": run.field_units(name)}
