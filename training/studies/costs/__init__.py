"""Costs: what steps, decisions, maps and recordings take.

``speed`` is of one environment, ``speed_batch`` of many, beside ``peers``, other simulators under the same load;
``complexity`` is against the landmarks of a map, ``scale`` against the area explored; ``dp_slam_cost`` and
``recording_cost`` are of single parts.
"""
