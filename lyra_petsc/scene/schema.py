"""The scene: every key, its unit, its range and its default.

Attribute names are the keys of the scene file, except ``from``, which Python calls
``start``. SI units throughout. Blocks are frozen; ``None`` means the key is absent and its
term is off.
"""

from __future__ import annotations

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

from lyra_petsc.errors import InputError, nearest
from lyra_petsc.scene.block import Block
from lyra_petsc.scene.fit_block import Fit
from lyra_petsc.scene.materials.curves import Points, checked_points, read_curve
from lyra_petsc.scene.materials.library import is_isotropic, isotropic_names, material_names, measured_names
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

MESH_SUFFIXES = (".geo", ".msh", ".obj")

_BY_KIND = Discriminator(lambda value: "[block]" if isinstance(value, (dict, Block)) else "[plain]")
"""Of what may be a block instead of numbers or a word; messages leave out the tags."""


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


MeshPath = Annotated[Path, file_beside("mesh file", *MESH_SUFFIXES), JsonSchema(_file("geo", "msh", "obj"))]


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
    algorithm : str or None
        gmsh's algorithm for the triangles of a .geo; without it the script's, or gmsh's own choice.
    transform : Transform
        Where the sheet starts; without ``vt`` its scaling counts for the rest shape, too.
    name : str or None
        Name of the sheet; a surface group of that name holds its triangles.
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
    )

    file: MeshPath | None = None
    grid: Grid | None = None
    size: Positive | None = None
    algorithm: Literal["automatic", "mesh-adapt", "delaunay", "frontal-delaunay"] | None = None
    transform: Transform = Field(default_factory=Transform)
    name: Name | None = None


class MembraneStiffness(Block):
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
    """Orthotropic bending stiffness [N·m]: moments per width of curvatures; axis 1 is the warp.

    Attributes
    ----------
    d11, d22 : float [N·m]
        Along warp and weft.
    d12 : float [N·m]
        Coupling of the two; d12² < d11 d22.
    d33 : float [N·m]
        Of twist, on 2 κ12; D (1 − ν)/2 of an isotropic plate.
    """

    d11: Positive
    d22: Positive
    d12: Number = 0.0
    d33: Positive

    @model_validator(mode="after")
    def _positive_definite(self) -> Self:
        _check_coupling("d", self.d11, self.d12, self.d22, "N·m")
        return self


BendingModel = Literal["hinge", "midedge"]
MembraneLaw = Literal["stvk", "measured", "neo-hookean"]


def _curve(value: Any, info: ValidationInfo) -> Points:
    """A curve from a file beside the scene, or as its points: so a scene as understood needs no files."""
    try:
        if isinstance(value, str):
            path = path_beside(value, info)
            return checked_points(read_curve(path), str(path))
        if isinstance(value, (list, tuple)) and all(isinstance(p, (list, tuple)) for p in value):
            pairs = [(number(x), number(y)) for x, y in value]
            return checked_points([(f"point {n}", x, y) for n, (x, y) in enumerate(pairs, start=1)])
    except InputError as error:
        raise problem(": ".join(part for part in (error.file, error.message) if part)) from None
    except ValueError:  # no pair, or no numbers
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
"""To which KES-F 2 bends [1/cm], and KES-F 1 shears [°]."""

KES_RANGES = {"B": ((1e-4, 50.0), "gf·cm²/cm"), "G": ((1e-3, 100.0), "gf/(cm·degree)")}
"""Wider than those of fabrics: numbers outside are in other units."""


