"""Reading and checking of scenes.

In: a YAML scene, an original ``conf.json``, options of the command line. Out: one `Scene` with all defaults,
and constants of its materials; or an error that names file, key and remedy.
"""
