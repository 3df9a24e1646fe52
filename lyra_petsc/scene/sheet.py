"""Scene blocks that say what the sheets are: mesh sources and materials."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator
from typing_extensions import Self

from lyra_petsc.materials.tables import names
from lyra_petsc.nearest import nearest
from lyra_petsc.scene.block import Block
from lyra_petsc.scene.rules import given, one_of, only, when
from lyra_petsc.scene.values import (
    Axis,
    Bending,
    Count,
    JsonSchema,
    Name,
    NonNegative,
    Number,
    Poisson,
    Positive,
    PositiveScale,
    Vector,
    problem,
    shown,
)

MESH_SUFFIXES = (".geo", ".msh", ".obj")


class Rotation(Block):
    """Right-handed rotation about an axis through the origin.

    Attributes
    ----------
    axis : (3,)
        Direction of the axis; not zero, need not be a unit vector.
    degrees : float [°]
        Angle.
    """

    axis: Axis
    degrees: Number


class Transform(Block):
    """Scaling, then rotation, then translation, all about the origin.

    Attributes
    ----------
    scale : float or (3,)
        Factor, or one for each axis; > 0.
    rotate : Rotation or None
        Rotation after the scaling.
    translate : (3,) [m]
        Displacement after the rotation.
    """

    scale: PositiveScale = 1.0
    rotate: Rotation | None = None
    translate: Vector = (0.0, 0.0, 0.0)


class Grid(Block):
    """A rectangle of cells in the xy plane, one corner at the origin.

    Attributes
    ----------
    width, height : float [m]
        Extent in x and y.
    nx, ny : int
        Cells in x and y.
    pattern : str
        How cells are cut into triangles: all diagonals alike, alternating, or four triangles a cell.
    """

    width: Positive
    height: Positive
    nx: Count
    ny: Count
    pattern: Literal["diagonal", "alternating", "criss-cross"] = "diagonal"


def _file(*endings: str) -> dict[str, Any]:
    """Schema of a file name with one of these endings, in any case."""
    any_case = ("".join(f"[{letter}{letter.upper()}]" for letter in ending) for ending in endings)
    return {"type": "string", "pattern": rf"\.({'|'.join(any_case)})$"}


class MeshSource(Block):
    """Where one sheet comes from: a file or a grid.

    Attributes
    ----------
    file : Path or None
        A .geo, .msh or .obj; a relative path stands beside the scene file.
    grid : Grid or None
        A rectangle instead of a file.
    size : float [m] or None
        Element size for a .geo.
    transform : Transform
        Where the sheet starts; without ``vt`` its scaling counts for the rest shape, too.
    name : str or None
        Name of the sheet; a surface group of that name holds its triangles.
    """

    rules = (one_of("file", "grid"), when(given("size"), given(file=_file("geo"))))

    file: Annotated[Path, JsonSchema(_file("geo", "msh", "obj"))] | None = None
    grid: Grid | None = None
    size: Positive | None = None
    transform: Transform = Field(default_factory=Transform)
    name: Name | None = None

    @field_validator("file", mode="before")
    @classmethod
    def _beside_scene(cls, value: Any, info: ValidationInfo) -> Any:
        if not isinstance(value, (str, Path)) or not str(value).strip() or "\0" in str(value):
            raise problem(f"must be the path of a mesh file, not {shown(value)}")
        path = Path(value)
        if path.suffix.lower() not in MESH_SUFFIXES:
            raise problem(f"{path.name!r} must end in {', '.join(MESH_SUFFIXES)}")
        directory = (info.context or {}).get("directory", Path.cwd())
        # normalised by name only: a symbolic link may be what the user wants to see
        return Path(directory, path) if path.is_absolute() else (Path(directory) / path).absolute()

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if len(self.given("file", "grid")) != 1:
            raise problem("must have exactly one of file, grid")
        if self.size is not None and (self.file is None or self.file.suffix.lower() != ".geo"):
            raise problem("is for .geo files only (others come with their elements)", "size")
        return self


class Membrane(Block):
    """Orthotropic St. Venant-Kirchhoff stiffness [N/m]; axis 1 is the warp.

    Attributes
    ----------
    c11, c22 : float [N/m]
        Along warp and weft.
    c12 : float [N/m]
        Coupling of the two; c12² < c11 c22.
    c33 : float [N/m]
        Shear modulus of engineering shear.
    """

    c11: Positive
    c22: Positive
    c12: Number
    c33: Positive

    @model_validator(mode="after")
    def _positive_definite(self) -> Self:
        if abs(self.c12) >= (self.c11**0.5) * (self.c22**0.5):
            raise problem(
                f"is not positive definite: |c12| = {abs(self.c12):g} must be below"
                f" sqrt(c11 c22) = {(self.c11**0.5) * (self.c22**0.5):g} N/m",
                "c12",
            )
        return self


_SHEET = ("membrane", "bending")
_ISOTROPIC = ("young", "poisson", "thickness")


class Material(Block):
    """One material, named from a library or given by its numbers.

    Exactly one of three ways: ``cloth``; ``density`` + ``membrane`` (+ ``bending``);
    ``young`` + ``poisson`` + ``thickness`` + ``density``.

    Attributes
    ----------
    group : str or None
        Surface group it is for; without: all triangles that no other block names.
    cloth : str or None
        Name of a measured cloth or an engineering material of the library, instead of numbers.
    density : float [kg/m²] or None
        Areal density.
    membrane : Membrane or None
        Stretching stiffness.
    bending : float or (3,) [N·m] or None
        Cylindrical stiffness B; three values hold for hinge edges at 0°, 45°, 90° to the warp.
    young : float [Pa] or None
        Young's modulus of an isotropic shell.
    poisson : float or None
        Poisson's ratio of an isotropic shell.
    thickness : float [m] or None
        Thickness of an isotropic shell.
    damping : float [s]
        γ of stiffness-proportional damping.
    warp_degrees : float [°]
        Rotation of the warp in the material plane, anticlockwise.
    density_scale, stretching_scale, bending_scale : float
        Factors on density, membrane and bending.
    thicken : float
        t: density × t, membrane × t, bending × t³.
    rest_curvature : (3,) [1/m] or None
        Curvature κ11, κ22, κ12 at rest, in the material axes.
    """

    rules = (
        {
            "oneOf": [
                only(("cloth",), unless=("density", *_SHEET, *_ISOTROPIC)),
                only(("density", "membrane"), unless=("cloth", *_ISOTROPIC)),
                only(("density", *_ISOTROPIC), unless=("cloth", *_SHEET)),
            ]
        },
    )

    group: Name | None = None
    cloth: Annotated[Name, JsonSchema({"enum": names()})] | None = None
    density: Positive | None = None
    membrane: Membrane | None = None
    bending: Bending | None = None
    young: Positive | None = None
    poisson: Poisson | None = None
    thickness: Positive | None = None
    damping: NonNegative = 0.0
    warp_degrees: Number = 0.0
    density_scale: Positive = 1.0
    stretching_scale: Positive = 1.0
    bending_scale: NonNegative = 1.0
    thicken: Positive = 1.0
    rest_curvature: Vector | None = None

    @classmethod
    def complete(cls, data: dict[str, Any]) -> dict[str, Any]:
        """Numbers without ``bending`` mean a membrane: the zero is written out."""
        return {**data, "bending": 0.0} if "membrane" in data and "bending" not in data else data

    @field_validator("cloth")
    @classmethod
    def _in_a_library(cls, cloth: str | None) -> str | None:
        if cloth is not None and cloth not in names():
            raise problem(f"unknown cloth {cloth!r}, {nearest(cloth, names())}")
        return cloth

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        ways = {
            "cloth": self.given("cloth"),
            "membrane": self.given(*_SHEET),
            "young": self.given(*_ISOTROPIC),
        }
        used = {way: keys for way, keys in ways.items() if keys}
        if len(used) != 1:
            found = f"; {' and '.join(keys[0] for keys in used.values())} are given" if used else ""
            raise problem(
                "must be given in exactly one way: cloth, or density + membrane + bending,"
                f" or young + poisson + thickness + density{found}"
            )
        (way,) = used
        if way == "cloth" and self.density is not None:
            raise problem("comes with the cloth; use density_scale", "density")
        needed = {"cloth": (), "membrane": ("density", "membrane"), "young": (*_ISOTROPIC, "density")}[way]
        for key in needed:
            if getattr(self, key) is None:
                raise problem(f"missing (needed beside {used[way][0]})", key)
        return self
