"""Where to look from, and what it would tell.

``frontiers`` and ``rrt_tree`` find places, ``sight`` and ``sightings`` what a lidar sees from them, ``gain`` the
new area, ``foresight`` the uncertainty left; ``troubles`` remembers what did not work out.
"""
