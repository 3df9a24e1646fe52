"""Loads scenes from files or dictionaries."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

from lyra_petsc.errors import InputError, python_argument_names
from lyra_petsc.scene.load import default_scene, load_scene, scene_of
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.values import shown

SceneLike: TypeAlias = Scene | str | Path | Mapping[str, Any]


def load(
    source: SceneLike | None = None, changes: Mapping[str, Any] | None = None, *, trust_mesh: bool = False
) -> Scene:
    """Load and check a scene.

    Parameters
    ----------
    source : path, mapping or Scene, optional
        A scene file, or its keys as nested dictionaries; default is the default scene, a flag.
    changes : mapping of ``key.path`` to value, optional
        As in ``{"time.end": 2.0, "handles[0].until": 1.0}``; None removes a key.
    trust_mesh : bool
        Let this scene's scripts (.geo) read any file, and run where there is no seccomp.

    Returns
    -------
    Scene
        Its attributes have the names of the scene file's keys; ``scene.changed({…})`` returns a changed copy.

    Raises
    ------
    InputError
        For invalid input, naming file and key.
    """
    with python_argument_names():
        if isinstance(source, Mapping):
            scene = scene_of(source, changes)
        elif source is not None and not isinstance(source, Scene | str | os.PathLike):
            raise InputError(f"must be a file, keys of a scene, or a Scene, not {shown(source)}", key="scene")
        else:
            scene = source if isinstance(source, Scene) else load_scene(source or default_scene())
            scene = scene.changed(changes) if changes else scene
        return scene.trusting_meshes() if trust_mesh else scene
