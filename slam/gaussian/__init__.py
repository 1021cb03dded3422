"""The joint Gaussian of the EKF family: what its filters share.

``joint_gaussian`` adds landmarks and reads them, ``stacked_update`` corrects with a whole scan at once,
``beliefs`` says what is made of it; ``companions`` are states beside the map, the wheels' lasting errors of
``wheel_errors`` among them; ``low_rank`` makes thin matrices of what near and far have in common. ``lanes`` and
``tiles`` are the fast arithmetic below, ``settings`` the configuration.
"""
