"""What the user wrote, checked.

In: a YAML scene, an original ``conf.json``, options of the command line. Out: one `Scene` with
all defaults, materials resolved; or an error that names file, key and remedy.
"""
