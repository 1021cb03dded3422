"""Teams.

``account``
"""
