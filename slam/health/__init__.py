"""Health of a belief: whether it is still true, and the way back where it is not.

``evidence`` counts the beams that speak for and against a pose on a map, ``monitor`` makes a probability of that,
``relocalisation`` finds where a scan fits a map, ``recovery`` puts them together for a backend.
"""
