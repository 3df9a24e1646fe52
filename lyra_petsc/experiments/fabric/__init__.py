"""Standard tests of textiles on a material.

``specimens`` takes materials, ``strips`` and ``cusick`` have the tests, ``records`` what comes of them and
how it is told.
"""
