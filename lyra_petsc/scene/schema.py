"""The scene: all keys with units, ranges and defaults.

Attributes have the names of the keys in scene files, except ``start`` for the key ``from``, a keyword of
Python. Units are SI. Blocks are immutable; None means that the key is absent and its term is off.

The docstrings are the text of the reference page and of the JSON Schema.
"""

from __future__ import annotations

import html
import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, get_args

import numpy as np
from pydantic import (
    BeforeValidator,
    Discriminator,
    Field,
    PrivateAttr,
    Tag,
    ValidationInfo,
    field_validator,
    model_validator,
)
from typing_extensions import Self

from lyra_petsc.errors import InputError, suggest
from lyra_petsc.scene.block import Block
from lyra_petsc.scene.fit_block import Fit
from lyra_petsc.scene.materials.library import is_isotropic, isotropic_names, material_names, measured_names
from lyra_petsc.scene.materials.measured_curves import Points, checked_points, read_curve
from lyra_petsc.scene.petsc_block import PETSC_BLOCK, PetscValue, petsc_options
from lyra_petsc.scene.rules import Rule, absent, any_of, exactly_one, given, holds, one_of, when
from lyra_petsc.scene.values import (
    ANY_AXES,
    AXES,
    INDEX,
    VECTOR,
    Angle,
    Axis,
    Bending,
    Count,
    Direction,
    Flag,
    Fraction,
    Index,
    JsonSchema,
    Name,
    NonNegative,
    Number,
    Pair,
    Poisson,
    Positive,
    PositiveScale,
    Scale,
    Seed,
    Share,
    StepLength,
    Text,
    Until,
    UvScale,
    Vec3,
    Vector,
    axes,
    block_of,
    file_beside,
    list_of,
    number,
    path_beside,
    problem,
    shown,
    vector,
)

MESH_SUFFIXES = (".geo", ".msh", ".obj", ".stl", ".ply", ".off", ".vtk", ".inp", ".bdf", ".unv")

