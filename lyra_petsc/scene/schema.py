"""The scene: all keys with units, ranges and defaults.

Attributes have the names of the keys in scene files, except ``start`` for the key ``from``, a keyword of
Python. Units are SI. Blocks are immutable; None means that the key is absent and its term is off.

The docstrings are the text of the reference page and of the JSON Schema.
"""

from __future__ import annotations

import html
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, get_args

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Discriminator,
    Field,
    PrivateAttr,
    Tag,
    WithJsonSchema,
    field_validator,
)

from lyra_petsc.errors import suggest
from lyra_petsc.scene.attachment_block import Attachment
from lyra_petsc.scene.block import BY_KIND, Block
from lyra_petsc.scene.camera_block import Render
from lyra_petsc.scene.crease_block import Crease
from lyra_petsc.scene.fit_block import Fit
from lyra_petsc.scene.frames_key import FramesPath
from lyra_petsc.scene.gas_block import Gas, Liquid
from lyra_petsc.scene.material_block import Material
from lyra_petsc.scene.petsc_block import PetscValue, petsc_options
from lyra_petsc.scene.seam_block import Seam
from lyra_petsc.scene.time_curve import NumberInTime, VectorInTime, VectorPoints, plain_values
from lyra_petsc.scene.values import (
    AXES,
    Axis,
    Count,
    Direction,
    Flag,
    Fraction,
    Name,
    NonNegative,
    Number,
    Positive,
    PositiveScale,
    Scale,
    Seed,
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
    problem,
    require,
    shown,
)
from lyra_petsc.scene.vertex_choice import VertexChoice

MESH_SUFFIXES = (".geo", ".msh", ".obj", ".stl", ".ply", ".off", ".vtk", ".inp", ".bdf", ".unv")


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


MeshPath = Annotated[Path, file_beside("mesh file", *MESH_SUFFIXES)]


class MeshSource(Block):
    """Source of one sheet: a file or a grid; or of all sheets and seams of a garment pattern.

    Attributes
    ----------
    file : Path or None
        A mesh file (.geo, .msh, .obj, .stl, .ply, .off, .vtk, .inp, .bdf, .unv); the path is relative to the
        scene file.
    grid : Grid or None
        A rectangular grid instead of a file.
    pattern : Path or None
        A garment pattern of GarmentCode (NAME_specification.json): a sheet for each panel, with its name and
        groups ``edge0``, ``edge1``, …, and a seam for each stitch, which closes in the first second;
        ``seams`` of the scene between the same groups replace these. Units are those of the file, y is up.
    panel : str or None
        This panel of the pattern alone, without seams.
    size : float [m] or None
        Element size for a .geo file, where it replaces the sizes in the script, or for a pattern.
    algorithm : str or None
        gmsh's algorithm for the triangles of a .geo file or a pattern; by default that of the script, or
        gmsh's default.
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

    file: MeshPath | None = None
    grid: Grid | None = None
    pattern: Annotated[Path, file_beside("pattern", ".json")] | None = None
    panel: Name | None = None
    size: Positive | None = None
    algorithm: Literal["automatic", "mesh-adapt", "delaunay", "frontal-delaunay"] | None = None
    transform: Transform = Field(default_factory=Transform)
    uv: UvScale | None = None
    weld: Positive | None = None
    name: Name | None = None

    def check(self) -> None:
        """Refuse keys for other kinds of files."""
        self.require_one("file", "grid", "pattern")
        self.require_with("panel", self.pattern is not None, "is a panel of a pattern")
        if self.pattern is not None:
            require(self.size is not None, "needs size, the element size [m]", "pattern")
        suffix = self.file.suffix.lower() if self.file is not None else ""
        for key in ("size", "algorithm"):
            self.require_with(
                key,
                suffix == ".geo" or self.pattern is not None,
                "is for patterns and .geo files only (others come with their elements)",
            )
        self.require_with("uv", suffix == ".obj", "is for .obj files only (others have no vt)")

    @classmethod
    def with_defaults(cls, data: dict[str, Any]) -> dict[str, Any]:
        """A panel's sheet has its name."""
        return data | ({"name": data["panel"]} if "panel" in data and "name" not in data else {})


