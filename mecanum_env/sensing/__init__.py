"""What the robot senses, and how well: lidar and wheel encoders.

``sensors`` are used by the environment; ``raycast``, ``noise`` and ``slip`` are their kernels; ``calibration`` is
what the estimators are told of them, ``odometry_calibration`` the experiment behind it.
"""
