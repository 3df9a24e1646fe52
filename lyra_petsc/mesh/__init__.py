"""Meshes and their distribution over ranks.

In: a scene's mesh sources (files, gmsh scripts, grids). Out: vertices, triangles and groups on rank 0, then
each rank's owned and ghost points and its share of the elements.
"""
