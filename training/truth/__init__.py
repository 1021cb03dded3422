"""What knows the true map: bounds that reports set beside the agents, and what teachers look up.

``places`` has the true map for planning and a lattice of places, ``sights`` what is seen from where, ``search``
the annealing over sequences of stops, ``rehearsal`` what the driver makes of a path, ``known_map`` the fastest way
found, driven, and ``lower_bound`` the time that nobody can be below.
"""
