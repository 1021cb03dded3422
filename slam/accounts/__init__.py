"""What one robot hands out of its belief, to other robots, to files and to whoever measures its map.

``account`` is a copy of map and pose with their whole covariance, of its own data only. ``corners`` puts an
account's corners on the walls on which they lie. ``landmarks`` is what of that goes into files.
"""
