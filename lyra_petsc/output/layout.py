"""Names of the files in a run's folder."""

from __future__ import annotations

import re

MESH_FILE, CELLS_FILE = "mesh.h5", "cells.h5"
XDMF_FILE, VTKHDF_FILE = "states.xdmf", "states.vtkhdf"
STATE_FILE = re.compile(r"states-(\d{4,})\.h5")
CHECKPOINT, PREVIOUS = "checkpoint.h5", "checkpoint-previous.h5"
HISTORY, PROBES, REACTIONS, OBSTACLES = "history.csv", "probes.csv", "reactions.csv", "obstacles.csv"
VOLUMES, ATTACHMENTS, SEAMS = "volumes.csv", "attachments.csv", "seams.csv"
SCENE_FILE, SUMMARY_FILE, LOCK_FILE = "scene.yaml", "summary.json", "run.lock"
FAILURE_DATA, FAILURE_XDMF, FAILURE_TEXT = "failure.h5", "failure.xdmf", "failure.txt"

_NAMES = (
    *(MESH_FILE, CELLS_FILE, XDMF_FILE, VTKHDF_FILE, CHECKPOINT, PREVIOUS),
    *(HISTORY, PROBES, REACTIONS, OBSTACLES, VOLUMES, ATTACHMENTS, SEAMS, SCENE_FILE, SUMMARY_FILE),
    *(FAILURE_DATA, FAILURE_XDMF, FAILURE_TEXT),
)

RESULT = re.compile(f"({'|'.join([STATE_FILE.pattern, *map(re.escape, _NAMES)])})" + r"(\.part)*")
"""All files that a run writes, also incomplete ones, and no other names."""
