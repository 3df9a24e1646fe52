"""Pictures, films, a live page, reports and exports of a run.

In: a run's folder, read by ``output``. Out: files for people and other programs.
"""
