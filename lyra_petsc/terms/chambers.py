"""Gas or liquid in closed volumes V: the energy ∫ p dV from V to the volume Va without gauge pressure p.

Gas: p + ambient = a^γ P0 (V0/V)^γ, with the exponent γ, the amount a, and P0 and V0 of the start, and

    U = ambient (Va L φ((γ − 1) L) + V − Va),  L = ln(Va/V),  φ(z) = (eᶻ − 1)/z,  φ(0) = 1

with Va = a V0 (P0/ambient)^(1/γ). It is the least work that fills the chamber from outside.

Liquid of volume Vl and bulk modulus K: U = ½ K (V − Vl)²/Vr, with the largest Vl as Vr.

The gradient is −p ∂V/∂x: the pressure acts along the current normals. The Hessian is −p ∂²V/∂x², the sum of
symmetric blocks of the triangles, plus −p′(V) g gᵀ with g = ∂V/∂x, of all vertices of a chamber with all.

V = ⅙ Σ xₐ · (x_b × x_c) over the triangles, which are oriented outwards. As the surface is closed, it does
not depend on the origin.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.errors import InputError
from lyra_petsc.kernels.element import inlined, kernel
from lyra_petsc.kernels.vector3 import cross, dot, minus, point
from lyra_petsc.mesh.closed_surface import branches, holes, outward, sewn_shut
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.mesh.select import select_triangles
from lyra_petsc.mesh.topology import enclosed_volumes
from lyra_petsc.scene.gas_block import Chamber, Gas, Liquid
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.time_curve import TimeCurve, is_curve
from lyra_petsc.terms.protocols import GlobalSums, MovingTargets, WritesTable
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import UpcomingStep

BULK_MODULUS = 2.2e9
"""Bulk modulus [Pa] of liquids: that of water."""

FLAT = 1e-6
"""Volume over the power 3/2 of the area up to which a surface is flat."""

ROUND_OFF = 32.0 * float(np.finfo(np.float64).eps)
"""Round-off of a volume, over the power 3/2 of the area, of the sums over triangles and ranks."""

COLLAPSED = 1e-12
"""Smallest volume, over that at the start, at which forces are evaluated; energies are infinite from 0 on."""


class Filling(NamedTuple):
    """Frozen data: the amounts of what fills the chambers, their middles, and, at positions, the volumes.

    Attributes
    ----------
    amount : (k,)
        Relative amount of gas, or volume [m³] of liquid.
    origin : (k, 3)
        Points [m] inside, relative to which coordinates are small.
    volume : (k,) or None
        Volume [m³] of each chamber.
    """

    amount: Array
    origin: Array
    volume: Array | None = None


@inlined()
def corner(x, s, e, k, origin, n):  # type: ignore[no-untyped-def]
    """Corner k of triangle e of s (E, 3), relative to the n-th origin."""
    return minus(point(x, s[e, k % 3]), point(origin, n))


@kernel()
def add_volumes(x, s, n, chamber, origin, out):  # type: ignore[no-untyped-def]
    """Add the volumes [m³] below the first n of triangles s (E, 3) to those of their chambers, out (k,)."""
    for e in range(n):
        m = chamber[e]
        a, b, c = (
            corner(x, s, e, 0, origin, m),
            corner(x, s, e, 1, origin, m),
            corner(x, s, e, 2, origin, m),
        )
        out[m] += dot(a, cross(b, c)) / 6.0


@kernel()
def add_gradient(x, s, chamber, origin, weight, out):  # type: ignore[no-untyped-def]
    """Add the gradient of each volume times ``weight`` (k,) to out (n_local, 3)."""
    for e in range(s.shape[0]):
        factor = weight[chamber[e]] / 6.0
        for k in range(3):
            m = chamber[e]
            normal = cross(corner(x, s, e, k + 1, origin, m), corner(x, s, e, k + 2, origin, m))
            i = s[e, k]
            for axis in range(3):
                out[i, axis] += factor * normal[axis]


@kernel()
def hessians(x, s, chamber, origin, weight, out):  # type: ignore[no-untyped-def]
    """Write the Hessians of the triangles' volumes times ``weight`` (k,) to out (E, 3, 3, 3, 3)."""
    out[:] = 0.0
    for e in range(s.shape[0]):
        factor = weight[chamber[e]] / 6.0
        for k in range(3):
            # ∂/∂x_b (x_b × x_c): corners k and k + 1 by the third
            i, j = k, (k + 1) % 3
            c = corner(x, s, e, k + 2, origin, chamber[e])
            block = out[e, i, j]
            block[0, 1], block[0, 2] = factor * c[2], -factor * c[1]
            block[1, 0], block[1, 2] = -factor * c[2], factor * c[0]
            block[2, 0], block[2, 1] = factor * c[1], -factor * c[0]
            for p in range(3):
                for q in range(3):
                    out[e, j, i, q, p] = block[p, q]


