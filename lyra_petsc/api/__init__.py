"""Calls from Python and the run as a whole.

In: a scene. Out: a run's folder, or a simulation to step through.
"""
