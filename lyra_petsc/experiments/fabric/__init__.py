"""Standard tests of textiles on a material.

``specimens`` reads materials, ``strips`` and ``cusick`` hold the tests, ``records`` their results and tables.
"""
