"""Types of the entries of summary.json that readers rely on."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel


class _Key(BaseModel):
    key: str = ""


class _Motion(BaseModel):
    motion: list[dict[str, Any]] = []
    interpolation: str = "monotone"


class _Resumption(BaseModel):
    step: int = 0
    time: float = 0.0
    ranks: int = 1
    changes: list[_Key] = []
    earlier_motions: dict[str, _Motion] = {}


class _Failure(BaseModel):
    advice: list[str] = []


class Summary(BaseModel):
    """Entries of summary.json; any entry may be missing, and further entries are allowed."""

    title: str | None = None
    outcome: str = ""
    ranks: int = 1
    sizes: dict[str, int] = {}
    terms: list[str] = []
    linear_solver: str = ""
    versions: dict[str, str] = {}
    petsc_options: dict[str, str | None] = {}
    unused_petsc_options: list[str] = []
    integrator: str = ""
    time: float = 0.0
    estimated_error: float | None = None
    steps: int = 0
    wall_seconds: dict[str, float] = {}
    notes: list[str] = []
    resumed: list[_Resumption] = []
    failure: _Failure = _Failure()
