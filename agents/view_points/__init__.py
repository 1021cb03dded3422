"""Where to look from, and what it would tell.

``frontiers`` and ``rrt_tree`` find places, ``sight`` and ``sightings`` what a lidar sees from them, ``gain`` the
new area, ``anchoring`` the error that a map starts with; ``troubles`` remembers what did not work out.
"""
