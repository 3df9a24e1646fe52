"""Loading of a checked `Scene` from a scene file and the ``--set`` options of the command line."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lyra_petsc.errors import InputError
from lyra_petsc.scene.block import Block
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.messages import dotted, validated
from lyra_petsc.scene.overrides import apply_changes, apply_overrides, plain
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.text import parse_json, parse_yaml, read_text
from lyra_petsc.scene.values import shown

# A JSON file with one of these keys is a scene of this program, not of the original one.
_OUR_KEYS = {"mesh", "material", "time"}


def load_scene(path: Path | str, overrides: Sequence[str] = (), *, meshes_needed: bool = True) -> Scene:
    """Read and check a scene: YAML, or the original program's conf.json.

    Parameters
    ----------
    path : Path
    overrides : sequence of ``key.path=value``
        Changes of keys, applied before the scene is checked (`apply_overrides`).
    meshes_needed : bool
        Whether the mesh files must exist.

    Returns
    -------
    Scene
        Mesh paths are absolute; relative ones are relative to the scene file. ``scene.source`` is ``path``.

    Raises
    ------
    InputError
        The scene cannot be used; the message names file and key.
    """
    path = Path(path)
    text = read_text(path)
    data, notes = _read_plain(path, text)
    if not isinstance(data, dict):
        raise InputError(f"must be a block of keys (mesh, material, time, …), not {shown(data)}", file=path)
    with _refuse_recursion(path):
        data = plain(data)
        overridden = apply_overrides(data, overrides)
    scene = _load_checked(data, path, path.absolute().parent, overridden, meshes_needed=meshes_needed)
    scene._notes = notes
    return scene


def scene_of(data: Mapping[str, Any], changes: Mapping[str, Any] | None = None) -> Scene:
    """Check a scene given as nested dictionaries with the keys of a scene file.

    Parameters
    ----------
    data : mapping
        Mesh paths are relative to the working directory.
    changes : mapping of ``key.path`` to value, optional
        As in ``{"time.end": 2.0, "handles[0].until": 1.0}``; None removes a key.

    Raises
    ------
    InputError
        The scene cannot be used; the message names the key.
    """
    return _load_changed(data, changes or {}, None, Path.cwd())


def change_scene(scene: Scene, changes: Mapping[str, Any]) -> Scene:
    """A copy of ``scene`` with some keys changed as in `scene_of`; defaults follow the changes.

    Raises
    ------
    InputError
        The scene cannot be used; the message names the key.
    """
    if scene._content is None:
        other = _load_changed(parse_yaml(dump_scene(scene), file=None), changes, scene.source, Path.cwd())
    else:
        other = _load_changed(scene._content, changes, scene.source, scene._directory or Path.cwd())
    other._notes = scene._notes
    return other.trusting_meshes() if scene.trusts_meshes else other


def _load_changed(
    content: Mapping[str, Any], changes: Mapping[str, Any], source: Path | None, directory: Path
) -> Scene:
    with _refuse_recursion(source):
        data = plain(content)
        apply_changes(data, changes)
    return _load_checked(data, source, directory)


@contextmanager
def _refuse_recursion(file: Path | None) -> Iterator[None]:
    try:
        yield
    except RecursionError:
        raise InputError("is nested too deeply, or refers to itself", file=file) from None


def _load_checked(
    data: dict[str, Any],
    source: Path | None,
    directory: Path,
    overridden: Sequence[str] = (),
    *,
    meshes_needed: bool = True,
) -> Scene:
    sources = data.get("mesh") if isinstance(data, dict) else None
    if any(
        isinstance(s, dict) and "pattern" in s for s in (sources if isinstance(sources, list) else [sources])
    ):
        from lyra_petsc.scene.pattern_file import expand_patterns  # only scenes with patterns need it

        data = expand_patterns(data, directory, source)
    with _refuse_recursion(source):
        scene = validated(Scene, data, file=source, overridden=overridden, context={"directory": directory})
    if meshes_needed:
        for key, mesh in scene.mesh_files.items():
            _check_mesh_file(mesh, dotted(key, data), source)
    scene._source, scene._content, scene._directory = source, _with_points(data, scene), directory
    return scene


def _with_points(data: Any, value: Any) -> Any:
    """``data`` with the points of curves in place of their files, as the checked ``value`` has them: changed
    scenes need no file.
    """
    if isinstance(data, dict) and isinstance(value, (Block, dict)):
        return {key: _with_points(entry, value.get(key)) for key, entry in data.items()}
    if isinstance(data, dict) and isinstance(value, list):  # a single block in place of a list
        return _with_points(data, value[0])
    if isinstance(data, list) and isinstance(value, (list, tuple)):
        return [_with_points(*pair) for pair in zip(data, value, strict=False)]
    return plain(value) if isinstance(data, str) and isinstance(value, tuple) else data


def _read_plain(path: Path, text: str) -> tuple[Any, list[str]]:
    """The scene as plain values with the keys of this program, also for a file of the original program; and
    notes on what of that has no effect.
    """
    start = text.lstrip()
    if path.suffix.lower() == ".json" or start.startswith(("//", "/*")):
        data = parse_json(text, file=path)
        original = isinstance(data, dict) and not _OUR_KEYS & data.keys()
    elif start.startswith("{") and '"cloths"' in text:
        data, original = parse_json(text, file=path), True
    else:
        data, original = parse_yaml(text, file=path), False
    if not original:
        return data, []
    from lyra_petsc.scene.original import import_original

    return import_original(data, path)


def _check_mesh_file(file: Path, key: str, scene: Path | None) -> None:
    try:
        if file.is_file():
            return
        reason = "is a directory, not a mesh file" if file.is_dir() else "no such file"
    except OSError as error:
        reason = f"cannot be read ({error.strerror})"
    raise InputError(f"{reason}: {file}", file=scene, key=key)


def default_scene() -> Path:
    """Path of the default scene: in an installed package, else in the checkout."""
    package = Path(__file__).resolve().parent.parent
    inside = package / "configs" / "flag.yaml"
    return inside if inside.exists() else package.parent / "configs" / "flag.yaml"
