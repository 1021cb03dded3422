"""Paper C's claims as figures (``theory.md`` C).

``figures`` draws them, ``work`` and ``peers`` compare methods, ``odometry`` drives the simulated robot.
"""
