"""Writing and reading the files of a run.

In: accepted steps. Out: states, checkpoints, history and summary in the run's folder; and their readers.
"""
