"""The ``mecanum`` command: a module for each command, and ``app``, which runs them and says what went wrong."""

from training.cli.app import app, main

__all__ = ["app", "main"]
