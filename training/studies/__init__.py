"""Studies: questions asked of the estimators, the agents and the code, each with a command.

``consistency`` (also in ``circle_world``), ``complexity``, ``belief``, ``dp_slam_cost`` and ``calibrate`` ask
estimators, ``teams`` those of several robots, ``speed``, ``speed_batch``, ``scale``, ``recording_cost`` and
``digests`` the code; ``paper_b``, ``paper_c`` and ``paper_d`` repeat the papers' claims; ``recovery``
makes faults, ``reliability`` hands readers files that nobody means well. ``peers`` are other simulators under the
same load, ``exploring`` is the episode that several run.
"""
