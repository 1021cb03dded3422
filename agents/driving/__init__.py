"""Driving: from the goal that was chosen to the next twist.

``driver`` asks for another goal when that is due and notices what does not work out; ``control`` follows a path
with ``follow``'s kernels, ``safety`` has the last word on a twist, ``sides`` are what it keeps to beside other
robots, ``grip`` learns how slippery the floor is and drives gently.
"""
