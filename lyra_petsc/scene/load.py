"""From a scene file and the command line's ``--set`` to a checked `Scene`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lyra_petsc.errors import InputError
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.messages import dotted, validated
from lyra_petsc.scene.overrides import apply_changes, apply_overrides, plain
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.text import parse_json, parse_yaml, read_text
from lyra_petsc.scene.values import shown

# A JSON file with one of these is a scene of ours, not one of the original program.
_OUR_KEYS = {"mesh", "material", "time"}

STORED, BESIDE_STORED = "scene.yaml", "mesh.h5"
"""Of a run's folder: the scene, whose materials have no bending_model if there were hinges only, and what
shows that it is one."""


def load_scene(path: Path | str, overrides: Sequence[str] = (), *, meshes_needed: bool = True) -> Scene:
    """Read and check a scene: YAML, or the original program's conf.json.

    Parameters
    ----------
    path : Path
    overrides : sequence of ``key.path=value``
        Applied to the scene as understood, before it is checked; see `apply_overrides`.
    meshes_needed : bool
        Whether the mesh files must be there.

    Returns
    -------
    Scene
        Mesh paths absolute, taken to stand beside the scene file; ``scene.source`` is ``path``.

    Raises
    ------
    InputError
        On anything that cannot be used, naming file and key.
    """
    path = Path(path)
    text = read_text(path)
    data = _read(path, text)
    if not isinstance(data, dict):
        raise InputError(f"must be a block of keys (mesh, material, time, …), not {shown(data)}", file=path)
    with _of_finite_depth(path):
        data = plain(data)
        if path.name == STORED and (path.parent / BESIDE_STORED).exists():
            for block in _without_model(data):
                block["bending_model"] = "hinge"
        overridden = apply_overrides(data, overrides)
    return _checked(data, path, path.absolute().parent, overridden, meshes_needed=meshes_needed)


def scene_of(data: Mapping[str, Any], changes: Mapping[str, Any] | None = None) -> Scene:
    """Check a scene given as nested dictionaries with the keys of a scene file.

    Parameters
    ----------
    data : mapping
        Mesh paths stand under the working directory.
    changes : mapping of ``key.path`` to value, optional
        As in ``{"time.end": 2.0, "handles[0].until": 1.0}``; None removes a key.

    Raises
    ------
    InputError
        On anything that cannot be used, naming the key.
    """
    return _changed(data, changes or {}, None, Path.cwd())


def _without_model(data: Any) -> list[dict[str, Any]]:
    """The material blocks of a scene as plain values that name no bending model."""
    return [block for block in _materials(data) if block.get("bending_model") is None]


def _materials(data: Any) -> list[dict[str, Any]]:
    blocks = data.get("material") if isinstance(data, dict) else None
    return [block for block in (blocks if isinstance(blocks, list) else [blocks]) if isinstance(block, dict)]


def with_stored_bending_model(scene: Scene, stored: Path) -> Scene:
    """The scene of a resumed run: hinges where neither it nor the ``stored`` one names a bending model.

    As it is where the stored one cannot be read.
    """
    try:
        before = parse_yaml(read_text(stored), file=stored)
    except InputError:
        return scene
    if not _without_model(before) or scene._given is None:
        return scene
    blocks = _materials(scene._given)
    chosen = [number for number, block in enumerate(blocks) if block.get("bending_model") is None]
    return change_scene(scene, {f"material[{number}].bending_model": "hinge" for number in chosen})


def change_scene(scene: Scene, changes: Mapping[str, Any]) -> Scene:
    """Another scene: the first one's keys as they were given, with some changed as in `scene_of`.

    Raises
    ------
    InputError
        On anything that cannot be used, naming the key.
    """
    if scene._given is None:
        other = _changed(parse_yaml(dump_scene(scene), file=None), changes, scene.source, Path.cwd())
    else:
        other = _changed(scene._given, changes, scene.source, scene._directory or Path.cwd())
    return other.trusting_meshes() if scene.trusts_meshes else other


def _changed(
    given: Mapping[str, Any], changes: Mapping[str, Any], source: Path | None, directory: Path
) -> Scene:
    with _of_finite_depth(source):
        data = plain(given)
        apply_changes(data, changes)
    return _checked(data, source, directory)


@contextmanager
def _of_finite_depth(file: Path | None) -> Iterator[None]:
    try:
        yield
    except RecursionError:
        raise InputError("is nested too deeply, or refers to itself", file=file) from None


def _checked(
    data: dict[str, Any],
    source: Path | None,
    directory: Path,
    overridden: Sequence[str] = (),
    *,
    meshes_needed: bool = True,
) -> Scene:
    with _of_finite_depth(source):
        scene = validated(Scene, data, file=source, overridden=overridden, context={"directory": directory})
    if meshes_needed:
        for key, mesh in scene.mesh_files.items():
            _check_mesh_file(mesh, dotted(key, data), source)
    scene._source, scene._given, scene._directory = source, data, directory
    return scene


def _read(path: Path, text: str) -> Any:
    """The scene as plain values with the keys of this program, also from a file of the original one."""
    start = text.lstrip()
    if path.suffix.lower() == ".json" or start.startswith(("//", "/*")):
        data = parse_json(text, file=path)
        original = isinstance(data, dict) and not _OUR_KEYS & data.keys()
    elif start.startswith("{") and '"cloths"' in text:
        data, original = parse_json(text, file=path), True
    else:
        data, original = parse_yaml(text, file=path), False
    if not original:
        return data
    from lyra_petsc.scene.original import import_original

    return import_original(data, path)


def _check_mesh_file(file: Path, key: str, scene: Path | None) -> None:
    try:
        if file.is_file():
            return
        what = "is a directory, not a mesh file" if file.is_dir() else "no such file"
    except OSError as error:
        what = f"cannot be read ({error.strerror})"
    raise InputError(f"{what}: {file}", file=scene, key=key)


def default_scene() -> Path:
    """The scene of a run without one: in the wheel beside the package's modules, else in the checkout."""
    package = Path(__file__).resolve().parent.parent
    inside = package / "configs" / "flag.yaml"
    return inside if inside.exists() else package.parent / "configs" / "flag.yaml"