class KesReport(Block):
    """Numbers of a KES-F report as it prints them; each takes the place of the material's own.

    One number, or two along warp and weft. What no fabric has is refused: it is in other units.

    Attributes
    ----------
    B : float or (2,) [gf·cm²/cm]
        Bending stiffness.
    width_of_bending : float or (2,) [gf·cm/cm]
        Width of the loop of bending: twice ``friction_moment``.
    G : float or (2,) [gf/(cm·degree)]
        Shear stiffness, of which the mean counts.
    width_of_shear : float or (2,) [gf/cm]
        Width of the loop of shear, likewise: twice ``friction_force``.
    """

    B: Pair | None = None
    width_of_bending: Pair | None = Field(default=None, alias="2HB")
    G: Pair | None = None
    width_of_shear: Pair | None = Field(default=None, alias="2HG")

    @model_validator(mode="after")
    def _of_a_fabric(self) -> Self:
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
    """One's own measurements: force [N/m], per width at rest, by strain.

    Each is a file of two columns (commas, semicolons or blanks between), beside the scene file, or a list of
    points. Strains are fractions, and both columns grow. A curve begins at (0, 0), goes on straight after its
    last point, and warp and weft do so under compression. Nothing couples the three.

    Attributes
    ----------
    warp, weft : curve of strain and N/m
        Strips pulled along warp and weft.
    shear : curve of shear strain and N/m
        Tangent of the angle by which warp and weft are sheared, and the force.
    """

    warp: Curve
    weft: Curve
    shear: Curve


_AnyLaw = Annotated[Annotated[MembraneLaw, Tag("[plain]")] | Annotated[LawCurves, Tag("[block]")], _BY_KIND]
_BY_CURVES = given(law={"type": "object"})
_AnyBending = Annotated[
    Annotated[Bending, Tag("[plain]")] | Annotated[PlateStiffness, Tag("[block]")], _BY_KIND
]

# the ways to give a material's numbers: the keys of each, and those it needs
_MATERIAL_WAYS = (
    (("cloth",), ()),
    (("membrane", "bending"), ("membrane", "density")),
    (("young", "poisson", "thickness"), ("young", "poisson", "thickness", "density")),
)


def _several_ways(material: Material) -> str:
    used = [keys[0] for keys in (material.given(*way) for way, _ in _MATERIAL_WAYS) if keys]
    found = f"; {' and '.join(used)} are given" if used else ""
    return (
        "must be given in exactly one way: cloth, or density + membrane + bending,"
        f" or young + poisson + thickness + density{found}"
    )


def _needed(way: tuple[str, ...], key: str) -> Rule:
    """A key that has to be given beside any of the others."""
    ways = any_of(*way) if key != "membrane" else {"allOf": [any_of(*way), {"not": _BY_CURVES}]}
    return Rule(when(ways, given(key)), lambda m: f"missing (needed beside {m.given(*way)[0]})", key)


_NO_SHEAR = 1.0
"""c33 of what has G of a KES report, where it counts for nothing."""

