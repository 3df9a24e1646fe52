"""The block ``material``: a cloth of the library, or its numbers, with units, ranges and defaults."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    Field,
    Tag,
    ValidationInfo,
    WithJsonSchema,
    field_validator,
)

from lyra_petsc.errors import InputError, suggest
from lyra_petsc.scene.block import BY_KIND, Block
from lyra_petsc.scene.materials.library import is_isotropic, isotropic_names, material_names, measured_names
from lyra_petsc.scene.materials.measured_curves import Points, checked_points, read_curve
from lyra_petsc.scene.values import (
    Bending,
    Name,
    NonNegative,
    Number,
    Pair,
    PartBelowOne,
    Poisson,
    Positive,
    StretchRatio,
    Vector,
    number,
    path_beside,
    problem,
    require,
    shown,
)


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

    def check(self) -> None:
        """Refuse a stiffness that is not positive definite."""
        _check_coupling("c", self.c11, self.c12, self.c22, "N/m")


def _check_coupling(letter: str, first: float, coupling: float, second: float, unit: str) -> None:
    """Refuse a stiffness that is not positive definite."""
    bound = first**0.5 * second**0.5
    require(
        abs(coupling) < bound,
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

    def check(self) -> None:
        """Refuse a stiffness that is not positive definite."""
        _check_coupling("d", self.d11, self.d12, self.d22, "N·m")


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


Curve = Annotated[Points, BeforeValidator(_curve), WithJsonSchema({"type": ["string", "array"]})]


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

    def check(self) -> None:
        """Refuse numbers that no fabric has."""
        for name, stiffness, loop, width, farthest in (
            ("B", self.B, "2HB", self.width_of_bending, KES_CURVATURE),
            ("G", self.G, "2HG", self.width_of_shear, KES_ANGLE),
        ):
            (low, high), unit = KES_RANGES[name]
            for value in stiffness or ():
                require(value > 0.0, f"must be > 0, not {shown(value)}", name)
                text = f"must be {low:g} to {high:g} {unit} as of fabrics, not {value:g}"
                require(low <= value <= high, text, name)
            for value, half in zip(width or (), stiffness or (), strict=False):
                widest = 2.0 * farthest * half
                text = f"must be at most {2.0 * farthest:g} {name} = {widest:g}, not {value:g}"
                require(value <= widest, f"{text}: no test goes far enough to see a wider loop", loop)


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


_AnyLaw = Annotated[Annotated[MembraneLaw, Tag("[plain]")] | Annotated[LawCurves, Tag("[block]")], BY_KIND]
_AnyBending = Annotated[
    Annotated[Bending, Tag("[plain]")] | Annotated[PlateStiffness, Tag("[block]")], BY_KIND
]

# the alternatives for the numbers of a material: the keys of each, and the required ones
_ALTERNATIVES = (
    (("cloth",), ()),
    (("membrane", "bending"), ("membrane", "density")),
    (("young", "poisson", "thickness"), ("young", "poisson", "thickness", "density")),
)


_NO_SHEAR = 1.0
"""Placeholder for c33 in a membrane with G of a KES report, which replaces it."""


def _nonzero(value: Any) -> bool:
    """Whether a number, or one of a list, is given and not 0."""
    return any(entry not in (None, 0) for entry in (value if isinstance(value, (list, tuple)) else [value]))


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
    stretch_limit : float or None
        Largest ratio of a length in the sheet to that at rest, in every direction, which no step exceeds:
        1.05 lets it stretch by up to 5 %. From half of that on the sheet resists more and more.
    yield_curvature : float [1/m] or None
        Curvature from which on a strip of the material bends plastically and keeps a fold: 2 σ / (E h) for
        yield stress σ, Young's modulus E and thickness h. Divided by ``thicken``. Without it bending is
        elastic.
    hardening : float
        Stiffness in plastic bending over the elastic one, below 1 (kinematic hardening: the elastic range of
        moments keeps its width). Below 1e-4, as in perfect plasticity, that is taken. Needs
        ``yield_curvature``.
    """

    conditional_defaults = frozenset({"bending_model"})

    group: Name | None = None
    cloth: Annotated[Name, WithJsonSchema({"enum": material_names()})] | None = None
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
    stretch_limit: StretchRatio | None = None
    yield_curvature: Positive | None = None
    hardening: PartBelowOne = 0.0

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
        width = kes.get("2HB") if isinstance(kes, (dict, KesReport)) else None
        friction = _nonzero(data.get("friction_moment")) or _nonzero(width)
        return {"bending_model": "midedge" if isotropic or plate or friction else "hinge", **data}

    @field_validator("cloth")
    @classmethod
    def _check_cloth(cls, cloth: str | None) -> str | None:
        if cloth is not None and cloth not in material_names():
            raise problem(f"unknown cloth {cloth!r}, {suggest(cloth, material_names())}")
        return cloth

    def check(self) -> None:
        """Refuse numbers that are missing, given twice, or for another law or bending model."""
        used = [names for names in (self.present(*keys) for keys, _ in _ALTERNATIVES) if names]
        several = f"; {' and '.join(names[0] for names in used)} are given" if used else ""
        require(
            len(used) == 1,
            "must be given in exactly one way: cloth, or density + membrane + bending,"
            f" or young + poisson + thickness + density{several}",
        )
        self.require_with("density", self.cloth is None, "comes with the cloth; use density_scale")
        by_curves = isinstance(self.law, LawCurves)
        for keys, required in _ALTERNATIVES:
            for key in required if self.present(*keys) else ():
                text = f"missing (needed beside {self.present(*keys)[0]})"
                require(self.get(key) is not None or (key == "membrane" and by_curves), text, key)
        midedge = self.bending_model == "midedge"
        isotropic = self.young is not None or self.cloth in isotropic_names()
        if by_curves:
            require(
                not self.present("membrane", "young"),
                "curves take the place of membrane; give them beside a cloth, or density and bending",
                "law",
            )
        if isinstance(self.bending, PlateStiffness):
            text = "d11, d22, d12, d33 are for bending_model: midedge; hinges take one number, or three"
            require(midedge, text, "bending")
        if _nonzero(self.friction_moment) or (self.kes is not None and _nonzero(self.kes.width_of_bending)):
            require(
                midedge,
                "friction_moment (2HB of kes) is for bending_model: midedge; "
                "with hinges it depends on the mesh",
                "bending_model",
            )
        text = "is of plastic bending, which begins at yield_curvature; give that, too"
        require(self.yield_curvature is not None or self.hardening == 0.0, text, "hardening")
        if self.law == "measured":
            other = "" if self.cloth is None else f"; {self.cloth} is none of them, leave law out"
            text = f"measured is for measured cloths: {', '.join(measured_names())}{other}"
            require(self.cloth in measured_names(), text, "law")
        if self.law == "neo-hookean":
            require(
                isotropic,
                "neo-hookean is for isotropic sheets: give young, poisson, thickness and density, "
                "or leave law out",
                "law",
            )
        if self.kes is not None:
            self._check_report(self.kes)

    def _check_report(self, kes: KesReport) -> None:
        """Refuse numbers that a KES report gives as well."""
        one = "leave one of them out"
        for name, key in (("B", "bending"), ("2HB", "friction_moment"), ("2HG", "friction_force")):
            if kes.get(name) is not None:
                text = f"kes has {name}, which takes its place; {one}"
                require(self.get(key) in (None, 0), text, key)
        for name in kes.present("B", "G") if self.young is not None else ():
            raise problem(f"has {name}, which young, poisson and thickness give, too; {one}", "kes")
        if kes.G is not None:
            for wrong, part, at in (
                (self.membrane is not None and self.membrane.c33 != _NO_SHEAR, "c33", "membrane.c33"),
                (isinstance(self.law, LawCurves), "the curve of shear", "law"),
                (self.law == "neo-hookean", "the shear modulus of neo-hookean", "law"),
            ):
                require(not wrong, f"kes has G, which takes the place of {part}; {one}", *at.split("."))
