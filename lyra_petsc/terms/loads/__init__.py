"""Loads: gravity, forces, pressure, moments on edges, and wind; each module is a term.

In: positions and velocities. Out: forces on vertices.
"""