MAX_SPEED = 1e8
"""Largest speed [m/s] in a scene; squares of much larger ones overflow."""


def _speed(velocity: Vec3 | VectorPoints) -> Vec3 | VectorPoints:
    for components in plain_values(velocity):
        require(max(map(abs, components)) <= MAX_SPEED, f"must not be faster than {MAX_SPEED:g} m/s")
    return velocity


Velocity = Annotated[Vector, AfterValidator(_speed)]


class UniformWind(Block):
    """Uniform wind.

    Attributes
    ----------
    velocity : (3,) or curve [m/s]
        Velocity of the air; zero is still air.
    density : float [kg/m³]
        Density of the air.
    drag : float [kg/(m² s)]
        Tangential drag coefficient.
    """

    velocity: Annotated[VectorInTime, AfterValidator(_speed)]
    density: NonNegative
    drag: NonNegative = 0.0


class Selector(VertexChoice):
    """Vertices by exactly one of group, nodes, box."""

    def check(self) -> None:
        """Refuse several choices."""
        self.require_one("group", "nodes", "box")


def _check_window(start: float, until: float) -> None:
    require(start < until, f"must be later than from = {start:g}, not {until:g}", "until")


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
    frames : Path or list of Path or None
        Positions of the vertices in files, as ``frames`` of an obstacle's mesh: those of the group in the
        order of the mesh, or of all vertices. The vertices move by the frames' displacements, from where they
        are when the handle begins to act.
    fps : float [1/s] or None
        Frames per second, for files without times.
    repeat : bool
        Whether frames begin again after the last one, as those of an obstacle's mesh.
    interpolation : str
        Interpolation of the motion between keyframes or frames. ``monotone``: smooth, and never beyond two
        neighbouring keyframes; ``hermite``: smooth, as the original Lyra's, but swings beyond keyframes
        before a hold; ``linear``.
    start, until : float [s]
        The handle acts for from ≤ t ≤ until; by default always.
    fade : float [s]
        After ``until`` the handle fades by the factor (1 − (t − until)/fade)⁴.
    stiffness : float [N/m] or None
        Stiffness for each vertex and axis of springs that replace the constraint.
    """

    axes: tuple[Direction, ...] = AXES
    clamp: Flag = False
    symmetry: Direction | None = None
    motion: Name | None = None
    frames: FramesPath | None = None
    fps: Positive | None = None
    repeat: Flag = False
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

    def check(self) -> None:
        """Refuse slopes and symmetry planes that cannot be held."""
        super().check()
        require(
            not self.clamp or self.stiffness is None or self.axes == AXES,
            "keeps no slope of an edge that springs hold along some axes; hold all axes, or leave clamp out",
            "clamp",
        )
        _check_frames(self)
        others = self.clamp or self.fade > 0.0 or self.present("motion", "stiffness", "symmetry")
        self.require_with(
            "frames",
            not others,
            "move vertices that nothing else moves; leave out clamp, fade, motion, stiffness and symmetry",
        )
        others = self.clamp or self.start > 0.0 or self.fade > 0.0 or self.present("motion", "stiffness")
        self.require_with(
            "symmetry",
            self.axes == AXES and not others,
            "is a plane that stands still and mirrors the sheet; leave out axes, clamp, motion, stiffness, "
            "from and fade",
        )
        _check_window(self.start, self.until)


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

    time: Number
    scale: Scale = 1.0
    rotate: Rotation | None = None
    translate: Vector = (0.0, 0.0, 0.0)
    velocity: Velocity | None = None


Keyframes = Annotated[list[Keyframe], list_of()]


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

    def check(self) -> None:
        """Refuse a kinetic coefficient above the static one."""
        text = f"must be at most static = {self.static:g}, not {self.kinetic:g}"
        require(self.kinetic <= self.static, text, "kinetic")


_AnyFriction = Annotated[
    Annotated[NonNegative, Tag("[plain]")] | Annotated[Friction, Tag("[block]")], BY_KIND
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
    untangle : bool
        Take a start that crosses apart before the first step, by displacements of at most three times the
        depth of the overlap, or refuse it.
    """

    gap: Positive | None = None
    thickness: NonNegative = 0.0
    self: Flag = True
    friction: _AnyFriction = 0.0
    untangle: Flag = False


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

    def check(self) -> None:
        """Refuse an axis without length."""
        require(self.start != self.to, "must be another point than from; for a ball give sphere", "to")


