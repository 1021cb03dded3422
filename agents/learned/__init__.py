"""Learned choices: what trained policies see, and their networks in NumPy.

``choice`` with ``choice_network`` and ``chooser`` are those of ppo-frontier; ``drive_network``, ``drive_memory``
and ``drive_plan`` those of ppo; ``station_network`` that of learned-tour; ``layers`` is what they are made of,
``policy_files`` reads them all, ``hub`` fetches and sends them.
"""
