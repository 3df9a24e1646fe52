"""The XDMF text that shows state files as a time series in ParaView."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from xml.sax.saxutils import quoteattr

import numpy as np

XDMF_FILE = "states.xdmf"
MESH_FILE = "mesh.h5"


@dataclass(frozen=True)
class StoredField:
    """A dataset of a state.

    Attributes
    ----------
    name : str
        Its name in the state's group.
    on : str
        ``"vertex"`` or ``"triangle"``: what its rows belong to.
    shape : tuple of int
        Rows first.
    dtype : str
        numpy's name of the stored type.
    """

    name: str
    on: str
    shape: tuple[int, ...]
    dtype: str


@dataclass(frozen=True)
class WrittenState:
    """A state file that is complete on disk.

    Attributes
    ----------
    number : int
        0 for the initial state, then one more for each written state.
    step : int
        Accepted steps before it.
    time : float
        [s].
    file : str
        File name, relative to the XDMF file.
    fields : tuple of StoredField
        What it holds besides the positions.
    """

    number: int
    step: int
    time: float
    file: str
    fields: tuple[StoredField, ...]


# a row's number of components, as XDMF names it; other widths are matrices
ATTRIBUTE_TYPES = {1: "Scalar", 3: "Vector", 6: "Tensor6", 9: "Tensor"}
CENTERS = {"vertex": "Node", "triangle": "Cell"}


DOCUMENT_START = (
    '<?xml version="1.0"?>\n<Xdmf Version="3.0">\n <Domain>\n'
    '  <Grid Name="states" GridType="Collection" CollectionType="Temporal">\n'
)
DOCUMENT_END = "  </Grid>\n </Domain>\n</Xdmf>\n"


def group_name(number: int) -> str:
    """The HDF5 group of a state in its file."""
    return f"states/{number:06d}"


class TimeSeries:
    """The document that shows states of one mesh.

    Parameters
    ----------
    n_vertices, n_triangles : int
        Rows of positions and of triangles.
    mesh_file : str
        Name of the file with ``/mesh/triangles`` and ``/mesh/rest``, relative to the XDMF file.
    """

    def __init__(self, n_vertices: int, n_triangles: int, mesh_file: str) -> None:
        self._n_vertices = n_vertices
        triangles = _item((n_triangles, 3), "int64", f"{mesh_file}:/mesh/triangles")
        self._before = (
            f'   <Topology TopologyType="Triangle" NumberOfElements="{n_triangles}">{triangles}</Topology>\n'
        )
        rest = StoredField("rest", "vertex", (n_vertices, 3), "float64")
        self._after = _attribute(rest, f"{mesh_file}:/mesh/rest")

    def text(self, states: Sequence[WrittenState]) -> str:
        """The whole document, states in the order given."""
        return DOCUMENT_START + "".join(map(self.grid, states)) + DOCUMENT_END

    def grid(self, state: WrittenState) -> str:
        """A state's part of it."""
        group = f"{state.file}:/{group_name(state.number)}"
        position = _item((self._n_vertices, 3), "float64", f"{group}/position")
        return (
            f'  <Grid Name="state {state.number}" GridType="Uniform">\n'
            f'   <Time Value="{state.time!r}"/>\n{self._before}'
            f'   <Geometry GeometryType="XYZ">{position}</Geometry>\n'
            + "".join(_attribute(field, f"{group}/{field.name}") for field in state.fields)
            + f"{self._after}  </Grid>\n"
        )


def _attribute(field: StoredField, where: str) -> str:
    kind = ATTRIBUTE_TYPES.get(int(np.prod(field.shape[1:], dtype=int)), "Matrix")
    return (
        f'   <Attribute Name={quoteattr(field.name)} AttributeType="{kind}" Center="{CENTERS[field.on]}">'
        f"{_item(field.shape, field.dtype, where)}</Attribute>\n"
    )


def _item(shape: tuple[int, ...], dtype: str, where: str) -> str:
    kind = np.dtype(dtype)
    number = {"f": "Float", "i": "Int", "u": "UInt"}[kind.kind]
    return (
        f'<DataItem Format="HDF" NumberType="{number}" Precision="{kind.itemsize}" '
        f'Dimensions="{" ".join(map(str, shape))}">{where}</DataItem>'
    )
