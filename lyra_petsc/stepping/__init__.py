"""From a state to the next: integrators, Newton's method, step control and recovery.

The subpackages are ``newton``, ``integrators``, ``statics`` (equilibria) and ``failure`` (reports of failed
steps); the package itself has the stepper and, in ``simulation``, the loop over steps.

In: a checked scene. Out: accepted steps, or why there is none.
"""
