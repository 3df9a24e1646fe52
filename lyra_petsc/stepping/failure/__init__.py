"""Failed steps in words: where a solve is worst, what may be the cause, what to change.

In: the history and the last iterate of a failed solve. Out: a report.
"""
