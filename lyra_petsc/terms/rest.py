"""The rest shape with its materials, on rank 0 during set-up, from which terms build their elements."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.measures import rest_matrices
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.mesh.select import in_group, select_triangles
from lyra_petsc.mesh.topology import Hinges, hinges, junctions, unique_edges
from lyra_petsc.scene.materials.library import ShellMaterial, resolve_material
from lyra_petsc.scene.schema import Scene

if TYPE_CHECKING:
    from lyra_petsc.mesh.seams import SeamHinges


LARGEST_FOLD = np.radians(179.9)
"""Angle [rad] at the start from which a fold has no side that round-off does not choose."""


class RestShape:
    """A scene's mesh with a material on each triangle.

    Attributes
    ----------
    scene : Scene
    mesh : Mesh
    shells : list of ShellMaterial
        One per material block of the scene.
    shell_of : (F,) int64
        Index of each triangle's material in ``shells``.
    inverse : (F, 2, 2) float64
        Inverse rest matrices in material axes [1/m].
    area : (F,) float64
        Rest areas [m²].
    notes : list of str
        Notes on the materials and the mesh for the user.

    Raises
    ------
    InputError
        If the mesh lacks the group of a material, a triangle has no material, or neighbours have different
        bending models.
    """

    def __init__(self, scene: Scene, mesh: Mesh) -> None:
        self.scene, self.mesh = scene, mesh
        self.notes: list[str] = []
        self.shells: list[ShellMaterial] = []
        self.shell_of = np.full(mesh.n_triangles, -1, dtype=np.int64)
        default = -1
        for number, block in enumerate(scene.material):
            shell, notes = resolve_material(block, file=scene.source, key=f"material[{number}]")
            self.shells.append(shell)
            self.notes += notes
            if block.group is None:
                default = number
                continue
            chosen = select_triangles(mesh, block.group, key=f"material[{number}].group", file=scene.source)
            self.shell_of[chosen] = number
        self.shell_of[self.shell_of < 0] = default
        bare = np.flatnonzero(self.shell_of < 0)
        if len(bare):
            raise InputError(
                f"{len(bare)} triangles (first: {bare[0]}) lie in no material's group; "
                "add a material without a group for them",
                file=scene.source,
                key="material",
            )
        self._check_models()
        self.inverse, self.area = rest_matrices(mesh, self.per_triangle("warp_degrees"))

    def _check_models(self) -> None:
        """Refuse neighbouring triangles with different bending models."""
        if len({shell.model for shell in self.shells if shell.bends_with(shell.model)}) < 2:
            return
        models = np.where(self.bends_with("midedge"), 1, 0) - np.where(self.bends_with("hinge"), 1, 0)
        triangles = self.hinges.triangles
        mixed = np.flatnonzero(models[triangles[:, 0]] * models[triangles[:, 1]] < 0)
        if len(mixed):
            one, two = triangles[mixed[0]]
            numbers = sorted({int(self.shell_of[one]), int(self.shell_of[two])})
            raise InputError(
                f"triangles {one} and {two} are neighbours with different bending models; give one "
                "bending_model to all materials of a sheet",
                file=self.scene.source,
                key=f"material[{numbers[1]}].bending_model",
            )

    def per_triangle(self, attribute: str) -> NDArray[np.float64]:
        """A scalar attribute of ShellMaterial on each triangle, (F,)."""
        values = np.array([getattr(shell, attribute) for shell in self.shells], dtype=np.float64)
        return values[self.shell_of]

    def bends_with(self, model: str) -> NDArray[np.bool_]:
        """Whether each triangle resists bending by this model, (F,)."""
        return np.array([shell.bends_with(model) for shell in self.shells])[self.shell_of]

    @cached_property
    def mass(self) -> NDArray[np.float64]:
        """Lumped mass [kg] of each vertex, (V,): one third of the mass of each of its triangles."""
        shares = np.repeat(self.area * self.per_triangle("density") / 3.0, 3)
        corners = self.mesh.triangles.ravel()
        lumped = np.bincount(corners, weights=shares, minlength=self.mesh.n_vertices)
        return np.asarray(lumped, dtype=np.float64)

    @cached_property
    def edges(self) -> NDArray[np.int64]:
        """Vertices (N, 2) of all edges, the smaller first; `Elements.edges` are indices into this array."""
        return unique_edges(self.mesh.triangles)

    @cached_property
    def hinges(self) -> Hinges:
        """The edges with two triangles, computed when a term first needs them."""
        self._check_junctions()
        return hinges(self.mesh.triangles)

    @cached_property
    def crease_of(self) -> NDArray[np.int64]:
        """Number (H,) of the crease of the scene that each of the ``hinges`` is in, −1 for none.

        Raises
        ------
        InputError
            Unknown group, or an edge in two creases.
        """
        crease, scene = np.full(len(self.hinges.vertices), -1, dtype=np.int64), self.scene
        for number, block in enumerate(scene.creases):
            key = f"creases[{number}].group"
            chosen = in_group(self.mesh, self.hinges.vertices[:, :2], block.group, key=key, file=scene.source)
            twice = np.flatnonzero(chosen & (crease >= 0))
            if len(twice):
                a, b = self.hinges.vertices[twice[0], :2]
                raise InputError(
                    f"the edge of vertices {a} and {b} is in '{block.group}' and in creases"
                    f"[{crease[twice[0]]}] '{scene.creases[crease[twice[0]]].group}'; give it one crease",
                    file=scene.source,
                    key=key,
                )
            crease[chosen] = number
        return crease

    @cached_property
    def seam_hinges(self) -> SeamHinges:
        """The hinges across the seams of the scene."""
        from lyra_petsc.mesh.seams import seam_hinges  # only scenes with seams need it

        return seam_hinges(self.scene, self.mesh, self.hinges)

    @cached_property
    def own_bending(self) -> NDArray[np.bool_]:
        """Whether the sheet's bending leaves out each of the ``hinges``, (H,): at creases, and where seams
        join its edges without bending as the sheet.
        """
        own = self.crease_of >= 0
        if self.scene.seams:
            as_sheet = np.array([seam.bends_as_sheet for seam in self.scene.seams])
            sewn = self.seam_hinges
            own[sewn.hinge[(sewn.hinge >= 0) & ~as_sheet[sewn.seam]]] = True
        return own

    @cached_property
    def seam_angles(self) -> NDArray[np.float64]:
        """Rest angle [rad] that a seam gives to the sheet's bending at each of the ``hinges``, (H,), or NaN.

        Raises
        ------
        InputError
            As `sewn_angles`.
        """
        angles = np.full(len(self.hinges.vertices), np.nan)
        if self.scene.seams:
            sewn = self.seam_hinges
            joined = sewn.hinge >= 0
            angles[sewn.hinge[joined]] = self.sewn_angles[joined]
            angles[self.own_bending] = np.nan
        return angles

    @cached_property
    def sewn_angles(self) -> NDArray[np.float64]:
        """Rest angle [rad] of each of the ``seam_hinges``, (n,); NaN where seams bend freely.

        Raises
        ------
        InputError
            Edges that are in a crease, too; or a seam that keeps the angle of a start shape folded by 180°.
        """
        scene, sewn = self.scene, self.seam_hinges
        angles = np.full(len(sewn.seam), np.nan)
        for number, seam in enumerate(scene.seams):
            mine, key = sewn.seam == number, f"seams[{number}].angle"
            if isinstance(seam.angle, float):
                angles[mine] = -np.radians(seam.angle)
            elif seam.angle == "rest":
                angles[mine] = sewn.start_angle[mine]
                if (np.abs(angles[mine]) > LARGEST_FOLD).any():
                    message = (
                        "the start shape is folded by 180° at the seam, to an unknown side; give degrees"
                    )
                    raise InputError(message, file=scene.source, key=key)
            bends = sewn.hinge[mine & ~np.isnan(angles) & (sewn.hinge >= 0)]
            if len(creased := bends[self.crease_of[bends] >= 0]):
                block = scene.creases[self.crease_of[creased[0]]].group
                message = f"an edge of the seam is in the crease '{block}', too; leave one of them out"
                raise InputError(message, file=scene.source, key=key)
        return angles

    def _check_junctions(self) -> None:
        """Refuse edges of more than two triangles, for which a hinge's angle is undefined."""
        bends = self.bends_with("hinge")
        wrong = [triangles for triangles in junctions(self.mesh.triangles) if bends[triangles].any()]
        if wrong:
            edges = [self._edge_text(triangles) for triangles in wrong[:5]]
            more = f" and {len(wrong) - 5} more" if len(wrong) > 5 else ""
            raise InputError(
                f"edges of more than two triangles: {'; '.join(edges)}{more} (counted from 0); hinges cannot "
                "bend there: give the material bending_model: midedge",
                file=self.scene.source,
                key="mesh",
            )

    def _edge_text(self, triangles: NDArray[np.int64]) -> str:
        corners = [set(corners) for corners in self.mesh.triangles[triangles].tolist()]
        low, high = sorted(set.intersection(*corners))
        return f"vertices {low}-{high} in triangles {', '.join(map(str, triangles))}"
