"""Static equilibria: proximal steps, loads that follow the shape, friction, stability.

In: the equations of a load step. Out: positions at rest, and whether they are stable.
"""