_BY_KIND = Discriminator(lambda value: "[block]" if isinstance(value, (dict, Block)) else "[plain]")
"""Discriminator of values that may be a block or plain values; messages omit the tags."""


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
        Translation after the rotation.
    """

    scale: PositiveScale = 1.0
    rotate: Rotation | None = None
    translate: Vector = (0.0, 0.0, 0.0)


class Grid(Block):
    """A rectangular grid of cells in the xy plane, with one corner at the origin.

    Attributes
    ----------
    width, height : float [m]
        Length in x and y.
    nx, ny : int
        Number of cells in x and y.
    pattern : str
        Triangles of the cells: parallel diagonals, alternating diagonals, or four triangles in each cell.
    """

    width: Positive
    height: Positive
    nx: Count
    ny: Count
    pattern: Literal["diagonal", "alternating", "criss-cross"] = "diagonal"


def _file(*endings: str) -> dict[str, Any]:
    """JSON Schema of a file name with one of these endings, in upper or lower case."""
    any_case = ("".join(f"[{letter}{letter.upper()}]" for letter in ending) for ending in endings)
    return {"type": "string", "pattern": rf"\.({'|'.join(any_case)})$"}


MeshPath = Annotated[
    Path, file_beside("mesh file", *MESH_SUFFIXES), JsonSchema(_file(*(end[1:] for end in MESH_SUFFIXES)))
]


class MeshSource(Block):
    """Source of one sheet: a file or a grid.

    Attributes
    ----------
    file : Path or None
        A mesh file (.geo, .msh, .obj, .stl, .ply, .off, .vtk, .inp, .bdf, .unv); the path is relative to the
        scene file.
    grid : Grid or None
        A rectangular grid instead of a file.
    size : float [m] or None
        Element size for a .geo file; replaces the sizes in the script.
    algorithm : str or None
        gmsh's algorithm for the triangles of a .geo file; by default that of the script, or gmsh's default.
    transform : Transform
        Transform from the mesh to the start positions. Its scaling applies to the rest shape, too, unless
        ``vt`` give the rest shape.
    uv : "ignore", or float or (2,) [m]
        Size of one unit of the ``vt`` of an .obj file, or of one unit of each of their axes; 1 if they are in
        metres. With ``ignore`` the mesh itself is the rest shape, as without ``vt``.
    weld : float [m] or None
        Vertices at most so far from each other, in each coordinate, are joined to one.
    name : str or None
        Name of the sheet, and of a surface group with its triangles.
    """

    rules = (
        exactly_one("file", "grid"),
        *(
            Rule(
                when(given(key), given(file=_file("geo"))),
                "is for .geo files only (others come with their elements)",
                key,
            )
            for key in ("size", "algorithm")
        ),
        Rule(when(given("uv"), given(file=_file("obj"))), "is for .obj files only (others have no vt)", "uv"),
    )

    file: MeshPath | None = None
    grid: Grid | None = None
    size: Positive | None = None
    algorithm: Literal["automatic", "mesh-adapt", "delaunay", "frontal-delaunay"] | None = None
    transform: Transform = Field(default_factory=Transform)
    uv: UvScale | None = None
    weld: Positive | None = None
    name: Name | None = None


class MembraneStiffness(Block):
    """Orthotropic St. Venant-Kirchhoff stiffness [N/m]; axis 1 is the warp.

    Attributes
    ----------
    c11, c22 : float [N/m]
        Stiffness along warp and weft.
    c12 : float [N/m]
        Coupling of warp and weft; c12² < c11 c22.
    c33 : float [N/m]
        Shear modulus, for engineering shear strain.
    """

    c11: Positive
    c22: Positive
    c12: Number
    c33: Positive

    @model_validator(mode="after")
    def _check_positive_definite(self) -> Self:
        _check_coupling("c", self.c11, self.c12, self.c22, "N/m")
        return self


def _check_coupling(letter: str, first: float, coupling: float, second: float, unit: str) -> None:
    """Refuse a stiffness that is not positive definite."""
    bound = first**0.5 * second**0.5
    if abs(coupling) >= bound:
        raise problem(
            f"is not positive definite: |{letter}12| = {abs(coupling):g} must be below"
            f" sqrt({letter}11 {letter}22) = {bound:g} {unit}",
            f"{letter}12",
        )


class PlateStiffness(Block):
    """Orthotropic bending stiffness [N·m], moment per width over curvature; axis 1 is the warp.

    Attributes
    ----------
    d11, d22 : float [N·m]
        Stiffness along warp and weft.
    d12 : float [N·m]
        Coupling of warp and weft; d12² < d11 d22.
    d33 : float [N·m]
        Stiffness against twist, for 2 κ12; in an isotropic plate D (1 − ν)/2.
    """

    d11: Positive
    d22: Positive
    d12: Number = 0.0
    d33: Positive

    @model_validator(mode="after")
    def _check_positive_definite(self) -> Self:
        _check_coupling("d", self.d11, self.d12, self.d22, "N·m")
        return self


BendingModel = Literal["hinge", "midedge"]
MembraneLaw = Literal["stvk", "measured", "neo-hookean"]


def _curve(value: Any, info: ValidationInfo) -> Points:
    """A curve from a file or as its points; stored scenes have points, and so do not need the file."""
    try:
        if isinstance(value, str):
            path = path_beside(value, info)
            return checked_points(read_curve(path), str(path))
        if isinstance(value, (list, tuple)) and all(isinstance(p, (list, tuple)) for p in value):
            pairs = [(number(x), number(y)) for x, y in value]
            return checked_points([(f"point {n}", x, y) for n, (x, y) in enumerate(pairs, start=1)])
    except InputError as error:
        raise problem(": ".join(part for part in (error.file, error.message) if part)) from None
    except ValueError:  # a point that is no pair of numbers
        pass
    raise problem(f"must be a file, or points like [[0.01, 5.0], [0.02, 12.0]], not {shown(value)}")


_CURVE = {
    "anyOf": [
        {"type": "string"},
        {
            "type": "array",
            "items": {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2},
            "minItems": 1,
        },
    ]
}
Curve = Annotated[Points, BeforeValidator(_curve), JsonSchema(_CURVE)]


KES_CURVATURE, KES_ANGLE = 2.5, 8.0
"""Largest curvature [1/cm] of KES-F 2, and largest shear angle [°] of KES-F 1."""

KES_RANGES = {"B": ((1e-4, 50.0), "gf·cm²/cm"), "G": ((1e-3, 100.0), "gf/(cm·degree)")}
"""Ranges wider than those of fabrics: numbers outside are in other units."""


class KesReport(Block):
    """Numbers of a KES-F report in its units, which replace those of the material.

    Each is one number, or two for warp and weft. Numbers that no fabric has are refused, as they are in other
    units.

    Attributes
    ----------
    B : float or (2,) [gf·cm²/cm]
        Bending stiffness.
    width_of_bending : float or (2,) [gf·cm/cm]
        Width of the hysteresis loop in bending, twice ``friction_moment``.
    G : float or (2,) [gf/(cm·degree)]
        Shear stiffness; of two numbers the mean is used.
    width_of_shear : float or (2,) [gf/cm]
        Width of the hysteresis loop in shear, twice ``friction_force``; of two numbers the mean is used.
    """

    B: Pair | None = None
    width_of_bending: Pair | None = Field(default=None, alias="2HB")
    G: Pair | None = None
    width_of_shear: Pair | None = Field(default=None, alias="2HG")

    @model_validator(mode="after")
    def _check_ranges(self) -> Self:
        for name, stiffness, loop, width, farthest in (
            ("B", self.B, "2HB", self.width_of_bending, KES_CURVATURE),
            ("G", self.G, "2HG", self.width_of_shear, KES_ANGLE),
        ):
            (low, high), unit = KES_RANGES[name]
            for value in stiffness or ():
                if not value > 0.0:
                    raise problem(f"must be > 0, not {shown(value)}", name)
                if not low <= value <= high:
                    raise problem(f"must be {low:g} to {high:g} {unit} as of fabrics, not {value:g}", name)
            for value, half in zip(width or (), stiffness or (), strict=False):
                if value > 2.0 * farthest * half:
                    raise problem(
                        f"must be at most {2.0 * farthest:g} {name} = {2.0 * farthest * half:g}, "
                        f"not {value:g}: no test goes far enough to see a wider loop",
                        loop,
                    )
        return self


class LawCurves(Block):
    """Measured curves of force [N/m], per width at rest, over strain.

    Each curve is a list of points, or a file of two columns, separated by commas, semicolons or blanks, with
    its path relative to the scene file. Strains are fractions, and both columns increase. A curve begins at
    (0, 0) and is linear beyond its last point; those of warp and weft are linear under compression. The three
    curves are not coupled.

    Attributes
    ----------
    warp, weft : curve of strain and N/m
        Strain and force of strips pulled along warp and weft.
    shear : curve of shear strain and N/m
        Tangent of the shear angle between warp and weft, and shear force.
    """

    warp: Curve
    weft: Curve
    shear: Curve


_AnyLaw = Annotated[Annotated[MembraneLaw, Tag("[plain]")] | Annotated[LawCurves, Tag("[block]")], _BY_KIND]
_BY_CURVES = given(law={"type": "object"})
_AnyBending = Annotated[
    Annotated[Bending, Tag("[plain]")] | Annotated[PlateStiffness, Tag("[block]")], _BY_KIND
]

# the alternatives for the numbers of a material: the keys of each, and the required ones
_ALTERNATIVES = (
    (("cloth",), ()),
    (("membrane", "bending"), ("membrane", "density")),
    (("young", "poisson", "thickness"), ("young", "poisson", "thickness", "density")),
)


def _not_one_alternative(material: Material) -> str:
    used = [given[0] for given in (material.given(*keys) for keys, _ in _ALTERNATIVES) if given]
    found = f"; {' and '.join(used)} are given" if used else ""
    return (
        "must be given in exactly one way: cloth, or density + membrane + bending,"
        f" or young + poisson + thickness + density{found}"
    )


def _required(keys: tuple[str, ...], key: str) -> Rule:
    """Rule that ``key`` is given if any of the ``keys`` of its alternative is."""
    used = any_of(*keys) if key != "membrane" else {"allOf": [any_of(*keys), {"not": _BY_CURVES}]}
    return Rule(when(used, given(key)), lambda m: f"missing (needed beside {m.given(*keys)[0]})", key)


_NO_SHEAR = 1.0
"""Placeholder for c33 in a membrane with G of a KES report, which replaces it."""

_FRICTION = {
    "anyOf": [
        {"type": "number", "exclusiveMinimum": 0},
        {"type": "array", "not": {"items": {"enum": [0]}}},
    ]
}
_HAS_FRICTION = {
    "anyOf": [
        given(friction_moment=_FRICTION),
        given(kes={"type": "object", **given(**{"2HB": _FRICTION})}),
    ]
}


class Material(Block):
    """One material, from the library or by its numbers.

    Exactly one of three alternatives is given: ``cloth``; ``density`` + ``membrane`` (+ ``bending``);
    ``young`` + ``poisson`` + ``thickness`` + ``density``.

    Attributes
    ----------
    group : str or None
        Surface group of this material; without it all triangles in no other material's group.
    cloth : str or None
        Name of a measured cloth or an engineering material in the library.
    density : float [kg/m²] or None
        Areal density.
    membrane : MembraneStiffness or None
        Stretching stiffness.
    bending : float or (3,) or PlateStiffness [N·m] or None
        Cylindrical bending stiffness B; three values are for hinges whose edge is at 0°, 45°, 90° to the
        warp, and ``midedge`` takes them as d11, d33 + (d11 + d22)/4 and d22. Or a block for an orthotropic
        plate.
    bending_model : str or None
        ``hinge``: angles between neighbouring triangles; fast, but the stiffness of plates depends on the
        mesh. ``midedge``: an additional unknown on every edge; converges on any mesh. The default is
        ``midedge`` for isotropic materials (young, poisson and thickness, or such a material of the library),
        for an orthotropic plate and with friction_moment, else ``hinge``.
    law : str or LawCurves
        Membrane law. ``stvk``: constant stiffness (softens under compression); ``measured``: stiffness
        measured over strain, for cloths of the library; ``neo-hookean``: rubber, for isotropic materials. All
        have the same stiffness at rest. Or a block of measured curves, instead of ``membrane``.
    young : float [Pa] or None
        Young's modulus of an isotropic shell.
    poisson : float or None
        Poisson's ratio of an isotropic shell.
    thickness : float [m] or None
        Thickness of an isotropic shell.
    damping : float [s]
        γ of stiffness-proportional damping.
    warp_degrees : float [°]
        Anticlockwise rotation of the warp in the material plane.
    density_scale, stretching_scale, bending_scale : float
        Factors on density, membrane and bending.
    thicken : float
        Factor t on the thickness: density × t, membrane × t, bending × t³.
    rest_curvature : (3,) [1/m] or None
        Curvature κ11, κ22, κ12 at rest, in the material axes.
    friction_moment : float or (2,) [N m/m]
        Moment per width of internal friction against bending, for warp and weft; causes hysteresis and
        remaining folds. Half of 2HB of a KES report. Scaled as bending; needs ``midedge``.
    friction_force : float [N/m]
        Force per width of internal friction against shear, half of 2HG. Scaled as membrane.
    kes : KesReport or None
        Numbers of a KES report, instead of bending, c33, friction_moment and friction_force.
    """

    rules = (
        Rule({"oneOf": [any_of(*keys) for keys, _ in _ALTERNATIVES]}, _not_one_alternative),
        Rule(when(given("cloth"), absent("density")), "comes with the cloth; use density_scale", "density"),
        *(_required(keys, key) for keys, required in _ALTERNATIVES for key in required),
        Rule(
            when(_BY_CURVES, absent("membrane", "young")),
            "curves take the place of membrane; give them beside a cloth, or density and bending",
            "law",
        ),
        Rule(
            when(given(bending={"type": "object"}), given(bending_model={"const": "midedge"})),
            "d11, d22, d12, d33 are for bending_model: midedge; hinges take one number, or three",
            "bending",
        ),
        Rule(
            when(_HAS_FRICTION, given(bending_model={"const": "midedge"})),
            "friction_moment (2HB of kes) is for bending_model: midedge; with hinges it depends on the mesh",
            "bending_model",
        ),
        Rule(
            when(given(law={"const": "measured"}), given(cloth={"enum": measured_names()})),
            lambda m: (
                f"measured is for measured cloths: {', '.join(measured_names())}"
                f"{'' if m.cloth is None else f'; {m.cloth} is none of them, leave law out'}"
            ),
            "law",
        ),
        Rule(
            when(
                given(law={"const": "neo-hookean"}),
                {"anyOf": [given("young"), given(cloth={"enum": isotropic_names()})]},
            ),
            "neo-hookean is for isotropic sheets: give young, poisson, thickness and density, "
            "or leave law out",
            "law",
        ),
        *(
            Rule(
                {"not": given(kes=given(name), **{key: {"not": {"enum": [None, 0]}}})},
                f"kes has {name}, which takes its place; leave one of them out",
                key,
            )
            for name, key in (("B", "bending"), ("2HB", "friction_moment"), ("2HG", "friction_force"))
        ),
        *(
            Rule(
                {"not": given("young", kes=given(name))},
                f"has {name}, which young, poisson and thickness give, too; leave one of them out",
                "kes",
            )
            for name in ("B", "G")
        ),
        *(
            Rule(
                {"not": given(kes=given("G"), **condition)},
                f"kes has G, which takes the place of {what}; leave one of them out",
                at,
            )
            for condition, what, at in (
                ({"membrane": given(c33={"not": {"const": _NO_SHEAR}})}, "c33", "membrane.c33"),
                ({"law": {"type": "object"}}, "the curve of shear", "law"),
                ({"law": {"const": "neo-hookean"}}, "the shear modulus of neo-hookean", "law"),
            )
        ),
    )
    conditional_defaults = frozenset({"bending_model"})

    group: Name | None = None
    cloth: Annotated[Name, JsonSchema({"enum": material_names()})] | None = None
    density: Positive | None = None
    membrane: MembraneStiffness | None = None
    bending: _AnyBending | None = None
    bending_model: BendingModel | None = None
    law: _AnyLaw = "stvk"
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
    friction_moment: Pair | None = None
    friction_force: NonNegative | None = None
    kes: KesReport | None = None

    @classmethod
    def with_defaults(cls, data: dict[str, Any]) -> dict[str, Any]:
        """Defaults of ``bending`` (0), ``bending_model``, and of c33 if G of ``kes`` replaces it."""
        by_curves = isinstance(data.get("law"), (dict, LawCurves)) and not {"cloth", "young"} & data.keys()
        if "membrane" in data or by_curves:
            data = {"bending": 0.0, **data}
        membrane, kes = data.get("membrane"), data.get("kes")
        if isinstance(membrane, dict) and isinstance(kes, dict) and kes.get("G") is not None:
            data["membrane"] = {"c33": _NO_SHEAR, **membrane}
        isotropic = "young" in data or is_isotropic(data.get("cloth"))
        plate = isinstance(data.get("bending"), (dict, PlateStiffness))
        friction = holds(_HAS_FRICTION, data)
        return {"bending_model": "midedge" if isotropic or plate or friction else "hinge", **data}

    @field_validator("cloth")
    @classmethod
    def _check_cloth(cls, cloth: str | None) -> str | None:
        if cloth is not None and cloth not in material_names():
            raise problem(f"unknown cloth {cloth!r}, {suggest(cloth, material_names())}")
        return cloth


_ALL_AXES = {
    "anyOf": [
        {"type": "null"},
        {"allOf": [{"not": {"items": {"not": {"const": axis}}}} for axis in AXES]},
    ]
}


MAX_SPEED = 1e8
"""Largest speed [m/s] in a scene; squares of much larger ones overflow."""

_SPEEDS = {"items": {"minimum": -MAX_SPEED, "maximum": MAX_SPEED}}
_NOT_TOO_FAST = Rule(
    when(given("velocity"), {"properties": {"velocity": _SPEEDS}}),
    f"must not be faster than {MAX_SPEED:g} m/s",
    "velocity",
)


class UniformWind(Block):
    """Uniform wind.

    Attributes
    ----------
    velocity : (3,) [m/s]
        Velocity of the air; zero is still air.
    density : float [kg/m³]
        Density of the air.
    drag : float [kg/(m² s)]
        Tangential drag coefficient.
    """

    rules = (_NOT_TOO_FAST,)

    velocity: Vector
    density: NonNegative
    drag: NonNegative = 0.0


_NODES = {"type": "array", "items": INDEX.schema, "minItems": 1, "uniqueItems": True}
_BOX = {"type": "array", "items": VECTOR, "minItems": 2, "maxItems": 2}


class VertexChoice(Block):
    """Vertices by group, nodes or box.

    Attributes
    ----------
    group : str or None
        A group of the mesh, or the name of a sheet.
    nodes : list of int or None
        Numbers of vertices from 0, in file order.
    box : two (3,) [m] or None
        Lower and upper corner of a box; it selects by start positions and includes its faces.
    """

    group: Name | None = None
    nodes: Annotated[list[Index], list_of(" of vertex numbers", minimum=1), JsonSchema(_NODES)] | None = None
    box: Annotated[tuple[Vec3, Vec3], JsonSchema(_BOX)] | None = None

    @field_validator("nodes")
    @classmethod
    def _check_unique(cls, nodes: list[int] | None) -> list[int] | None:
        if nodes is not None and len(set(nodes)) != len(nodes):
            twice = Counter(nodes).most_common(1)[0][0]
            raise problem(f"lists vertex {twice} twice")
        return nodes

    @field_validator("box", mode="before")
    @classmethod
    def _check_box(cls, value: Any) -> Any:
        if not isinstance(value, (list, tuple)) or len(value) != 2:
            raise problem(f"must be two corners [[x, y, z], [x, y, z]], not {shown(value)}")
        low, high = vector(value[0]), vector(value[1])
        if any(a > b for a, b in zip(low, high, strict=True)):
            raise problem("must have its lower corner first")
        return low, high


class Selector(VertexChoice):
    """Vertices by exactly one of group, nodes, box."""

    rules: ClassVar[tuple[Rule, ...]] = (exactly_one("group", "nodes", "box"),)


def _window_ends_later(block: Any) -> Any:
    if not block.start < block.until:
        raise problem(f"must be later than from = {block.start:g}, not {block.until:g}", "until")
    return block


Interpolation = Literal["monotone", "hermite", "linear"]


class Handle(Selector):
    """Vertices whose motion is prescribed, or which springs pull.

    Attributes
    ----------
    axes : tuple of "x", "y", "z"
        Directions in which the vertices are held.
    clamp : bool
        Keep the slope of held boundary edges, too. If only part of the ``axes`` is held, the edges slide
        along the others in the plane of the sheet; needs ``midedge``.
    symmetry : "x", "y" or "z", or None
        The vertices are in a symmetry plane normal to this axis: they stay in the plane, and the sheet stays
        normal to it. At the start it may be off by 10° and half the angle to the next triangle. Replaces
        ``axes``; needs ``midedge``.
    motion : str or None
        Name in ``motions``; without it the vertices keep their positions.
    interpolation : str
        Interpolation of the motion between keyframes. ``monotone``: smooth, and never beyond two neighbouring
        keyframes; ``hermite``: smooth, as the original Lyra's, but swings beyond keyframes before a hold;
        ``linear``.
    start, until : float [s]
        The handle acts for from ≤ t ≤ until; by default always.
    fade : float [s]
        After ``until`` the handle fades by the factor (1 − (t − until)/fade)⁴.
    stiffness : float [N/m] or None
        Stiffness for each vertex and axis of springs that replace the constraint.
    """

    rules = (
        *Selector.rules,
        Rule(
            when(
                given(clamp={"const": True}),
                {"anyOf": [{"properties": {"axes": _ALL_AXES}}, absent("stiffness")]},
            ),
            "keeps no slope of an edge that springs hold along some axes; hold all axes, or leave clamp out",
            "clamp",
        ),
        Rule(
            when(
                given("symmetry"),
                {
                    "properties": {
                        "axes": _ALL_AXES,
                        "clamp": {"const": False},
                        "from": {"maximum": 0},
                        "fade": {"maximum": 0},
                        "motion": {"type": "null"},
                        "stiffness": {"type": "null"},
                    }
                },
            ),
            "is a plane that stands still and mirrors the sheet; leave out axes, clamp, motion, stiffness, "
            "from and fade",
            "symmetry",
        ),
    )

    axes: Annotated[tuple[Direction, ...], JsonSchema(ANY_AXES)] = AXES
    clamp: Flag = False
    symmetry: Direction | None = None
    motion: Name | None = None
    interpolation: Interpolation = "monotone"
    start: Number = Field(default=0.0, alias="from")
    until: Until = math.inf
    fade: NonNegative = 0.0
    stiffness: Positive | None = None

    @property
    def axis_numbers(self) -> tuple[int, ...]:
        """Directions in which the vertices are held, as 0, 1, 2, ascending."""
        return tuple(AXES.index(axis) for axis in (self.symmetry or self.axes))

    @property
    def holds_slope(self) -> bool:
        """Whether the handle holds the directors of its edges, which ``midedge`` has."""
        return self.clamp or self.symmetry is not None

    @field_validator("axes", mode="before")
    @classmethod
    def _sort_axes(cls, value: Any) -> Any:
        chosen = axes(value)
        return tuple(axis for axis in AXES if axis in chosen)

    _check_window = model_validator(mode="after")(_window_ends_later)


class Keyframe(Block):
    """Scaling, rotation and translation of the vertices, or of an obstacle, from their start to one time.

    Attributes
    ----------
    time : float [s]
        Time, later than that of the keyframe before.
    scale : float or (3,)
        Factor about the origin, or one for each axis; not 0.
    rotate : Rotation or None
        Rotation after the scaling.
    translate : (3,) [m]
        Translation after the rotation.
    velocity : (3,) [m/s] or None
        Velocity of the translation; by default from central differences, and zero at the first and last
        keyframe.
    """

    rules = (_NOT_TOO_FAST,)

    time: Number
    scale: Scale = 1.0
    rotate: Rotation | None = None
    translate: Vector = (0.0, 0.0, 0.0)
    velocity: Vector | None = None


Keyframes = Annotated[list[Keyframe], list_of(), Field(json_schema_extra={"minItems": 1})]


class Friction(Block):
    """Coulomb friction with different static and kinetic coefficients.

    Attributes
    ----------
    static : float
        Coefficient of static friction.
    kinetic : float
        Coefficient of kinetic friction, at most the static one.
    """

    static: NonNegative
    kinetic: NonNegative

    @model_validator(mode="after")
    def _check_coefficients(self) -> Self:
        if self.kinetic > self.static:
            raise problem(f"must be at most static = {self.static:g}, not {self.kinetic:g}", "kinetic")
        return self


_AnyFriction = Annotated[
    Annotated[NonNegative, Tag("[plain]")] | Annotated[Friction, Tag("[block]")], _BY_KIND
]


def coefficients(friction: float | Friction) -> tuple[float, float]:
    """Static and kinetic coefficient of friction."""
    if isinstance(friction, Friction):
        return friction.static, friction.kinetic
    return friction, friction


class Contact(Block):
    """Contact of sheets with themselves, each other and obstacles; without this key there is none.

    Attributes
    ----------
    gap : float [m] or None
        Distance of surfaces below which contact forces act; by default the least of a quarter of the mean
        edge, half of the short edges, and 0.7 times the small heights of triangles, without the worst
        twentieth. At vertices of triangles with shorter edges or heights it is less, with a note.
    thickness : float [m]
        Distance of mid-surfaces at which surfaces touch.
    self : bool
        Contact of sheets with themselves and other sheets, too; else with obstacles only.
    friction : float or Friction
        Coulomb's friction coefficient, or a block of two coefficients.
    """

    gap: Positive | None = None
    thickness: NonNegative = 0.0
    self: Flag = True
    friction: _AnyFriction = 0.0


class Plane(Block):
    """An unbounded plane.

    Attributes
    ----------
    point : (3,) [m]
        A point of the plane.
    normal : (3,)
        Normal towards the free side; not zero, need not be a unit vector.
    """

    point: Vector
    normal: Axis


class Sphere(Block):
    """A sphere.

    Attributes
    ----------
    center : (3,) [m]
        Centre.
    radius : float [m]
        Radius of the sphere.
    """

    center: Vector
    radius: Positive


class Capsule(Block):
    """A cylinder with hemispheres at its ends.

    Attributes
    ----------
    start, to : (3,) [m]
        Ends of the axis: the centres of the hemispheres.
    radius : float [m]
        Radius of cylinder and hemispheres.
    """

    start: Vector = Field(alias="from")
    to: Vector
    radius: Positive

    @model_validator(mode="after")
    def _check_axis(self) -> Self:
        if self.start == self.to:
            raise problem("must be another point than from; for a ball give sphere", "to")
        return self


class Cuboid(Block):
    """A box with edges along x, y and z at t = 0.

    Attributes
    ----------
    min, max : (3,) [m]
        Lower and upper corner.
    """

    min: Vector
    max: Vector

    @model_validator(mode="after")
    def _check_corners(self) -> Self:
        for axis, low, high in zip(AXES, self.min, self.max, strict=True):
            if low >= high:
                raise problem(f"must be above min in {axis}: {high:g} is not above {low:g}", "max")
        return self


class ObstacleMesh(Block):
    """A triangle mesh, closed or open, with contact on both sides.

    Attributes
    ----------
    file : Path
        A mesh file (.geo, .msh, .obj, .stl, .ply, .off, .vtk, .inp, .bdf, .unv); the path is relative to the
        scene file.
    transform : Transform
        Transform from the mesh to the position at t = 0.
    """

    file: MeshPath
    transform: Transform = Field(default_factory=Transform)


SHAPES = ("plane", "sphere", "capsule", "box", "mesh")
"""Keys for the shapes of obstacles."""


class Obstacle(Block):
    """A rigid obstacle of one shape, which sheets cannot penetrate.

    Attributes
    ----------
    plane : Plane or None
        A plane, free on the side of its normal.
    sphere : Sphere or None
        A sphere.
    capsule : Capsule or None
        A cylinder with hemispheres at its ends.
    box : Cuboid or None
        A box, at t = 0 along x, y and z.
    mesh : ObstacleMesh or None
        A triangle mesh.
    inside : bool
        Whether sheets are inside of the sphere, capsule or box instead of outside.
    motion : str or list of Keyframe or None
        Name in ``motions``, or keyframes, without ``scale``; by default the obstacle is at rest.
    interpolation : str
        Interpolation of the motion between keyframes. ``monotone``: smooth, and never beyond two neighbouring
        keyframes; ``hermite``: smooth, as the original Lyra's, but swings beyond keyframes before a hold;
        ``linear``.
    friction : float or Friction or None
        Friction coefficient, instead of that of ``contact``.
    """

    rules = (
        exactly_one(*SHAPES),
        Rule(
            when(given(inside={"const": True}), any_of("sphere", "capsule", "box")),
            "is for sphere, capsule and box; a plane is free on the side of its normal, and a mesh on both",
            "inside",
        ),
    )

    plane: Plane | None = None
    sphere: Sphere | None = None
    capsule: Capsule | None = None
    box: Cuboid | None = None
    mesh: ObstacleMesh | None = None
    inside: Flag = False
    motion: (
        Annotated[
            Annotated[Name, Tag("[plain]")] | Annotated[Keyframes, Tag("[list]")],
            Discriminator(lambda value: "[list]" if isinstance(value, (dict, list, tuple)) else "[plain]"),
        ]
        | None
    ) = None
    interpolation: Interpolation = "monotone"
    friction: _AnyFriction | None = None

    @property
    def shape(self) -> str:
        """The key of `SHAPES` that is given."""
        return self.given(*SHAPES)[0]


class AppliedLoad(VertexChoice):
    """A force, a pressure, a traction or a moment.

    Attributes
    ----------
    group : str or None
        A group of the mesh, or the name of a sheet. For pressure and traction a surface group, by default all
        triangles; for a moment a group of boundary edges.
    force : (3,) [N] or None
        Total force, shared by the selected vertices.
    pressure : float [Pa] or None
        Pressure along the current normal.
    traction : (3,) [N/m²] or None
        Force per rest area, of fixed direction.
    moment : float [N·m/m] or None
        Moment per rest length about the current direction of the boundary edges; a positive one lifts their
        free side towards the normal of the sheet. Needs ``midedge``.
    start, until : float [s]
        The load acts for from ≤ t ≤ until; by default always.
    """

    rules = (
        exactly_one("force", "pressure", "traction", "moment"),
        Rule(
            when(given("force"), one_of("group", "nodes", "box")),
            "needs exactly one of group, nodes, box to act on",
            "force",
        ),
        *(
            Rule(when(given(kind), absent(key)), f"cannot select triangles for {kind}; use group", key)
            for kind in ("pressure", "traction")
            for key in ("box", "nodes")
        ),
        Rule(when(given("moment"), given("group")), "needs a group of boundary edges to act on", "moment"),
    )

    force: Vector | None = None
    pressure: Number | None = None
    traction: Vector | None = None
    moment: Number | None = None
    start: Number = Field(default=0.0, alias="from")
    until: Until = math.inf

    _check_window = model_validator(mode="after")(_window_ends_later)


class Initial(Block):
    """Initial velocities, and noise on the start positions.

    Attributes
    ----------
    velocity : (3,) [m/s]
        Velocity of all vertices.
    angular_velocity : (3,) [rad/s]
        Angular velocity about the centre of mass.
    noise : float [m]
        Standard deviation of a normally distributed displacement, along the initial vertex normal, of each
        vertex that no handle holds.
    seed : int
        Seed of the random numbers for the noise.
    """

    rules = (_NOT_TOO_FAST,)

    velocity: Vector = (0.0, 0.0, 0.0)
    angular_velocity: Vector = (0.0, 0.0, 0.0)
    noise: NonNegative = 0.0
    seed: Seed = 0


Analysis = Literal["dynamic", "static"]
Integrator = Literal["beuler", "semi-implicit", "midpoint", "alpha2", "bdf2"]
INTEGRATORS: tuple[str, ...] = get_args(Integrator)
TOLERANCE = 1e-3
SPECTRAL_RADIUS = 0.5
LOAD_STEP = 0.25
FIELD_UNITS = {
    "velocity": "m/s",
    "displacement": "m",
    "green_strain": "1",
    "stress": "N/m",
    "membrane_energy": "J/m²",
    "bending_energy": "J/m²",
    "curvature": "1/m",
    "curvature_tensor": "1/m",
    "contact_pressure": "Pa",
    "rank": "1",
}
FIELDS = tuple(FIELD_UNITS)


_FIELDS = {"type": "array", "items": {"enum": list(FIELDS)}}


_STATIC = given(analysis={"const": "static"})
_MEANINGLESS = "has no meaning in a static analysis; leave it out"


class Time(Block):
    """Time stepping, or load steps of a static analysis.

    Attributes
    ----------
    analysis : str
        ``dynamic``: motion in time; ``static``: equilibrium under loads that are multiplied by a load factor,
        which goes from 0 to 1 and replaces time.
    end : float [s]
        Time at which the run ends; 1 in a static analysis.
    step : float [s] or "auto"
        Nominal and largest Δt; ``auto``: adaptive steps. In a static analysis the first increment of the load
        factor.
    tolerance : float or None
        Tolerance of adaptive steps: accumulated time integration error of the positions at the end, over the
        diagonal of the bounding box of the rest shape.
    integrator : str or None
        ``beuler`` (first order, full Newton), ``semi-implicit`` (one linear solve a step), ``midpoint``,
        ``alpha2`` (generalised-α), ``bdf2`` (second order). The default is ``beuler``; a static analysis has
        none.
    spectral_radius : float or None
        Spectral radius of ``alpha2`` at high frequencies: 0 damps them within a step, 1 not at all.
    """

    rules = (
        *(
            Rule(when(_STATIC, absent(key)), _MEANINGLESS, key)
            for key in ("integrator", "tolerance", "spectral_radius")
        ),
        Rule(
            when(_STATIC, {"properties": {"end": {"enum": [1, None]}}}),
            "is 1 in a static analysis (the full load); leave it out",
            "end",
        ),
        Rule(
            when(_STATIC, {"properties": {"step": {"type": ["number", "null"], "maximum": 1}}}),
            "is the first increment of the load factor, at most 1, not {step!r}",
            "step",
        ),
        Rule({"anyOf": [_STATIC, given("end", "step")]}, "needs end and step"),
        Rule(
            when(given("tolerance"), given(step={"const": "auto"})),
            "is for step: auto; with a fixed step leave it out",
            "tolerance",
        ),
        Rule(
            {"properties": {"tolerance": {"minimum": 1e-12}}},
            "is at least 1e-12, not {tolerance:g}: double precision reaches no less",
            "tolerance",
        ),
        Rule(
            {"properties": {"tolerance": {"exclusiveMaximum": 1}}},
            "is a fraction of the sheet's size, below 1, not {tolerance:g}",
            "tolerance",
        ),
        Rule(
            when(given("spectral_radius"), given(integrator={"const": "alpha2"})),
            "is for integrator: alpha2; {integrator} has none, leave it out",
            "spectral_radius",
        ),
    )
    conditional_defaults = frozenset({"end", "step"})

    analysis: Analysis = "dynamic"
    end: Positive
    step: StepLength
    tolerance: Positive | None = None
    integrator: Integrator | None = None
    spectral_radius: Fraction | None = None

    @property
    def scheme(self) -> str:
        """Name of the time scheme: the integrator, or ``static``."""
        return self.integrator or "static"

    @property
    def static(self) -> bool:
        """Whether an equilibrium is sought: time is the load factor then."""
        return self.analysis == "static"

    @property
    def adaptive(self) -> bool:
        """Whether the step length follows a tolerance."""
        return self.step == "auto"

    @classmethod
    def with_defaults(cls, data: dict[str, Any]) -> dict[str, Any]:
        """Defaults that depend on the analysis and on the integrator."""
        if data.get("integrator") == "static":
            raise problem("static is no integrator; write analysis: static instead", "integrator")
        if data.get("analysis") == "static":
            return {"end": 1.0, "step": LOAD_STEP, **data}
        data = {"integrator": "beuler", **data}
        if data.get("step") == "auto":
            data.setdefault("tolerance", TOLERANCE)
        if data["integrator"] == "alpha2":
            data.setdefault("spectral_radius", SPECTRAL_RADIUS)
        return data


class CheckpointInterval(Block):
    """Largest interval between checkpoints.

    Attributes
    ----------
    seconds : float [s]
        Wall time.
    steps : int or None
        Number of accepted steps; by default wall time alone counts.
    """

    seconds: Positive = 60.0
    steps: Count | None = None


class Output(Block):
    """Files of a run.

    Attributes
    ----------
    every : float [s] or None
        Simulated time between states; empty: a state after every step.
    fields : list of str
        Fields in the states besides the positions.
    checkpoint : CheckpointInterval
        Largest interval between checkpoints.
    reactions : bool
        Write the forces [N] at the handles to reactions.csv; with ``midedge`` also the moments [N·m] of
        handles with ``clamp`` or ``symmetry``, about their mean positions.
    vtkhdf : bool
        Write an index of the states for ParaView to states.vtkhdf, too, which recent versions read faster
        than the XDMF file.
    """

    null_is_a_value: ClassVar[frozenset[str]] = frozenset({"every"})

    every: Positive | None = 0.04
    fields: Annotated[list[str], JsonSchema(_FIELDS)] = Field(default_factory=list)
    checkpoint: CheckpointInterval = Field(default_factory=CheckpointInterval)
    reactions: Flag = False
    vtkhdf: Flag = False

    @field_validator("fields", mode="before")
    @classmethod
    def _check_fields(cls, value: Any) -> Any:
        if not isinstance(value, (list, tuple)):
            raise problem(f"must be a list, not {shown(value)}; known: {', '.join(FIELDS)}")
        for name in value:
            if name not in FIELDS:
                word = name if isinstance(name, str) else shown(name)
                raise problem(f"unknown field {word!r}, {suggest(word, FIELDS)}")
        return list(dict.fromkeys(value))


class Solver(Block):
    """Convergence of Newton's method, and its Hessian.

    Attributes
    ----------
    force_tolerance : float
        Tolerance on the norm of the force residual, relative to its largest part (internal forces, inertia,
        loads, …).
    step_tolerance : float
        Tolerance on the estimated remaining correction of a coordinate, relative to the element size.
    max_iterations : int
        Largest number of Newton iterations in a step.
    hessian : str
        ``exact``, ``regularised`` (positive definite), or ``adaptive``: a blend, as close to the exact one as
        possible.
    """

    force_tolerance: Positive = 1e-6
    step_tolerance: Positive = 1e-6
    max_iterations: Count = 50
    hessian: Literal["adaptive", "regularised", "exact"] = "adaptive"


PARALLEL = 1e-6
"""Sine of the angle between two directions below which they count as one."""


class Camera(Block):
    """Camera of the pictures; keys left out are computed from the whole motion.

    Attributes
    ----------
    direction : (3,) or None
        Direction from the sheet towards the camera, whose distance is fitted to the whole motion.
    position : (3,) [m] or None
        Position of the camera, instead of a direction; needs a target.
    target : (3,) [m] or None
        Point at which the camera looks.
    up : (3,) or None
        Direction upwards in the picture; by default against gravity, else z.
    angle : float [degrees]
        Vertical angle of view, from 1 to 120.
    zoom : float
        Magnification relative to the fitted distance.
    frame : float [percent]
        Percentage of the states that the fitted distance shows completely, from 50 to 100; by default 95.
    """

    rules = (
        *(
            Rule(
                when(given(here), given(other)),
                f"needs {other} beside it; to have the distance fitted give direction",
                here,
            )
            for here, other in (("position", "target"), ("target", "position"))
        ),
        *(
            Rule(
                when(given("position"), absent(key)),
                "has no meaning beside position and target; leave it out",
                key,
            )
            for key in ("direction", "zoom", "frame")
        ),
    )

    direction: Axis | None = None
    position: Vector | None = None
    target: Vector | None = None
    up: Axis | None = None
    angle: Angle = 25.0
    zoom: Positive | None = None
    frame: Share | None = None

    @model_validator(mode="after")
    def _check_directions(self) -> Self:
        if self.position is not None and self.position == self.target:
            raise problem("is where the camera stands; it must look at another point", "target")
        view = self.line_of_sight
        if view is not None and self.up is not None and parallel(view, self.up):
            raise problem("must not point along the line of sight", "up")
        return self

    @property
    def line_of_sight(self) -> Vec3 | None:
        """Direction from the target to the camera, of any length; None if the scene does not give it."""
        if self.position is None or self.target is None:
            return self.direction
        x, y, z = (a - b for a, b in zip(self.position, self.target, strict=True))
        return x, y, z


def parallel(a: Vec3, b: Vec3) -> bool:
    """Whether two directions are the same or opposite."""
    first, second = (np.asarray(v) / np.abs(v).max() for v in (a, b))
    sine = np.linalg.norm(np.cross(first, second)) / (np.linalg.norm(first) * np.linalg.norm(second))
    return bool(sine < PARALLEL)


class Render(Block):
    """Settings of the command ``render``.

    Attributes
    ----------
    camera : Camera or None
        Camera of the pictures; by default one that sees most of the sheet.
    """

    camera: Camera | None = None


SMALLEST_STEP = 2.0**-52
"""Smallest step over the end time: the time, a 64-bit float, does not change by smaller ones."""


def _too_small(step: float, end: float) -> str:
    return (
        f"is too small, {step:g}: times near {end:g} s are resolved to {end * SMALLEST_STEP:.2g} s only; "
        "take a longer one or an earlier time.end"
    )


def _one_or_many(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        if not value:
            raise problem("must hold at least one entry")
        return list(value)
    return [value]


class Scene(Block):
    """All input of a run.

    Attributes
    ----------
    title : str
        One line for summaries and pages.
    mesh : list of MeshSource
        Source of a sheet, or a list of sources; their vertices are numbered consecutively.
    material : list of Material
        One material, or a list. At most one has no group; it applies to the triangles in no other's group.
    gravity : (3,) [m/s²] or None
        Acceleration of gravity; without this key there is none.
    wind : UniformWind or None
        Uniform wind; without this key there is no air.
    handles : list of Handle
        Vertices whose motion is prescribed, or which springs pull.
    motions : dict of list of Keyframe
        Motions of handles and obstacles, by name; times are strictly ascending.
    contact : Contact or None
        Contact; without this key surfaces penetrate each other.
    obstacles : dict of Obstacle or None
        Rigid obstacles, by name.
    loads : list of AppliedLoad
        Forces, pressures, tractions and moments.
    initial : Initial or None
        Initial velocities and noise; without this key the scene starts at rest.
    time : Time
        Time stepping, or load steps of a static analysis.
    output : Output
        Files of the run.
    probes : dict of Selector
        Vertices whose mean position is written to probes.csv at every step, by name.
    solver : Solver
        Convergence of Newton's method, and its Hessian.
    render : Render or None
        Settings of the command ``render``; a run ignores them.
    fit : Fit or None
        Parameters and measurements for the command ``fit``; a run ignores them.
    petsc : dict
        PETSc options without the leading dash; an empty value is an option without value.
    """

    # a static analysis starts at rest
    rules = tuple(
        Rule(
            when(
                given(time=_STATIC, initial={"type": "object"}),
                {"properties": {"initial": {"properties": {key: {"items": {"const": 0}}}}}},
            ),
            _MEANINGLESS,
            f"initial.{key}",
        )
        for key in ("velocity", "angular_velocity")
    ) + (
        Rule(
            when(given("obstacles"), given("contact")),
            # a function, as the braces in a template would mean a key
            lambda _: "have no effect without contact; add the line 'contact: {friction: 0.3}'",
            "obstacles",
        ),
    )

    title: Text = ""
    mesh: Annotated[list[MeshSource], BeforeValidator(_one_or_many)]
    material: Annotated[list[Material], BeforeValidator(_one_or_many)]
    gravity: Vector | None = None
    wind: UniformWind | None = None
    handles: Annotated[list[Handle], list_of()] = Field(default_factory=list)
    motions: Annotated[dict[Name, Keyframes], block_of("names")] = Field(default_factory=dict)
    contact: Contact | None = None
    obstacles: Annotated[dict[Name, Obstacle], block_of("names")] | None = None
    loads: Annotated[list[AppliedLoad], list_of()] = Field(default_factory=list)
    initial: Initial | None = None
    time: Time
    output: Output = Field(default_factory=Output)
    probes: Annotated[dict[Name, Selector], block_of("names")] = Field(default_factory=dict)
    solver: Solver = Field(default_factory=Solver)
    render: Render | None = None
    fit: Fit | None = None
    petsc: Annotated[dict[str, PetscValue], BeforeValidator(petsc_options), JsonSchema(PETSC_BLOCK)] = Field(
        default_factory=dict
    )

    _source: Path | None = PrivateAttr(default=None)
    _given: dict[str, Any] | None = PrivateAttr(default=None)
    _directory: Path | None = PrivateAttr(default=None)
    _trusts_meshes: bool = PrivateAttr(default=False)
    _notes: list[str] = PrivateAttr(default_factory=list)

    @property
    def source(self) -> Path | None:
        """The file from which the scene was read, for messages; ignored in comparisons."""
        return self._source

    @property
    def notes(self) -> list[str]:
        """What in a file of another program has no effect, for the user."""
        return self._notes

    @property
    def trusts_meshes(self) -> bool:
        """Whether mesh scripts may read any file and run without seccomp, as the caller says."""
        return self._trusts_meshes

    @property
    def mesh_files(self) -> dict[tuple[str | int, ...], Path]:
        """Files of sheets and obstacles, by their keys."""
        files: dict[tuple[str | int, ...], Path] = {}
        for i, source in enumerate(self.mesh):
            if source.file is not None:
                files["mesh", i, "file"] = source.file
        for name, obstacle in (self.obstacles or {}).items():
            if obstacle.mesh is not None:
                files["obstacles", name, "mesh", "file"] = obstacle.mesh.file
        return files

    @property
    def has_scripts(self) -> bool:
        """Whether gmsh makes any of the meshes."""
        return any(file.suffix.lower() == ".geo" for file in self.mesh_files.values())

    def trusting_meshes(self) -> Scene:
        """A copy of the scene with trusted mesh scripts."""
        trusting = self.model_copy()
        trusting._trusts_meshes = True
        return trusting

    def changed(self, changes: Mapping[str, Any]) -> Scene:
        """A copy with some keys changed, as in ``{"time.end": 2.0, "handles[0].until": 1.0}``.

        None removes a key. Defaults follow the changes.

        Raises
        ------
        InputError
            The scene cannot be used; the message names the key.
        """
        from lyra_petsc.scene.load import change_scene

        return change_scene(self, changes)

    def _repr_html_(self) -> str:
        time = self.time
        length = "static" if time.static else f"{time.end:g} s, {time.scheme}"
        usual = {"title", "time", "output", "solver"}
        keys = [key for key in type(self).model_fields if key not in usual and getattr(self, key)]
        return f"<b>{html.escape(self.title or 'Scene')}</b>, {length}: <code>{', '.join(keys)}</code>"

    def __eq__(self, other: object) -> bool:
        # private attributes, as the file it came from, are ignored
        return isinstance(other, Scene) and self.model_dump() == other.model_dump()

    __hash__ = None  # type: ignore[assignment]

    @model_validator(mode="after")
    def _check_step_sizes(self) -> Self:
        smallest = self.time.end * SMALLEST_STEP
        if self.time.step != "auto" and self.time.step < smallest:
            raise problem(_too_small(self.time.step, self.time.end), "time", "step")
        if self.output.every is not None and self.output.every < smallest:
            raise problem(_too_small(self.output.every, self.time.end), "output", "every")
        return self

    @model_validator(mode="after")
    def _check_references(self) -> Self:
        for name, keyframes in self.motions.items():
            _check_keyframes(keyframes, "motions", name)
        for i, handle in enumerate(self.handles):
            self._check_motion(handle.motion, "handles", i)
        for name, obstacle in (self.obstacles or {}).items():
            at: tuple[str | int, ...] = "obstacles", name
            if isinstance(obstacle.motion, list):
                _check_keyframes(obstacle.motion, *at, "motion")
            else:
                self._check_motion(obstacle.motion, *at)
            for i, keyframe in enumerate(self.keyframes(obstacle)):
                if keyframe.scale not in (1.0, (1.0, 1.0, 1.0)):
                    where = f"motion {obstacle.motion!r}" if isinstance(obstacle.motion, str) else "it"
                    raise problem(
                        f"{where} scales in keyframe {i}, but an obstacle is rigid: leave out scale",
                        *at,
                        "motion",
                    )
        groups: set[str | None] = set()
        for i, material in enumerate(self.material):
            if material.group in groups:
                what = (
                    f"group {material.group!r}"
                    if material.group
                    else "triangles without a group of their own"
                )
                raise problem(f"is a second material for the {what}", "material", i, "group")
            groups.add(material.group)
        names = [source.name for source in self.mesh]
        for i, sheet in enumerate(names):
            if sheet is not None and sheet in names[:i]:
                raise problem(f"{sheet!r} is the name of an earlier sheet too", "mesh", i, "name")
        return self

    def _check_motion(self, motion: str | None, *at: str | int) -> None:
        if motion is not None and motion not in self.motions:
            raise problem(f"unknown motion {motion!r}, {suggest(motion, self.motions)}", *at, "motion")

    def keyframes(self, obstacle: Obstacle) -> list[Keyframe]:
        """Keyframes of the motion of an obstacle of the scene; none if it is at rest."""
        motion = obstacle.motion
        return self.motions[motion] if isinstance(motion, str) else motion or []


def _check_keyframes(keyframes: list[Keyframe], *at: str | int) -> None:
    if not keyframes:
        raise problem("must hold at least one keyframe", *at)
    for i in range(1, len(keyframes)):
        before, time = keyframes[i - 1].time, keyframes[i].time
        if time <= before:
            raise problem(
                f"must be later than the keyframe before ({before:g} s), not {time:g}", *at, i, "time"
            )
