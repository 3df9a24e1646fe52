"""Standard tests of textiles on a material.

``specimens`` reads materials, ``textile_tests`` runs the tests, ``fabric_report`` has their results and page.
"""
