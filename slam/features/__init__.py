"""From a scan to what stands out in it: straight surfaces, and the corners where they meet or end.

``extraction`` is the stage that a backend calls; ``surfaces`` and ``corners`` are its two steps.
"""