class Chambers(GlobalSums, MovingTargets, WritesTable):
    """All closed volumes of a scene.

    Parameters
    ----------
    elements : Elements
        Stencil (E, 3), oriented outwards; data ``chamber`` (E,) its number; ``volume`` (E,) [m³] and ``area``
        (E,) [m²] of the chamber at the start, and ``share`` (E,), the inverse number of its triangles.
    fillings : list of Gas or Liquid
        The blocks of the scene.
    static : bool
        Whether a static analysis lets them in.
    """

    table = "volumes.csv"
    table_columns = ("name", "volume", "pressure", "amount")
    table_units = ("", "m³", "Pa", "")

    def __init__(self, elements: Elements, fillings: list[Gas | Liquid], *, static: bool) -> None:
        super().__init__(elements)
        self._fillings, self._static = fillings, static
        self._chamber = elements.data["chamber"].astype(np.int64)
        self._share = elements.data["share"]
        self._is_gas = np.array([isinstance(filling, Gas) for filling in fillings])
        gases = [filling if isinstance(filling, Gas) else None for filling in fillings]
        self._exponent = np.array([gas.exponent if gas else 1.0 for gas in gases])
        self._ambient = np.array([gas.ambient if gas else 0.0 for gas in gases])
        self._start = np.array([gas.pressure + gas.ambient if gas else 0.0 for gas in gases])
        self._set_volume()

    def set_communication(self, over_ranks: Callable[[Array], Array]) -> None:
        super().set_communication(over_ranks)
        self._set_volume()

    def _set_volume(self) -> None:
        """Set the volumes at the start, which ranks without elements of a chamber do not know."""
        data, n = self.elements.data, self.n_owned
        self._volume, area = (
            self.over_ranks(self._by_chamber((self._share * data[name])[:n])) for name in ("volume", "area")
        )
        self._unresolved = ROUND_OFF * area**1.5
        with np.errstate(all="ignore"):  # of liquid
            self._relaxed = self._volume * (self._start / self._ambient) ** (1.0 / self._exponent)
        given = [filling.amount for filling in self._fillings]
        curves = [TimeCurve.of(v if a is None else a) for a, v in zip(given, self._volume, strict=True)]
        self._curves = curves
        self._largest = np.array([max(float(curve.largest), 1e-300) for curve in curves])

    def _by_chamber(self, values: Array) -> Array:
        """Sums (k,) over this rank's owned elements of each chamber."""
        return np.asarray(
            np.bincount(self._chamber[: self.n_owned], values, len(self._fillings)), dtype=np.float64
        )

    def freeze(self, step: UpcomingStep) -> Filling:
        count = len(self._fillings)
        corners = step.x[self.stencil[: self.n_owned, 0]] * self._share[: self.n_owned, None]
        middles = np.stack([self._by_chamber(coordinates) for coordinates in corners.T], axis=1)
        origin = self.over_ranks(middles.ravel()).reshape(count, 3)
        return Filling(self._amounts(step.target_time), origin)

    def _amounts(self, time: float) -> Array:
        """Amounts (k,) at a time [s]."""
        amounts = np.array([curve.at(time) for curve in self._curves])
        grows = np.array([self._static and not is_curve(filling.amount) for filling in self._fillings])
        with np.errstate(all="ignore"):  # of liquid
            end = self._start * amounts**self._exponent
            part = (self._ambient + time * (end - self._ambient)) / self._start
            gas = part ** (1.0 / self._exponent)
        liquid = self._volume + time * (amounts - self._volume)
        return np.where(grows, np.where(self._is_gas, gas, liquid), amounts)

    def at(self, x: Array, frozen: Filling) -> Filling:
        if frozen.volume is not None:
            return frozen
        volume = np.zeros(len(self._fillings))
        add_volumes(x, self.stencil, self.n_owned, self._chamber, frozen.origin, volume)
        return frozen._replace(volume=self.over_ranks(volume))

    def _state(self, x: Array, frozen: Filling) -> tuple[Array, Array]:
        """Volumes (k,) [m³], and absolute pressures (k,) [Pa]; of liquid gauge pressures."""
        volume = self.at(x, frozen).volume
        assert volume is not None
        above = np.maximum(volume, COLLAPSED * self._volume)
        with np.errstate(all="ignore"):
            gas = self._start * (frozen.amount * self._volume / above) ** self._exponent
        liquid = BULK_MODULUS / self._largest * (frozen.amount - volume)
        return volume, np.where(self._is_gas, gas, liquid)

    def _energies(self, volume: Array, amount: Array) -> Array:
        """Energy (k,) [J] of each chamber."""
        gas = np.where(volume > 0.0, sum(self._works(volume, amount)), np.inf)
        liquid = 0.5 * BULK_MODULUS / self._largest * (volume - amount) ** 2
        return np.where(self._is_gas, gas, liquid)

    def _works(self, volume: Array, amount: Array) -> tuple[Array, Array]:
        """Work (k,) [J] of gases as they expand from these volumes to ambient pressure, and against it."""
        with np.errstate(all="ignore"):
            relaxed = amount * self._relaxed
            rise = -np.log1p((volume - relaxed) / relaxed)
            work = self._ambient * relaxed * rise * _mean_growth((self._exponent - 1.0) * rise)
            return work, self._ambient * (volume - relaxed)

    def energies(self, x: Array, frozen: Filling) -> Array:
        """The energy of a chamber in equal parts on its triangles, (n_owned,) [J]."""
        filling = self.at(x, frozen)
        assert filling.volume is not None
        of_chambers = self._energies(filling.volume, frozen.amount)
        return of_chambers[self._chamber[: self.n_owned]] * self._share[: self.n_owned]

    def pressures(self, x: Array, frozen: Filling) -> Array:
        """Gauge pressures (k,) [Pa]."""
        return self._state(x, frozen)[1] - self._ambient

    def add_gradient(self, x: Array, frozen: Filling, out: Array) -> None:
        add_gradient(x, self.stencil, self._chamber, frozen.origin, -self.pressures(x, frozen), out)

    def hessians(self, x: Array, frozen: Filling, lo: int, hi: int, convexity: float, out: Array) -> None:
        weight = -(1.0 - convexity) * self.pressures(x, frozen)
        hessians(x, self.stencil[lo:hi], self._chamber[lo:hi], frozen.origin, weight, out)

    def _stiffness(self, x: Array, frozen: Filling) -> Array:
        """Fall of the pressures (k,) [Pa/m³] with the volumes."""
        volume, pressure = self._state(x, frozen)
        with np.errstate(all="ignore"):
            gas = self._exponent * pressure / np.maximum(volume, COLLAPSED * self._volume)
        return np.where(self._is_gas, gas, BULK_MODULUS / self._largest)

    def dense_hessian(self, x: Array, frozen: Filling) -> tuple[Array, Array]:
        weights = self._stiffness(x, frozen)
        vectors = np.zeros((len(weights), *x.shape))
        for unit, vector in zip(np.eye(len(weights)), vectors, strict=True):
            add_gradient(x, self.stencil, self._chamber, frozen.origin, unit, vector)
        return weights, vectors

    def targets(self, x: Array, frozen: Filling) -> tuple[Array, Array]:
        """The amounts, and this rank's part of the energy's derivatives by them."""
        volume, pressure = self._state(x, frozen)
        with np.errstate(all="ignore"):
            of_gas = self._exponent * self._works(volume, frozen.amount)[0] / frozen.amount
        slope = np.where(self._is_gas, of_gas, pressure)
        return frozen.amount, slope * self._by_chamber(self._share[: self.n_owned])

    def table_rows(self, x: Array, frozen: Filling) -> list[tuple[float | str, ...]]:
        filling = self.at(x, frozen)
        assert filling.volume is not None
        pressure, least = self.pressures(x, filling), self._stiffness(x, filling) * self._unresolved
        # one that the round-off of the volume makes is none
        pressure = np.where(np.abs(pressure) > least, pressure, 0.0)
        numbers = filling.volume, pressure, frozen.amount
        names = [filling.label for filling in self._fillings]
        return [(name, *map(float, row)) for name, *row in zip(names, *numbers, strict=True)]

    def force_scale(self, size: float) -> Array:
        """From the round-off of the normals, and of the pressure by that of the volume."""
        data = self.elements.data
        area, volume, share = data["area"], data["volume"], self._share
        gauge = np.abs(self._start - self._ambient)[self._chamber]
        own = area * share
        bulk = np.where(self._is_gas, self._exponent * self._start, BULK_MODULUS)[self._chamber]
        volume = np.maximum(volume, FLAT * area**1.5)
        return np.asarray(size * (gauge * np.sqrt(own) + bulk * own * area * np.sqrt(share) / volume))


