"""Pose-graph SLAM: key scans, the patches of surface that each was the first to see, and what links them.

``surfaces`` tells what a scan's beams ended on, ``patches`` what a key scan adds to the map, ``matching`` holds a
scan against the patches in reach, ``window`` is the joint Gaussian of what is in reach, ``pose_graph`` everything
there is with its sparse solution, ``loop_closing`` which old places are believed to be seen again, ``atlas`` all
of that together, ``lasting`` what is learnt of the wheels, ``settings`` the configuration and ``graph_slam`` the
backend. ``places`` are scans that the EKF family holds on to where landmarks are few; ``held_by_map`` is that
family's use of them, and of the drawn map.
"""
