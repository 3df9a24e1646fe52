"""The formats; one line each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from lyra_petsc.export.frames import Frames


@dataclass(frozen=True)
class Format:
    """A format, written by the module of its name.

    Attributes
    ----------
    name, meaning : str
    packages : tuple of str
        What it needs of the extra ``export``.
    """

    name: str
    meaning: str
    packages: tuple[str, ...] = ()

    @property
    def write(self) -> Callable[[Frames, Path, str], None]:
        """Writes frames into a folder, in files that begin with a name."""
        writer: Callable[[Frames, Path, str], None] = import_module(f"lyra_petsc.export.{self.name}").write
        return writer


FORMATS = {
    one.name: one
    for one in (
        Format("obj", "a Wavefront file for each state"),
        Format("ply", "a binary PLY file for each state, with the fields on vertices", ("meshio",)),
        Format("gltf", "an animated .glb: a morph target for each state", ("pygltflib",)),
        Format("usd", "an animated .usdc, with all fields", ("pxr",)),
        Format("vtkhdf", "one file for ParaView and VTK, with all fields"),
        Format("npz", "NumPy arrays of all states, with names and units"),
    )
}
