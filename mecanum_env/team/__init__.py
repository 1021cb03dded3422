"""Several robots in one building, each with its own sensors, noise and belief.

``team`` steps them; ``member`` is one of them, a single environment among others; ``knowledge`` is what each
knows of what others told (``reports``) and of where their frames lie (``frames``); ``communication`` says who
hears whom; ``starts`` where they begin; ``coverage`` what all of them together have mapped. ``config`` are its
settings, ``picture`` is a frame, and ``parallel_env`` PettingZoo's side of it.
"""
