"""Training of policies; of ``ppo-frontier``: which view point to drive to.

``config`` says what is trained, ``folder`` is what every run does, ``jump_world`` is rehearsal without driving,
shaped by ``hindsight``, ``ppo`` learns, ``ensemble`` trains members side by side, ``policies`` turns zips into the
package's files; ``end_to_end`` is ``ppo``.
"""
