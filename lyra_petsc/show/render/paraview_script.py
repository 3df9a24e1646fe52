"""A Python script that opens a run in ParaView, with colours, exaggeration, camera and time."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from string import Template

from lyra_petsc.output.file_operations import replace_text
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.show.render.camera import up_direction
from lyra_petsc.show.render.render_plan import run_line_of_sight

SCRIPT = "open_in_paraview.py"


def write_script(folder: Path) -> Path:
    """Write the script into a run's folder; returns its path.

    Raises
    ------
    InputError
        If the folder is not one of a run.
    OutputError
        If it cannot be written.
    """
    run = StoredRun(folder)
    scene = run.scene
    path = run.folder / SCRIPT
    names = run.fields
    template = files("lyra_petsc.show.render").joinpath("open_in_paraview.txt").read_text(encoding="utf-8")
    text = Template(template).substitute(
        script=SCRIPT,
        folder=repr(str(run.folder.absolute())),
        colour=repr("velocity" if "velocity" in names else names[0] if names else None),
        fields=", ".join(map(repr, names)) or "none was written",
        vectors=repr({name: True for name in names if len(run.field(name)[0].shape) > 1}),
        units=repr({name: f" [{unit}]" for name in names if (unit := run.field_units(name)) != "1"}),
        unit="" if scene.time.static else " s",
        up=repr([float(v) + 0.0 for v in up_direction(scene)]),
        sight=repr([round(float(v), 6) + 0.0 for v in run_line_of_sight(run, scene)]),
    )
    replace_text(path, text)
    return path
