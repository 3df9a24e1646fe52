"""From a state to the next: integrators, Newton's method, step control and recovery.

In: a checked scene. Out: accepted steps, or why there is none.
"""
