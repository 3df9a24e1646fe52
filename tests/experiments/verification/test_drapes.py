"""Agreement of drapes: starts, meshes and statistics."""

from __future__ import annotations

import math

import numpy as np
import pytest
from mpi4py import MPI

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.experiments import drape
from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.drape import CLOTH, STARTS
from lyra_petsc.experiments.meshes import ring_disc
from lyra_petsc.experiments.verification.cases import drapes
from lyra_petsc.stepping.simulation import StepReport


def edges(faces: Ints) -> tuple[Ints, Ints]:
    """Edges (n, 2) of triangles, and the number of triangles of each."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return np.unique(np.sort(pairs, axis=1), axis=0, return_counts=True)


def lengths(x: Array, pairs: Ints) -> Array:
    return np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)


@pytest.mark.parametrize("n", [1, 2, 5])
def test_rings_fill_a_polygon(n: int) -> None:
    vertices, faces = ring_disc(n)
    sides = vertices[faces][:, 1:, :2] - vertices[faces][:, :1, :2]
    areas = 0.5 * np.linalg.det(sides)
    pairs, counts = edges(faces)
    assert areas.min() > 0.0
    assert areas.sum() == pytest.approx(3 * n * math.sin(math.pi / (3 * n)))
    assert np.sum(counts == 1) == 6 * n
    assert counts.max() <= 2
    assert len(vertices) - len(pairs) + len(faces) == 1
    assert len(faces) == 6 * n**2
    assert lengths(vertices, pairs).max() < 1.5 / n


@pytest.fixture
def starts(comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch) -> list[tuple[Array, Ints, Array]]:
    """Initial positions, triangles and material coordinates of all drapes on the finest meshes."""
    seen: list[tuple[Array, Ints, Array]] = []

    def scene(
        bench: Bench,
        start: Array,
        faces: Ints,
        rest: Array,
        material: object,
        seed: int,
        gap: float,
        **_: int,
    ) -> Array:
        assert lengths(rest, edges(faces)[0]).min() > gap
        seen.append((start, faces, rest))
        return start

    monkeypatch.setattr(drapes, "drape_scene", scene)
    monkeypatch.setattr(drapes, "drape_cloth", lambda bench, start, speed: start)
    monkeypatch.setattr(drapes, "PIXELS", 8)
    with Bench(comm) as bench:
        list(drapes.cusick.measure(bench, drapes.cusick.resolutions[-1]))
    return seen


def test_starts_of_drapes_have_independent_waves_and_small_strains(
    starts: list[tuple[Array, Ints, Array]],
) -> None:
    at, waves = np.radians(np.arange(0.0, 360.0, 5.0)), []
    for start, faces, rest in starts:
        pairs = edges(faces)[0]
        assert np.max(lengths(start, pairs) / lengths(rest, pairs)) < 1.2
        rim = np.hypot(*rest.T) > 0.999 * CLOTH
        angle = np.arctan2(rest[rim, 1], rest[rim, 0])
        wave = np.interp(at, angle[np.argsort(angle)], start[rim, 2][np.argsort(angle)], period=2.0 * math.pi)
        waves.append(wave - wave.mean())
    alike = np.corrcoef(waves) - np.eye(len(waves))
    assert np.abs(alike).max() < 0.8
    assert abs(alike.mean()) < 0.1


def test_mesh_directions_are_random(starts: list[tuple[Array, Ints, Array]]) -> None:
    turned = np.array([math.atan2(*(rest[0] - rest.mean(axis=0))[::-1]) for _, _, rest in starts[:STARTS]])
    assert abs(np.exp(1j * turned).mean()) < 0.9
    assert np.ptp(turned) > 1.0


@pytest.mark.parallel(2)
def test_friction_at_the_disc_does_not_throw_vertices_off(
    comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stretched cloth presses on the disc's edge with a thousand times its weight, and less after sliding.

    Taking back the friction of the higher force once created 0.5 J.
    """
    step, rises = Trial.step, []

    def watched(trial: Trial) -> StepReport:
        x, energy = trial.x, trial.simulation.budget.total
        report = step(trial)
        rises.append(trial.simulation.budget.total - energy)
        assert np.abs(trial.v - (trial.x - x) / report.dt).max() < 0.1
        return report

    monkeypatch.setattr(Trial, "step", watched)
    monkeypatch.setattr(drape, "STEPS", 2)
    with Bench(comm) as bench:
        drapes._drape(bench, "rings", 8, 1)
    assert max(rises) < 0.0


FOLDS = np.random.default_rng(5)


def drawn(mean: float, scatter: float = 0.01) -> list[float]:
    return FOLDS.normal(mean, scatter, STARTS).tolist()


def test_a_biased_kind_of_mesh_fails() -> None:
    found = [drapes.scatter_of_means([*(drawn(0.80) for _ in range(3)), drawn(0.84)]) for _ in range(200)]
    assert (np.array(found) > 1.0).mean() > 0.9


def test_kinds_of_mesh_that_differ_by_chance_pass() -> None:
    found = [drapes.scatter_of_means([drawn(0.80) for _ in range(4)]) for _ in range(1000)]
    assert 0.01 < (np.array(found) > 1.0).mean() < 0.05


def test_the_scatter_follows_the_formula() -> None:
    assert drapes.scatter_of_means([[0.0, 2.0], [2.0, 4.0]]) == pytest.approx(math.sqrt(2.0) / 2.0)
