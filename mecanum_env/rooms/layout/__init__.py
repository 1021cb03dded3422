"""Where walls, doors and furniture go: what the generators of rooms share.

``apartment_layout`` and ``corridor_layout`` place walls, ``furniture`` pieces; ``assembly`` makes a checked plan.
"""
