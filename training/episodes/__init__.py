"""One episode: ``mecanum explore`` without its command line.

``explore`` runs it, ``recording`` keeps it step by step, ``playback`` plays it back, ``known_map`` is the planner
that knows the truth, ``true_places`` what it and teachers look up, ``room_pictures`` is ``mecanum rooms``.
Of several robots: ``team`` runs it, ``team_log`` has the metrics.
"""
