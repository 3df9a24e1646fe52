"""Small vibrations of plates and strips that bend by directors."""

from __future__ import annotations

from collections.abc import Iterator

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.meshes import SIDES
from lyra_petsc.experiments.verification.answers import ASSEMBLED, Measured, at_finest, case, data, scene
from lyra_petsc.experiments.verification.flat_plates import KINDS, flat_mesh, plate_material
from lyra_petsc.experiments.verification.spectrum import lowest_modes

EXACT = data("plate_vibrations")

CLAMPED = {"CCCC": SIDES, "CFFF": ("left",), "FFFF": ()}

SHAPES = {"square": (1.0, 1), "strip": (0.2, 2)}
"""Height of plates of length 1 m, and how many times n cells they have along that."""

SHIFT = 400.0
"""1/s², of the order of the lowest square: what frees a free plate of its three rigid motions."""


@case(
    "Vibrating plates and strips (C clamped, F free edges), bending_model: midedge: the first three "
    "frequencies of the assembled K and M, without those of rigid motions",
    source=EXACT["source"],
    resolutions=(20, 40, 80),
    claim=at_finest(5e-3),
    quick=1,
    counts="cells along the square, twice as many along the strip",
)
def plate_vibration(bench: Bench, n: float) -> Iterator[Measured]:
    for shape, (height, finer) in SHAPES.items():
        for words, exact in EXACT[shape].items():
            edges, poisson = words.split()
            for kind in KINDS:
                mesh = flat_mesh(bench, kind, round(finer * n), round(finer * n * height), 1.0, height)
                clamped = [{"group": side, "clamp": True} for side in CLAMPED[edges]]
                held = [{"group": "sheet", "axes": ["x", "y"]}, *clamped]
                material = plate_material(1.0, poisson=float(poisson))
                rigid = 0 if clamped else 3
                with bench.simulation(scene(mesh, material, ASSEMBLED, handles=held)) as trial:
                    found, _ = lowest_modes(trial, rigid + len(exact), shift=SHIFT if rigid else 0.0)
                for number, (omega, wanted) in enumerate(zip(found[rigid:], exact, strict=True), 1):
                    name = f"λ{number}, {shape}, {edges}, ν = {poisson}, {kind}"
                    yield Measured(name, float(omega), float(wanted))
