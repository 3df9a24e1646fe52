"""The files of a run, written and read.

In: accepted steps. Out: states, checkpoints, history and summary in the run's folder; and their readers.
"""
