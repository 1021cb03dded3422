"""``mecanum ros``: a backend and an agent on a real robot's messages.

``driver`` takes messages and says what to drive, without ROS; ``odometry`` keeps what came of it. ``node`` is the
only part that needs ROS 2.
"""
