"""Training of ``ppo-frontier``: which view point to drive to.

``config`` says what is trained, ``imitation`` warms up, ``jump_world`` is rehearsal without driving, ``ppo``
learns, ``ensemble`` trains members side by side, ``policies`` turns zips into the package's files; ``end_to_end``
is ``ppo``.
"""
