"""The part of files: every reader is handed files that were damaged at random, or made to do harm.

``samples`` are sound files, ``results`` those that long runs go on from; ``mutations`` damages them; ``hostile``,
``hostile_logs``, ``hostile_bags`` and ``hostile_stores`` are made to do harm. ``readers`` says who reads what,
``forked`` runs the command on one, ``child`` reads within bounds of memory, ``guard`` watches its time, ``part``
counts.
"""