class Cuboid(Block):
    """A box with edges along x, y and z at t = 0.

    Attributes
    ----------
    min, max : (3,) [m]
        Lower and upper corner.
    """

    min: Vector
    max: Vector

    def check(self) -> None:
        """Refuse a box without volume."""
        for axis, low, high in zip(AXES, self.min, self.max, strict=True):
            require(low < high, f"must be above min in {axis}: {high:g} is not above {low:g}", "max")


class ObstacleMesh(Block):
    """A triangle mesh, closed or open, with contact on both sides.

    Attributes
    ----------
    file : Path
        A mesh file (.geo, .msh, .obj, .stl, .ply, .off, .vtk, .inp, .bdf, .unv); the path is relative to the
        scene file.
    transform : Transform
        Transform from the mesh, and its frames, to positions.
    frames : Path or list of Path or None
        Files with the positions of the vertices at given times, through which the surface moves: an .npz file
        with ``position`` (T, V, 3) and ``time`` (T,) as ``export --to npz`` writes it, a sequence of .obj
        files (``body_*.obj``, or their list), or a USD file with one mesh whose points change (.usd, .usda,
        .usdc). V is the number of vertices of ``file``. Before the first frame and after the last one the
        surface stands still.
    fps : float [1/s] or None
        Frames per second, for files without times; the first frame is at t = 0.
    repeat : bool
        Whether frames begin again after the last one: after the time between the last two, or at once if the
        last frame is the first one again.
    """

    file: MeshPath
    transform: Transform = Field(default_factory=Transform)
    frames: FramesPath | None = None
    fps: Positive | None = None
    repeat: Flag = False

    @classmethod
    def with_defaults(cls, data: dict[str, Any]) -> dict[str, Any]:
        """Take the frames of a list of files."""
        files = data.get("file")
        if isinstance(files, (list, tuple)) and files and data.get("frames") is None:
            return data | {"file": files[0], "frames": files}
        return data

    def check(self) -> None:
        """Refuse keys for frames without frames."""
        _check_frames(self)


def _check_frames(block: Handle | ObstacleMesh) -> None:
    for key in ("fps", "repeat"):
        if block.get(key):
            require(block.frames is not None, "is for frames, which are absent", key)
    with_times = isinstance(block.frames, Path) and block.frames.suffix.lower() != ".obj"
    require(
        block.frames is None or with_times or block.fps is not None,
        "have no times; give fps, the frames per second",
        "frames",
    )


SHAPES = ("plane", "sphere", "capsule", "box", "mesh")
"""Keys for the shapes of obstacles."""


class Obstacle(Block):
    """An obstacle of one shape, which sheets cannot penetrate: rigid, or a mesh that moves through frames.

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
        Interpolation of the motion between keyframes or frames. ``monotone``: smooth, and never beyond two
        neighbouring keyframes; ``hermite``: smooth, as the original Lyra's, but swings beyond keyframes
        before a hold; ``linear``.
    friction : float or Friction or None
        Friction coefficient, instead of that of ``contact``.
    """

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

    def check(self) -> None:
        """Refuse several shapes, and sheets inside of a plane or a mesh."""
        self.require_one(*SHAPES)
        require(
            not self.inside or self.present("sphere", "capsule", "box"),
            "is for sphere, capsule and box; a plane is free on the side of its normal, and a mesh on both",
            "inside",
        )
        require(
            self.motion is None or self.mesh is None or self.mesh.frames is None,
            "is a second motion beside mesh.frames; leave one of them out",
            "motion",
        )

    @property
    def shape(self) -> str:
        """The key of `SHAPES` that is given."""
        return self.present(*SHAPES)[0]


