"""How good a belief is: the only room where metrics are computed.

``measures`` holds ATE, RPE, NEES, NIS, corners and map IoU, ``relations`` the relations metric of recorded logs,
``chi_square`` the quantiles that bands and gates need.
"""
