"""Strategies of robots that explore together, each deciding for itself on what it knows.

``crew`` is who is counted on, and what the ways cost each of them; ``sharing`` shares places out among robots;
``shared`` is an explorer that keeps to its part. On those: ``coordinated``, ``assigned``, ``team_tour``,
``team_frontier``, and ``rendezvous``, which meets the others again.
"""