class AppliedLoad(VertexChoice):
    """A force, a pressure, a traction, a moment, or what fills a closed volume.

    A *curve* is a list of points ``[[t, value], …]``, linear between them and constant before and after, or a
    ``.csv`` file: a heading, then time and value (or x, y, z) in each line; its path is relative to the scene
    file. Steps end at its kinks. In a static analysis t is the load factor, and the load does not grow in
    proportion to it.

    Attributes
    ----------
    group : str or None
        A group of the mesh, or the name of a sheet. For pressure and traction a surface group, by default all
        triangles; for a moment a group of boundary edges.
    force : (3,) or curve [N] or None
        Total force, shared by the selected vertices.
    pressure : float or curve [Pa] or None
        Pressure along the current normal.
    traction : (3,) or curve [N/m²] or None
        Force per rest area, of fixed direction.
    moment : float or curve [N·m/m] or None
        Moment per rest length about the current direction of the boundary edges; a positive one lifts their
        free side towards the normal of the sheet. Needs ``midedge``.
    gas : Gas or None
        Gas in a closed volume; its pressure follows the volume. The block has a group of its own.
    liquid : Liquid or None
        Liquid that fills a closed volume.
    start, until : float [s]
        The load acts for from ≤ t ≤ until; by default always. Not with gas and liquid.
    """

    unsupported: ClassVar[dict[str, str]] = {
        "volume": "a pressure knows no volume; in a closed volume it follows as "
        "gas: {pressure: 200}, or liquid: {volume: 0.1}"
    }

    force: VectorInTime | None = None
    pressure: NumberInTime | None = None
    traction: VectorInTime | None = None
    moment: NumberInTime | None = None
    gas: Gas | None = None
    liquid: Liquid | None = None
    start: Number = Field(default=0.0, alias="from")
    until: Until = math.inf

    @property
    def chamber(self) -> Gas | Liquid | None:
        """What fills a closed volume."""
        return self.gas or self.liquid

    def check(self) -> None:
        """Refuse several loads, and vertices or triangles on which a load cannot act."""
        self.require_one("force", "pressure", "traction", "moment", "gas", "liquid")
        for kind in self.present("gas", "liquid"):
            for key in self.present("group", "nodes", "box"):
                raise problem(f"belongs into the block: {kind}: {{group: …}}", key)
            require(
                (self.start, self.until) == (0.0, math.inf), "acts always; leave out from and until", kind
            )
        chosen = self.present("group", "nodes", "box")
        self.require_with("force", len(chosen) == 1, "needs exactly one of group, nodes, box to act on")
        for kind in self.present("pressure", "traction"):
            for key in self.present("box", "nodes"):
                raise problem(f"cannot select triangles for {kind}; use group", key)
        self.require_with("moment", self.group is not None, "needs a group of boundary edges to act on")
        _check_window(self.start, self.until)


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

    velocity: Velocity = (0.0, 0.0, 0.0)
    angular_velocity: Vector = (0.0, 0.0, 0.0)
    noise: NonNegative = 0.0
    seed: Seed = 0


