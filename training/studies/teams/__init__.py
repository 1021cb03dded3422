"""Studies of teams: several robots in one building.

``merging`` asks whether the maps of two are merged rightly that know nothing of each other's start.
"""
