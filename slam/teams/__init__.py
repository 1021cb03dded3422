"""Several robots map one building: what they tell each other, and what can be made of it.

``merged_grid`` is a map of one's own and others' together; ``centralised`` one filter over all robots.
"""
