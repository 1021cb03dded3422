"""The dungeons protocol: published maps, a lattice of stations, path lengths beside the published ones.

``protocol`` runs it, an ``episode`` in a ``world``, ``bound`` knows the map; ``plans``, ``walks``, ``lessons``,
``networks`` and ``training`` make ``learned-tour``.
"""
