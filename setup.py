"""What pyproject.toml cannot say: the wheel carries the scenes and their meshes.

``configs/`` and ``meshes/`` of the checkout become ``lyra_petsc/configs`` and
``lyra_petsc/meshes``, side by side as in the checkout, so that a scene finds its mesh
by the same relative path in both.
"""

from setuptools import find_packages, setup

SCENES = {"lyra_petsc.configs": "configs", "lyra_petsc.meshes": "meshes"}

setup(
    packages=[*find_packages(include=["lyra_petsc", "lyra_petsc.*"]), *SCENES],
    package_dir=SCENES,
    package_data={"": ["*.json", "*.yaml", "*.geo", "*.msh", "*.obj", "*.mtl", "py.typed"]},
)
