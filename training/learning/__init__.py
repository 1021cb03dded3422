"""Training of policies; of ``ppo-frontier``: which view point to drive to.

``config`` says what is trained, ``folder`` is what every run does. ``choice_world`` is where, ``jump_world`` the
same without driving, shaped by ``hindsight``; ``trials`` judge what was learned. ``ppo`` trains ``networks`` with
``semi_markov`` advantages, ``ensemble`` several side by side, ``follow`` tells others of it; ``policies`` turns
zips into the package's files. ``vec_env`` is many environments at once for stable-baselines3. ``end_to_end``
trains ppo.
"""
