"""The command mecanum: a module for each of its commands, and ``app``, which runs them and says what went wrong.

``explore``, ``play``, ``rooms``, ``replay``, ``benchmark``, ``train``, ``policy``, ``ros``, ``study`` and
``doctor`` are named like theirs; ``measures`` are consistency, complexity and speed.
"""

from training.cli.app import app, main

__all__ = ["app", "main"]
