"""Teams: several robots that map one building together.

``centralised`` is one filter over all robots: one joint Gaussian, one map, one grid.
"""
