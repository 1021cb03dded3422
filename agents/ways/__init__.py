"""Ways over the belief's map: what they cost, and which to take.

``cost_map`` says where the body may be, ``coarsening`` makes the map small, ``keeping`` does so only where it was
drawn (in ``boxes``), ``planning`` finds a path, ``travel`` costs between many places, ``routing`` tours over them,
and ``giving_way`` makes way for other robots.
"""
