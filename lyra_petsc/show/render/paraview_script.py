"""A Python script that opens a run in ParaView, with colours, exaggeration, camera and time."""

from __future__ import annotations

from pathlib import Path
from string import Template

from lyra_petsc.output.file_operations import replace_text
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.show.render.camera import up_direction
from lyra_petsc.show.render.render_plan import run_line_of_sight

SCRIPT = "open_in_paraview.py"

TEXT = Template('''\
"""Opens the run beside this file in ParaView (5.11 or newer).

    paraview --script=$script       the window, ready to play
    pvbatch $script film.png        pictures film.0000.png, film.0001.png, ... without it

In an open window: View > Python Shell, then Run Script.
"""

import os
import sys

from paraview import simple

FOLDER = os.path.dirname(os.path.abspath(__file__)) if "__file__" in globals() else $folder
COLOUR = $colour  # one of: $fields; None: one colour
EXAGGERATION = 0.0  # 0: as it moved; 1: displacements from the rest shape drawn twice as large
UP = $up  # in the picture
SIGHT = $sight  # towards the camera

simple._DisableFirstRenderCameraReset()

# the states as a time series; their times are those of the run
states = simple.Xdmf3ReaderS(registrationName="states", FileName=[os.path.join(FOLDER, "states.xdmf")])
states.UpdatePipeline(states.TimestepValues[-1])

# the displacement from the rest shape, and that many times more of it
displaced = simple.Calculator(registrationName="displacement", Input=states)
displaced.ResultArrayName = "from rest"
displaced.Function = "coords - rest"
warped = simple.WarpByVector(registrationName="exaggerated", Input=displaced)
warped.Vectors = ["POINTS", "from rest"]
warped.ScaleFactor = EXAGGERATION
surface = simple.ExtractSurface(registrationName="surface", Input=warped)
# in ParaView 5.12 the filter got another name
normals = getattr(simple, "SurfaceNormals", None) or simple.GenerateSurfaceNormals
smooth = normals(registrationName="smooth", Input=surface)
smooth.FeatureAngle = 180.0

view = simple.GetActiveViewOrCreate("RenderView")
shown = simple.Show(smooth, view)
shown.Interpolation = "Gouraud"
shown.Ambient = 0.25
shown.Diffuse = 0.85
shown.Specular = 0.15
if COLOUR is None:
    simple.ColorBy(shown, None)
    shown.DiffuseColor = [0.78, 0.25, 0.18]
    shown.BackfaceRepresentation = "Surface"
    shown.BackfaceDiffuseColor = [0.94, 0.89, 0.78]
else:
    on = "POINTS" if COLOUR in smooth.PointData.keys() else "CELLS"
    simple.ColorBy(shown, (on, COLOUR, "Magnitude") if $vectors.get(COLOUR) else (on, COLOUR))
    # one scale for the whole run
    shown.RescaleTransferFunctionToDataRangeOverTime()
    colours = simple.GetColorTransferFunction(COLOUR)
    colours.ApplyPreset("Viridis (matplotlib)", True)
    bar = simple.GetScalarBar(colours, view)
    bar.Title = COLOUR.replace("_", " ") + $units.get(COLOUR, "")
    bar.ComponentTitle = ""
    shown.SetScalarBarVisibility(view, True)

label = simple.AnnotateTimeFilter(registrationName="time", Input=states)
label.Format = "t = {time:.4g}$unit"
simple.Show(label, view)

# one picture for each state
scene = simple.GetAnimationScene()
scene.UpdateAnimationUsingDataTimeSteps()
scene.PlayMode = "Snap To TimeSteps"

scene.GoToLast()
view.CameraFocalPoint = [0.0, 0.0, 0.0]
view.CameraPosition = SIGHT
view.CameraViewUp = UP
simple.ResetCamera(view)
scene.GoToFirst()
simple.Render(view)

if len(sys.argv) > 1 and sys.argv[1].endswith((".png", ".avi", ".ogv")):
    view.ViewSize = [1280, 720]
    simple.SaveAnimation(os.path.abspath(sys.argv[1]), view, ImageResolution=view.ViewSize)
''')


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
    text = TEXT.substitute(
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
