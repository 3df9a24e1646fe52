"""Handles: their motions, the coordinates that they prescribe, and springs of soft handles.

In: handles of the scene. Out: targets in time, and the forces of springs.
"""
