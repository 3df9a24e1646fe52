"""Newton's method: first guess, linear systems, globalisation, convergence test.

In: the equations of a stage. Out: velocities that solve them, or the history of a failed solve.
"""
