"""OpenGL without a display: checking whether it works, and dividing the cores among ranks."""

from __future__ import annotations

import ctypes.util
import os
import platform
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from lyra_petsc.errors import InputError

if TYPE_CHECKING:
    from mpi4py import MPI

REMEDY = (
    "OpenGL cannot be started without a display; install libegl1 "
    "(Debian, Ubuntu: apt-get install libegl1; conda: libegl), or libosmesa6"
)


def share_cores(comm: MPI.Comm) -> None:
    """Divide the cores of a machine among its ranks for drawing; collective, before anything is drawn."""
    ranks_here = comm.allgather(platform.node()).count(platform.node())
    if ranks_here > 1:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        os.environ.setdefault("LP_NUM_THREADS", str(max(1, cores // ranks_here)))


def import_pyvista() -> Any:
    """The module pyvista, set up to print no messages."""
    # Mesa and VTK would print each device and window that they fail to open
    os.environ.setdefault("EGL_LOG_LEVEL", "fatal")
    import pyvista
    from vtkmodules.vtkCommonCore import vtkLogger, vtkObject

    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    vtkObject.GlobalWarningDisplayOff()
    return pyvista


def off_screen_plotter(size: tuple[int, int]) -> Any:
    """A plotter without lights that draws pictures of a size [pixels] in memory; notebooks do not show it."""
    return import_pyvista().Plotter(off_screen=True, notebook=False, window_size=size, lighting="none")


def check_opengl() -> None:
    """Check that VTK can draw here.

    Raises
    ------
    InputError
        If it cannot; the message names the library to install.
    """
    import_pyvista()
    import vtkmodules.vtkRenderingOpenGL2  # noqa: F401  (registers the windows)
    from vtkmodules.vtkRenderingCore import vtkRenderWindow

    window = vtkRenderWindow()
    window.SetOffScreenRendering(True)
    # VTK falls back to OSMesa, and crashes if OSMesa is missing
    uses_osmesa = window.GetClassName() == "vtkOSOpenGLRenderWindow"
    if not (_has_osmesa() if uses_osmesa else window.SupportsOpenGL()):
        raise InputError(REMEDY, key="render")
    window.Finalize()


def _has_osmesa() -> bool:
    for name in ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so", ctypes.util.find_library("OSMesa")):
        with suppress(OSError):
            if name is not None:
                ctypes.CDLL(name)
                return True
    return False
