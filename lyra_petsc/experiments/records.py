"""Dataclasses as JSON files: requests, jobs and results that outlive a process."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from pydantic import TypeAdapter

from lyra_petsc.output.atomic import replace_text

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T")


def save(path: Path, record: DataclassInstance) -> None:
    """Write a record; the file is the old or the new one, never half. Call on one rank."""
    replace_text(path, json.dumps(asdict(record), indent=2, ensure_ascii=False) + "\n")


def load(path: Path, kind: type[T]) -> T:
    """The record in a file; what it holds beside the fields is passed over.

    Raises
    ------
    OSError, ValueError
        If it cannot be read, or holds no such record.
    """
    return TypeAdapter(kind).validate_json(path.read_bytes())
