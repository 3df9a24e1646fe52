"""States of a run in the formats of other programs.

In: a run's folder. Out: a folder of files. `export_run` lists the formats; each has a function of its own.
"""
