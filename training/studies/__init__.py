"""Studies: questions asked of the estimators, the agents and the code, each with a command.

``accuracy``, ``consistency`` (also in ``circle_world``), ``belief`` and ``calibrate`` ask estimators, ``ratios``
agents, ``teams`` those of several robots, ``costs`` what it all takes, ``digests`` whether a commit changed it.
``paper_b``, ``paper_c`` and ``paper_d`` repeat the papers' claims; ``recovery`` makes faults, ``reliability``
hands readers files that nobody means well; ``worlds`` draws robots and rooms by lot. ``exploring`` is the episode
that several run.
"""
