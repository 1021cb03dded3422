"""Steps: every environment stepped by whoever means no good, each step judged from outside.

``items`` draws what is run; ``actions`` and ``nonsense`` drive; ``geometry``, ``watch`` and ``quick`` judge;
``runs`` runs environments of one robot, ``team`` and ``batch`` of several; ``again`` is an item in another
process; ``part`` is the campaign's part.
"""
