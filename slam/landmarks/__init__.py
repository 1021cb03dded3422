"""Landmarks: which one was seen, which ones are kept, and the database they are written to.

``association`` decides by Mahalanobis distance, ``joint_compatibility`` for a scan as a whole; ``book`` keeps
tentative and confirmed ones, ``loop_closing`` takes old ones for what they are only together, ``curved_walls``
straightens what is seen of walls that bend, ``wall_evidence`` finds walls that are none and errors that last,
``right_angles`` walls that stand square to most others. ``rescue`` matches what left its gate once the others
have put the pose right; ``seen_from`` takes a scan that fits the drawn map for sightings of landmarks that it
need not show; ``spinning_wheels`` suspects wheels that turn in vain; ``innovations`` show what single
observations say against the belief; ``known_ids`` is about labels that were misread; ``database`` is
``landmarks.db``.
"""