Analysis = Literal["dynamic", "static"]
Integrator = Literal["beuler", "semi-implicit", "midpoint", "alpha2", "bdf2"]
INTEGRATORS: tuple[str, ...] = get_args(Integrator)
FIELD_UNITS = {
    "velocity": "m/s",
    "displacement": "m",
    "green_strain": "1",
    "stress": "N/m",
    "membrane_energy": "J/m²",
    "bending_energy": "J/m²",
    "curvature": "1/m",
    "curvature_tensor": "1/m",
    "plastic_curvature": "1/m",
    "contact_pressure": "Pa",
    "rank": "1",
}
FIELDS = tuple(FIELD_UNITS)

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

    conditional_defaults = frozenset({"end", "step"})

    analysis: Analysis = "dynamic"
    end: Positive
    step: StepLength
    tolerance: Positive | None = None
    integrator: Integrator | None = None
    spectral_radius: Fraction | None = None

    def check(self) -> None:
        """Refuse keys for another analysis, integrator or kind of steps."""
        if self.static:
            for key in self.present("integrator", "tolerance", "spectral_radius"):
                raise problem(_MEANINGLESS, key)
            require(self.end == 1.0, "is 1 in a static analysis (the full load); leave it out", "end")
            require(
                isinstance(self.step, float) and self.step <= 1.0,
                f"is the first increment of the load factor, at most 1, not {self.step!r}",
                "step",
            )
        self.require_with("tolerance", self.adaptive, "is for step: auto; with a fixed step leave it out")
        if self.tolerance is not None:
            least = f"is at least 1e-12, not {self.tolerance:g}: double precision reaches no less"
            require(self.tolerance >= 1e-12, least, "tolerance")
            most = f"is a fraction of the sheet's size, below 1, not {self.tolerance:g}"
            require(self.tolerance < 1.0, most, "tolerance")
        self.require_with(
            "spectral_radius",
            self.integrator == "alpha2",
            f"is for integrator: alpha2; {self.integrator} has none, leave it out",
        )

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
            return {"end": 1.0, "step": 0.25, **data}
        data = {"integrator": "beuler", **data}
        if data.get("step") == "auto":
            data.setdefault("tolerance", 1e-3)
        if data["integrator"] == "alpha2":
            data.setdefault("spectral_radius", 0.5)
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
    fields: Annotated[list[str], WithJsonSchema({"type": "array", "items": {"enum": list(FIELDS)}})] = Field(
        default_factory=list
    )
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
    seams : list of Seam
        Pairs of groups of boundary edges that are sewn together.
    material : list of Material
        One material, or a list. At most one has no group; it applies to the triangles in no other's group.
    gravity : (3,) or curve [m/s²] or None
        Acceleration of gravity; without this key there is none.
    wind : UniformWind or None
        Uniform wind; without this key there is no air.
    attachments : list of Attachment
        Springs between points of the sheets: buttons, pockets, ends of cables.
    handles : list of Handle
        Vertices whose motion is prescribed, or which springs pull.
    motions : dict of list of Keyframe
        Motions of handles and obstacles, by name; times are strictly ascending.
    contact : Contact or None
        Contact; without this key surfaces penetrate each other.
    obstacles : dict of Obstacle or None
        Rigid obstacles, by name.
    loads : list of AppliedLoad
        Forces, pressures, tractions, moments and enclosed volumes.
    creases : list of Crease
        Edges with rest angles and a stiffness of their own.
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

    unsupported: ClassVar[dict[str, str]] = dict.fromkeys(
        ("stitches", "stitch", "sewing", "sew"),
        "edges are sewn by seams: [{between: [front/side, back/side], close: {from: 0, until: 1}}]",
    )

    title: Text = ""
    mesh: Annotated[list[MeshSource], BeforeValidator(_one_or_many)]
    seams: Annotated[list[Seam], list_of()] = Field(default_factory=list)
    material: Annotated[list[Material], BeforeValidator(_one_or_many)]
    gravity: VectorInTime | None = None
    wind: UniformWind | None = None
    attachments: Annotated[list[Attachment], list_of()] = Field(default_factory=list)
    handles: Annotated[list[Handle], list_of()] = Field(default_factory=list)
    motions: Annotated[dict[Name, Keyframes], block_of("names")] = Field(default_factory=dict)
    contact: Contact | None = None
    obstacles: Annotated[dict[Name, Obstacle], block_of("names")] | None = None
    loads: Annotated[list[AppliedLoad], list_of()] = Field(default_factory=list)
    creases: Annotated[list[Crease], list_of()] = Field(default_factory=list)
    initial: Initial | None = None
    time: Time
    output: Output = Field(default_factory=Output)
    probes: Annotated[dict[Name, Selector], block_of("names")] = Field(default_factory=dict)
    solver: Solver = Field(default_factory=Solver)
    render: Render | None = None
    fit: Fit | None = None
    petsc: Annotated[dict[str, PetscValue], BeforeValidator(petsc_options)] = Field(default_factory=dict)

    _source: Path | None = PrivateAttr(default=None)
    _content: dict[str, Any] | None = PrivateAttr(default=None)
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
        """Files of sheets, obstacles and frames, by their keys."""
        files: dict[tuple[str | int, ...], Path] = {}
        for i, source in enumerate(self.mesh):
            if source.file is not None:
                files["mesh", i, "file"] = source.file
            if source.pattern is not None:
                files["mesh", i, "pattern"] = source.pattern
        for name, obstacle in (self.obstacles or {}).items():
            if obstacle.mesh is not None:
                files["obstacles", name, "mesh", "file"] = obstacle.mesh.file
                files |= _frame_files(obstacle.mesh.frames, "obstacles", name, "mesh", "frames")
        for i, handle in enumerate(self.handles):
            files |= _frame_files(handle.frames, "handles", i, "frames")
        return files

    @property
    def has_frames(self) -> bool:
        """Whether anything moves through frames."""
        meshes = (obstacle.mesh for obstacle in (self.obstacles or {}).values())
        return any(block is not None and block.frames is not None for block in (*meshes, *self.handles))

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

    def check(self) -> None:
        """Refuse blocks that do not go together, and names that nothing has."""
        if self.time.static and self.initial is not None:  # a static analysis starts at rest
            for key in ("velocity", "angular_velocity"):
                require(not any(self.initial.get(key)), _MEANINGLESS, "initial", key)
        self.require_with(
            "obstacles",
            self.contact is not None,
            "have no effect without contact; add the line 'contact: {friction: 0.3}'",
        )
        smallest = self.time.end * SMALLEST_STEP
        for value, at in ((self.time.step, ("time", "step")), (self.output.every, ("output", "every"))):
            if isinstance(value, float):
                require(value >= smallest, _too_small(value, self.time.end), *at)
        self._check_references()

    def _check_references(self) -> None:
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
                    text = f"{where} scales in keyframe {i}, but an obstacle is rigid: leave out scale"
                    raise problem(text, *at, "motion")
        groups: set[str | None] = set()
        for i, material in enumerate(self.material):
            if material.group in groups:
                others = "triangles without a group of their own"
                named = f"group {material.group!r}" if material.group else others
                raise problem(f"is a second material for the {named}", "material", i, "group")
            groups.add(material.group)
        names = [source.name for source in self.mesh]
        for i, sheet in enumerate(names):
            text = f"{sheet!r} is the name of an earlier sheet too"
            require(sheet is None or sheet not in names[:i], text, "mesh", i, "name")

    def _check_motion(self, motion: str | None, *at: str | int) -> None:
        if motion is not None and motion not in self.motions:
            raise problem(f"unknown motion {motion!r}, {suggest(motion, self.motions)}", *at, "motion")

    def keyframes(self, obstacle: Obstacle) -> list[Keyframe]:
        """Keyframes of the motion of an obstacle of the scene; none if it is at rest."""
        motion = obstacle.motion
        if isinstance(motion, str):
            return self.motions[motion]
        return motion if isinstance(motion, list) else []


def _frame_files(frames: Any, *at: str | int) -> dict[tuple[str | int, ...], Path]:
    """Files of frames by their keys, without those of a pattern."""
    if isinstance(frames, tuple):
        return {(*at, i): file for i, file in enumerate(frames)}
    return {} if frames is None or "*" in frames.name else {at: frames}


def _check_keyframes(keyframes: list[Keyframe], *at: str | int) -> None:
    if not keyframes:
        raise problem("must hold at least one keyframe", *at)
    for i in range(1, len(keyframes)):
        before, time = keyframes[i - 1].time, keyframes[i].time
        if time <= before:
            raise problem(
                f"must be later than the keyframe before ({before:g} s), not {time:g}", *at, i, "time"
            )
