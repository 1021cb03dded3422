"""The part ``steps``: every environment stepped by whoever means no good, each step judged from outside.

``items`` draws what is run; ``actions`` drives; ``geometry`` and ``watch`` judge; ``single``, ``team``, ``batch``
and ``frontier`` run the environments; ``again`` is one item in another process; ``part`` is the campaign's part.
"""
