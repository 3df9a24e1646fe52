"""Physical terms: energies, loads and handles; one file each, registered in ``registry``.

In: a scene and its mesh, then positions and velocities as arrays. Out: energies, forces and Hessians.
"""
