"""Lost, and found again: faults are made mid-episode, and it is seen what the belief makes of them.

``faults`` makes them, ``runs`` does one episode, ``figures`` sums episodes up and draws, ``command`` is the study.
"""
