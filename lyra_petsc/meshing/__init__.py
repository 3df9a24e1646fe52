"""Mesh sources (.geo, .msh, .obj, grids) → vertices, triangles, material coordinates, groups."""
