"""Output of a run for people: pictures and films, a live page, reports, other formats.

In: a run's folder, read by ``output``. Out: files for people and other programs.
"""
