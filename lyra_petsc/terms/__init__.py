"""Physical terms: energies, loads and handles; one file each, registered in ``registry``.

The subpackages are ``bending`` (both models side by side), ``contact`` with friction, ``handles``, ``loads``
and ``membrane_laws``.

In: a scene and its mesh, then positions and velocities as arrays. Out: energies, forces and Hessians.
"""
