"""Standard tests of textiles on a material.

``specimens`` reads materials, ``textile_tests`` holds the tests, ``records`` their results and tables.
"""
