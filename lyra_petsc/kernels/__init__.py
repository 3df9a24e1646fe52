"""Compiled element kernels: how they are compiled and cached, and SIMD operations on 3×3 blocks."""

import os

from lyra_petsc.errors import InputError

if os.path.lexists(".numba_config.yaml"):
    raise InputError(
        "numba would take settings from it, among them a folder of compiled code; start in another folder, "
        "or set the variables NUMBA_… instead",
        file=".numba_config.yaml",
    )
