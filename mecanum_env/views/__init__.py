"""What is drawn of an episode, truth beside belief, and of floor plans.

``render`` makes a frame, ``window`` shows it, ``pictures`` are the large ones of an episode's end, ``plans`` those
of rooms; ``canvas`` and ``paint`` are what they draw with.
"""
