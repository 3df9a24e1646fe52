"""From a state to the next: integrators, Newton's method, step control and recovery.

The rooms are ``newton``, ``integrators``, ``statics`` (equilibria) and ``failure`` (reports of failed steps);
what a run steps with is in the package itself, ``simulation`` at its head.

In: a checked scene. Out: accepted steps, or why there is none.
"""
