"""One episode: ``mecanum explore`` without its command line.

``explore`` runs it, ``recording`` keeps it step by step, ``playback`` plays it back, ``room_pictures`` is
``mecanum rooms``.
Of several robots: ``team`` runs it, ``team_log`` has the metrics.
"""
