"""Pixels of an off-screen window."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def image_of(plotter: Any) -> NDArray[np.uint8]:
    """(height, width, 3) what a plotter has drawn last, without drawing it again."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkRenderingCore import vtkWindowToImageFilter

    reader = vtkWindowToImageFilter()
    reader.SetInput(plotter.render_window)
    reader.SetInputBufferTypeToRGB()
    reader.ReadFrontBufferOff()
    reader.ShouldRerenderOff()
    reader.Update()
    image = reader.GetOutput()
    width, height, _ = image.GetDimensions()
    rows = vtk_to_numpy(image.GetPointData().GetScalars())  # type: ignore[no-untyped-call]
    pixels = rows.reshape(height, width, -1)
    return np.ascontiguousarray(pixels[::-1, :, :3])
