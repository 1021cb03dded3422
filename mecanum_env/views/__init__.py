"""What is drawn of an episode: truth beside belief.

``render`` makes a frame, ``window`` shows it, ``pictures`` are the large ones of an episode's end; ``canvas`` and
``paint`` are what they draw with.
"""
