"""Paper C's claims as figures (``theory.md`` C).

``figures`` draws them, ``work`` compares methods, ``odometry`` drives the simulated robot.
"""
