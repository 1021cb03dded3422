"""The joint Gaussian of the EKF family: what its filters share.

``joint_gaussian`` adds landmarks and reads them, ``stacked_update`` corrects with a whole scan at once,
``wheel_errors`` are the wheels' lasting errors as states; ``lanes`` and ``tiles`` are the fast arithmetic below,
``settings`` the configuration.
"""