def _mean_growth(z: Array) -> Array:
    """(eᶻ − 1)/z."""
    small = np.abs(z) < 1e-8
    safe = np.where(small, 1.0, z)
    return np.where(small, 1.0 + 0.5 * z, np.expm1(safe) / safe)


def elements(rest: RestShape) -> Elements:
    """The triangles of all chambers, normals outwards (rank 0)."""
    stencils: list[Ints] = []
    columns: dict[str, list[Array]] = {name: [] for name in ("chamber", "volume", "area", "share")}
    for number, load in enumerate(rest.scene.loads):
        if (chamber := load.chamber) is None:
            continue
        kind = "gas" if load.gas else "liquid"
        triangles = _closed(rest, chamber, f"loads[{number}].{kind}")
        points = rest.mesh.positions
        cross = np.cross(*(points[triangles[:, k]] - points[triangles[:, 0]] for k in (1, 2)))
        area = 0.5 * float(np.linalg.norm(cross, axis=1).sum())
        volume = float(enclosed_volumes(points, triangles, np.zeros(len(triangles), dtype=np.int64))[0])
        if kind == "gas" and volume <= FLAT * area**1.5:
            raise InputError(
                f"the surface encloses {volume:.3g} m³ at the start, and no gas; start from a shape with a "
                "volume, with vt in the .obj file for the flat rest shape, or take pressure",
                file=rest.scene.source,
                key=f"loads[{number}].gas",
            )
        for name, value in (
            ("chamber", len(stencils)),
            ("volume", volume),
            ("area", area),
            ("share", 1.0 / len(triangles)),
        ):
            columns[name].append(np.full(len(triangles), float(value)))
        stencils.append(triangles)
    return Elements(
        np.concatenate(stencils), {name: np.concatenate(parts) for name, parts in columns.items()}
    )


