"""The physics: the mecanum robot, the floor under its wheels, and the pymunk space it drives in.

``world`` steps them together, ``clear_driving`` where nothing is near; ``robot`` is kinematics and dynamics,
``collisions`` contacts, ``floor`` what slips; ``fleet`` is several robots in one plan.
"""
