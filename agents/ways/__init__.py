"""Ways over the belief's map: what they cost, and which to take.

``cost_map`` says where the body may be, ``coarsening`` makes it small, ``planning`` finds a path, ``travel`` costs
between many places, ``routing`` tours over them.
"""