def _closed(rest: RestShape, chamber: Chamber, key: str) -> Ints:
    """The triangles (F, 3) of a chamber, normals outwards."""
    mesh, file = rest.mesh, rest.scene.source
    names = chamber.group or (None,)
    chosen = np.unique(
        np.concatenate([select_triangles(mesh, name, key=f"{key}.group", file=file) for name in names])
    )
    triangles = mesh.triangles[chosen]
    if rest.scene.seams:
        from lyra_petsc.mesh.seams import sewn_curves  # with seams only

        triangles = sewn_shut(triangles, sewn_curves(rest.scene, mesh))
    problem = _open(mesh, triangles)
    if not problem:
        shut, n = triangles, len(chosen)
        triangles, common = outward(mesh.positions, shut)
        turned = int((triangles[:n] != shut[:n]).any(axis=1).sum())  # not of those that fill gaps
        if common < 0:
            problem = "the surface has no inside: like a Klein bottle it cannot be oriented"
        elif turned:
            which = "the" if turned == n else f"{turned} of {n}"
            rest.notes.append(
                f"{key}: {which} normals point inwards; the pressure acts outwards all the same"
            )
    if problem:
        raise InputError(problem, file=file, key=key)
    return triangles


def _open(mesh: Mesh, triangles: Ints) -> str:
    """Why triangles (F, 3) are not a closed surface; empty if they are."""
    if len(gaps := holes(mesh.positions, triangles)):
        listed = [
            f"{hole.length:.4g} m long ({hole.n_edges} edges) around "
            f"({', '.join(f'{coordinate:.4g}' for coordinate in hole.centre)})"
            for hole in gaps[:3]
        ]
        more = f" and {len(gaps) - 3} more" if len(gaps) > 3 else ""
        count = "1 hole" if len(gaps) == 1 else f"{len(gaps)} holes"
        hint = f"; {mesh.unconnected}" if mesh.unconnected else ""
        return (
            f"the surface is not closed: {count}: {', '.join(listed)}{more}; close, weld or sew it, or name "
            f"the closed part by group{hint}"
        )
    if len(edges := branches(triangles)):
        a, b = edges[0]
        return (
            f"{len(edges)} edges of more than two triangles (first: {a}-{b}), so that the surface is not one "
            "closed volume; name its groups without walls, and a chamber for each side of a wall"
        )
    return ""


def make(elements: Elements, scene: Scene, mass: Array) -> Chambers:
    """The chambers on one rank."""
    fillings = [load.chamber for load in scene.loads if load.chamber is not None]
    return Chambers(elements, fillings, static=scene.time.static)
