"""Places: runs where a disk is full, a folder read-only, a store locked, a neighbour busy.

``commands`` runs the command line in such places; ``processes`` has environments in processes of every kind, and
many in one; ``part`` is the campaign's part.
"""