_FRICTION = {
    "anyOf": [
        {"type": "number", "exclusiveMinimum": 0},
        {"type": "array", "not": {"items": {"enum": [0]}}},
    ]
}
_RUBS = {
    "anyOf": [
        given(friction_moment=_FRICTION),
        given(kes={"type": "object", **given(**{"2HB": _FRICTION})}),
    ]
}


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
    membrane : MembraneStiffness or None
        Stretching stiffness.
    bending : float or (3,) [N·m], PlateStiffness or None
        Cylindrical stiffness B; three values hold at 0°, 45°, 90° to the warp (of a hinge's edge). Or four
        numbers of an orthotropic plate.
    bending_model : str or None
        ``hinge``: an angle between neighbouring triangles, fast, but plates depend on their mesh;
        ``midedge``: one unknown more on every edge, converges on any mesh. By default ``midedge`` for young,
        poisson and thickness, also of the library, for an orthotropic plate and with friction_moment, else
        ``hinge``.
    law : str or LawCurves
        How the membrane's stiffness depends on strain. ``stvk``: not at all; ``measured``: as measured on a
        cloth of the library; ``neo-hookean``: as that of rubber, for young, poisson and thickness, also of
        the library. At rest it is the same. Or curves of one's own, instead of ``membrane``. Under
        compression ``stvk`` softens, the others do not.
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
    friction_moment : float or (2,) [N m/m]
        Moment per width by which friction within the fabric resists bending, of warp and weft: hysteresis,
        and folds that stay. Half of KES's 2HB. Scaled as bending; by ``midedge`` only.
    friction_force : float [N/m]
        Force per width by which it resists shear, half of 2HG. Scaled as membrane.
    kes : KesReport or None
        Instead of bending, c33, friction_moment and friction_force.
    """

    rules = (
        Rule({"oneOf": [any_of(*way) for way, _ in _MATERIAL_WAYS]}, _several_ways),
        Rule(when(given("cloth"), absent("density")), "comes with the cloth; use density_scale", "density"),
        *(_needed(way, key) for way, needed in _MATERIAL_WAYS for key in needed),
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
            when(_RUBS, given(bending_model={"const": "midedge"})),
            "friction_moment (2HB of kes) is for bending_model: midedge; hinges would lose more or less",
            "bending_model",
        ),
        Rule(
            when(given(law={"const": "measured"}), given(cloth={"enum": measured_names()})),
            lambda m: (
                f"measured is for cloths that were: {', '.join(measured_names())}"
                f"{'' if m.cloth is None else f'; {m.cloth} was not, leave law out'}"
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
        """Numbers without ``bending`` mean a membrane: the zero is written out."""
        by_curves = isinstance(data.get("law"), (dict, LawCurves)) and not {"cloth", "young"} & data.keys()
        if "membrane" in data or by_curves:
            data = {"bending": 0.0, **data}
        membrane, kes = data.get("membrane"), data.get("kes")
        if isinstance(membrane, dict) and isinstance(kes, dict) and kes.get("G") is not None:
            data["membrane"] = {"c33": _NO_SHEAR, **membrane}
        isotropic = "young" in data or is_isotropic(data.get("cloth"))
        plate = isinstance(data.get("bending"), (dict, PlateStiffness))
        rubs = holds(_RUBS, data)
        return {"bending_model": "midedge" if isotropic or plate or rubs else "hinge", **data}

    @field_validator("cloth")
    @classmethod
    def _in_a_library(cls, cloth: str | None) -> str | None:
        if cloth is not None and cloth not in material_names():
            raise problem(f"unknown cloth {cloth!r}, {nearest(cloth, material_names())}")
        return cloth


_ALL_AXES = {
    "anyOf": [
        {"type": "null"},
        {"allOf": [{"not": {"items": {"not": {"const": axis}}}} for axis in AXES]},
    ]
}


MAX_SPEED = 1e8
"""Largest speed [m/s] that anything may have; squares of larger ones are soon no numbers."""

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
        Of the air; zeros are still air.
    density : float [kg/m³]
        Of the air.
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
    """The three ways to name vertices.

    Attributes
    ----------
    group : str or None
        A group of the mesh, or a sheet's name.
    nodes : list of int or None
        Vertex numbers, from 0, in file order.
    box : two (3,) [m] or None
        Lower and upper corner; start positions, faces included.
    """

    group: Name | None = None
    nodes: Annotated[list[Index], list_of(" of vertex numbers", minimum=1), JsonSchema(_NODES)] | None = None
    box: Annotated[tuple[Vec3, Vec3], JsonSchema(_BOX)] | None = None

    @field_validator("nodes")
    @classmethod
    def _each_once(cls, nodes: list[int] | None) -> list[int] | None:
        if nodes is not None and len(set(nodes)) != len(nodes):
            twice = Counter(nodes).most_common(1)[0][0]
            raise problem(f"lists vertex {twice} twice")
        return nodes

    @field_validator("box", mode="before")
    @classmethod
    def _corners(cls, value: Any) -> Any:
        if not isinstance(value, (list, tuple)) or len(value) != 2:
            raise problem(f"must be two corners [[x, y, z], [x, y, z]], not {shown(value)}")
        low, high = vector(value[0]), vector(value[1])
        if any(a > b for a, b in zip(low, high, strict=True)):
            raise problem("must have its lower corner first")
        return low, high


class Selector(VertexChoice):
    """Vertices by exactly one of group, nodes, box."""

    rules: ClassVar[tuple[Rule, ...]] = (exactly_one("group", "nodes", "box"),)


def _ends_later(block: Any) -> Any:
    if not block.start < block.until:
        raise problem(f"must be later than from = {block.start:g}, not {block.until:g}", "until")
    return block


class Handle(Selector):
    """Vertices whose motion is prescribed, or pulled by springs.

    Attributes
    ----------
    axes : tuple of "x", "y", "z"
        Directions that are held.
    clamp : bool
        Keep the slope of held boundary edges. With part of the ``axes`` they slide along the others, in the
        sheet's plane; by ``midedge`` only.
    symmetry : "x", "y" or "z", or None
        The vertices lie in a plane normal to this axis, in which the sheet is mirrored: they stay in it, and
        the sheet stays normal to it. Takes the place of ``axes``; bends by ``midedge`` only.
    motion : str or None
        Name in ``motions``; without: held in place.
    interpolation : str
        Of the motion in time, between keyframes.
    start, until : float [s]
        Held for from ≤ t ≤ until (without: to the end).
    fade : float [s]
        After ``until`` the hold fades as (1 − (t − until)/fade)⁴.
    stiffness : float [N/m] or None
        Per vertex and axis: a spring instead of a constraint.
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
    interpolation: Literal["hermite", "linear"] = "hermite"
    start: Number = Field(default=0.0, alias="from")
    until: Until = math.inf
    fade: NonNegative = 0.0
    stiffness: Positive | None = None

    @property
    def axis_numbers(self) -> tuple[int, ...]:
        """The directions that are held as 0, 1, 2, ascending."""
        return tuple(AXES.index(axis) for axis in (self.symmetry or self.axes))

    @property
    def holds_slope(self) -> bool:
        """Whether it holds the directors of its edges, where they have them."""
        return self.clamp or self.symmetry is not None

    @field_validator("axes", mode="before")
    @classmethod
    def _axes(cls, value: Any) -> Any:
        chosen = axes(value)
        return tuple(axis for axis in AXES if axis in chosen)

    _in_order = model_validator(mode="after")(_ends_later)


class Keyframe(Block):
    """Where a motion has carried the held vertices at one time: scaled, rotated, translated.

    Attributes
    ----------
    time : float [s]
        Later than the keyframe before.
    scale : float or (3,)
        Factor about the origin, or one for each axis; not 0.
    rotate : Rotation or None
        Rotation after the scaling.
    translate : (3,) [m]
        Displacement after the rotation.
    velocity : (3,) [m/s] or None
        Of the translation; without: by central differences, zero at both ends.
    """

    rules = (_NOT_TOO_FAST,)

    time: Number
    scale: Scale = 1.0
    rotate: Rotation | None = None
    translate: Vector = (0.0, 0.0, 0.0)
    velocity: Vector | None = None


Keyframes = Annotated[list[Keyframe], list_of(), Field(json_schema_extra={"minItems": 1})]


class Friction(Block):
    """Coulomb friction whose coefficient at rest is not that of sliding.

    Attributes
    ----------
    static : float
        Coefficient at rest.
    kinetic : float
        Coefficient while sliding; at most the static one.
    """

    static: NonNegative
    kinetic: NonNegative

    @model_validator(mode="after")
    def _rest_holds_more(self) -> Self:
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
        Distance below which surfaces feel each other; by default the smaller of a quarter of the mean edge
        and half of the shortest.
    thickness : float [m]
        Distance kept between mid-surfaces.
    self : bool
        Whether sheets meet themselves and other sheets, not obstacles alone.
    friction : float or Friction
        Coulomb's coefficient, or a block of two.
    """

    gap: Positive | None = None
    thickness: NonNegative = 0.0
    self: Flag = True
    friction: _AnyFriction = 0.0


class Plane(Block):
    """A plane without end.

    Attributes
    ----------
    point : (3,) [m]
        Any point of it.
    normal : (3,)
        Towards the side that is free; not zero, need not be a unit vector.
    """

    point: Vector
    normal: Axis


class Sphere(Block):
    """A sphere.

    Attributes
    ----------
    center : (3,) [m]
        Its middle.
    radius : float [m]
        Of the surface.
    """

    center: Vector
    radius: Positive


class Capsule(Block):
    """A cylinder with half spheres as ends.

    Attributes
    ----------
    start, to : (3,) [m]
        Ends of its axis, the centres of the half spheres.
    radius : float [m]
        Of cylinder and half spheres.
    """

    start: Vector = Field(alias="from")
    to: Vector
    radius: Positive

    @model_validator(mode="after")
    def _has_an_axis(self) -> Self:
        if self.start == self.to:
            raise problem("must be another point than from; for a ball give sphere", "to")
        return self


class Cuboid(Block):
    """A box with sides along x, y and z (at t = 0).

    Attributes
    ----------
    min, max : (3,) [m]
        Lower and upper corner.
    """

    min: Vector
    max: Vector

    @model_validator(mode="after")
    def _has_a_volume(self) -> Self:
        for axis, low, high in zip(AXES, self.min, self.max, strict=True):
            if low >= high:
                raise problem(f"must be above min in {axis}: {high:g} is not above {low:g}", "max")
        return self


class ObstacleMesh(Block):
    """Any triangle mesh, closed or open, of which both sides are met.

    Attributes
    ----------
    file : Path
        A .geo, .msh or .obj; a relative path stands beside the scene file.
    transform : Transform
        Where it stands at t = 0.
    """

    file: MeshPath
    transform: Transform = Field(default_factory=Transform)


SHAPES = ("plane", "sphere", "capsule", "box", "mesh")
"""Kinds of obstacles."""


class Obstacle(Block):
    """What sheets cannot pass: one shape, still or moving rigidly.

    Attributes
    ----------
    plane : Plane or None
        A plane, free on the side of its normal.
    sphere : Sphere or None
        A sphere, kept out of or in.
    capsule : Capsule or None
        A rod with round ends.
    box : Cuboid or None
        A box, at first along x, y and z.
    mesh : ObstacleMesh or None
        A triangle mesh.
    inside : bool
        Sheets stay inside of the sphere, capsule or box.
    motion : str or list of Keyframe or None
        Name in ``motions``, or keyframes; without: stands still. Rigid, hence without ``scale``.
    interpolation : str
        Of the motion in time, between keyframes.
    friction : float or Friction or None
        Wins over that of ``contact``.
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
    interpolation: Literal["hermite", "linear"] = "hermite"
    friction: _AnyFriction | None = None

    @property
    def shape(self) -> str:
        """The one of `SHAPES` that it is."""
        return self.given(*SHAPES)[0]


class AppliedLoad(VertexChoice):
    """A force, a pressure, a traction or a moment.

    Attributes
    ----------
    group : str or None
        A group of the mesh, or a sheet's name; for pressure and traction a surface group, or nothing (every
        triangle); for a moment one of boundary edges.
    force : (3,) [N] or None
        Total, shared by the selected vertices.
    pressure : float [Pa] or None
        Along the current normal.
    traction : (3,) [N/m²] or None
        Per rest area, direction fixed in space.
    moment : float [N·m/m] or None
        Per rest length about the boundary edges of the group, which it follows; positive lifts their free
        side towards the sheet's normal. Bends by ``midedge`` only.
    start, until : float [s]
        Acts for from ≤ t ≤ until (without: to the end).
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

    _in_order = model_validator(mode="after")(_ends_later)


class Initial(Block):
    """State at t = 0, beside the start positions.

    Attributes
    ----------
    velocity : (3,) [m/s]
        Of all vertices.
    angular_velocity : (3,) [rad/s]
        About the centre of mass.
    noise : float [m]
        Standard deviation of a normally distributed displacement of every vertex that no
        handle holds, along the vertex normal of the start shape.
    seed : int
        Of the noise.
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
    """Time stepping, or the way to an equilibrium.

    Attributes
    ----------
    analysis : str
        ``dynamic``: a motion in time; ``static``: the equilibrium under the loads, which grow with a
        load factor from 0 to 1 that takes the place of time.
    end : float [s]
        Time at which the run ends; 1 in a static analysis.
    step : float [s] or "auto"
        Nominal and largest Δt; ``auto``: as the tolerance asks. In a static analysis the first
        increment of the load factor.
    tolerance : float or None
        With ``step: auto``: error in the positions that the steps may add up to by the end, as a fraction
        of the diagonal of the rest shape's bounding box.
    integrator : str or None
        ``beuler`` (first order, full Newton), ``semi-implicit`` (one linear solve a step), ``midpoint``,
        ``alpha2`` (generalised-α), ``bdf2`` (second order); none in a static analysis. By default ``beuler``.
    spectral_radius : float or None
        Spectral radius of ``alpha2`` at high frequencies: 0 damps them in a step, 1 keeps them.
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
        if data.get("analysis") == "static":
            return {"end": 1.0, "step": LOAD_STEP, **data}
        data = {"integrator": "beuler", **data}
        if data.get("step") == "auto":
            data.setdefault("tolerance", TOLERANCE)
        if data["integrator"] == "alpha2":
            data.setdefault("spectral_radius", SPECTRAL_RADIUS)
        return data


class CheckpointInterval(Block):
    """How often a checkpoint is written at least.

    Attributes
    ----------
    seconds : float [s]
        Wall time.
    steps : int or None
        Accepted steps; without: only by wall time.
    """

    seconds: Positive = 60.0
    steps: Count | None = None


class Output(Block):
    """What is written.

    Attributes
    ----------
    every : float [s] or None
        Simulated time between states; empty: every step.
    fields : list of str
        What a state holds beside the positions.
    checkpoint : CheckpointInterval
        How often a checkpoint is written at least.
    reactions : bool
        Write the forces [N] at the handles to reactions.csv, and under ``midedge`` the moments [N·m] about
        the mean position of those with ``clamp`` or ``symmetry``.
    vtkhdf : bool
        Announce the states also in states.vtkhdf, which newer ParaView reads faster than the XDMF.
    """

    null_is_a_value: ClassVar[frozenset[str]] = frozenset({"every"})

    every: Positive | None = 0.04
    fields: Annotated[list[str], JsonSchema(_FIELDS)] = Field(default_factory=list)
    checkpoint: CheckpointInterval = Field(default_factory=CheckpointInterval)
    reactions: Flag = False
    vtkhdf: Flag = False

    @field_validator("fields", mode="before")
    @classmethod
    def _known_fields(cls, value: Any) -> Any:
        if not isinstance(value, (list, tuple)):
            raise problem(f"must be a list, not {shown(value)}; known: {', '.join(FIELDS)}")
        for name in value:
            if name not in FIELDS:
                word = name if isinstance(name, str) else shown(name)
                raise problem(f"unknown field {word!r}, {nearest(word, FIELDS)}")
        return list(dict.fromkeys(value))


class Solver(Block):
    """When a step counts as converged, and how Newton treats its Hessian.

    Attributes
    ----------
    force_tolerance : float
        Force residual over the forces at work.
    step_tolerance : float
        How far a coordinate is expected to move yet, over element size.
    max_iterations : int
        Newton iterations a step may take.
    hessian : str
        ``exact``, ``regularised`` (always positive definite), or ``adaptive``: as exact as it can be.
    """

    force_tolerance: Positive = 1e-6
    step_tolerance: Positive = 1e-6
    max_iterations: Count = 50
    hessian: Literal["adaptive", "regularised", "exact"] = "adaptive"


PARALLEL = 1e-6
"""Sine of the angle between two directions below which they count as one."""


class Camera(Block):
    """Where the pictures are taken from; what is left out is found from the whole motion.

    Attributes
    ----------
    direction : (3,) or None
        From the sheet towards the camera; its distance is fitted to the whole motion.
    position : (3,) [m] or None
        Where it stands, instead of a direction; needs a target.
    target : (3,) [m] or None
        What it looks at.
    up : (3,) or None
        Upwards in the picture; without: against gravity, or z.
    angle : float [degrees]
        Height of the field of view, from 1 to 120.
    zoom : float
        With a fitted distance: how much larger than it fits.
    frame : float [percent]
        With a fitted distance: the share of the states that are wholly in the picture (95), from 50 to 100.
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
    def _has_directions(self) -> Self:
        if self.position is not None and self.position == self.target:
            raise problem("is where the camera stands; it must look at another point", "target")
        view = self.line_of_sight
        if view is not None and self.up is not None and parallel(view, self.up):
            raise problem("must not point along the line of sight", "up")
        return self

    @property
    def line_of_sight(self) -> Vec3 | None:
        """Direction from what is seen to the camera, of any length, if the scene gives it."""
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
    """How ``render`` shows the scene.

    Attributes
    ----------
    camera : Camera or None
        Where the pictures are taken from; without: where most of the sheet is seen.
    """

    camera: Camera | None = None


SMALLEST_STEP = 2.0**-52
"""Step over the end of the run below which the time, a 64-bit number, would stand still."""


def _too_small(step: float, end: float) -> str:
    return (
        f"is too small, {step:g}: times near {end:g} s are not told apart below {end * SMALLEST_STEP:.2g} s; "
        "take a longer one or an earlier time.end"
    )


def _one_or_many(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        if not value:
            raise problem("must hold at least one entry")
        return list(value)
    return [value]


class Scene(Block):
    """The whole input of a run.

    Attributes
    ----------
    title : str
        One line for summaries and pages.
    mesh : list of MeshSource
        Where the sheets come from: one block, or a list whose vertices are numbered consecutively.
    material : list of Material
        One block, or a list; at most one without a group: it serves the triangles that no other block names.
    gravity : (3,) [m/s²] or None
        Acceleration of gravity; without this key there is none.
    wind : UniformWind or None
        Uniform wind; without this key there is no air.
    handles : list of Handle
        Vertices that are held or moved.
    motions : dict of list of Keyframe
        Motions of handles and obstacles, by name; times strictly ascending.
    contact : Contact or None
        How surfaces meet; without this key they pass through each other.
    obstacles : dict of Obstacle or None
        What sheets meet beside themselves, by name.
    loads : list of AppliedLoad
        Forces, pressures and tractions.
    initial : Initial or None
        State at t = 0, where it is not rest.
    time : Time
        Time stepping, or the way to an equilibrium.
    output : Output
        What is written, and how often.
    probes : dict of Selector
        Vertices whose mean position goes into probes.csv at every step, by name.
    solver : Solver
        When a step counts as converged.
    render : Render or None
        What ``render`` shows; a run does not read it.
    fit : Fit or None
        Numbers to be found from measurements, by ``fit``; a run does not read it.
    petsc : dict
        PETSc options without the leading dash; an empty value is an option without one.
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
            # a template would take the braces for a key
            lambda _: "are met only with contact; add the line 'contact: {friction: 0.3}'",
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

    @property
    def source(self) -> Path | None:
        """The file this scene was read from, for messages; no part of its value."""
        return self._source

    @property
    def trusts_meshes(self) -> bool:
        """Whether gmsh gets this scene's scripts unchecked; the caller decides that, not the file."""
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
        """Whether some of its meshes are made by gmsh."""
        return any(file.suffix.lower() == ".geo" for file in self.mesh_files.values())

    def trusting_meshes(self) -> Scene:
        """The same scene, whose mesh scripts the caller trusts."""
        trusting = self.model_copy()
        trusting._trusts_meshes = True
        return trusting

    def changed(self, changes: Mapping[str, Any]) -> Scene:
        """Another scene with some keys changed, as in ``{"time.end": 2.0, "handles[0].until": 1.0}``.

        None removes a key. The other keys stand as they were given: defaults follow the changes.

        Raises
        ------
        InputError
            On anything that cannot be used, naming the key.
        """
        from lyra_petsc.scene.load import change_scene

        return change_scene(self, changes)

    def __eq__(self, other: object) -> bool:
        # equal in value: which file it came from does not count
        return isinstance(other, Scene) and self.model_dump() == other.model_dump()

    __hash__ = None  # type: ignore[assignment]

    @model_validator(mode="after")
    def _time_advances(self) -> Self:
        smallest = self.time.end * SMALLEST_STEP
        if self.time.step != "auto" and self.time.step < smallest:
            raise problem(_too_small(self.time.step, self.time.end), "time", "step")
        if self.output.every is not None and self.output.every < smallest:
            raise problem(_too_small(self.output.every, self.time.end), "output", "every")
        return self

    @model_validator(mode="after")
    def _names_agree(self) -> Self:
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
            raise problem(f"unknown motion {motion!r}, {nearest(motion, self.motions)}", *at, "motion")

    def keyframes(self, obstacle: Obstacle) -> list[Keyframe]:
        """Of the motion of one of its obstacles; none where it stands still."""
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
