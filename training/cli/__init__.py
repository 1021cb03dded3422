"""The ``mecanum`` command: one module for each larger command, the short ones in ``commands``."""

from training.cli.commands import app, main

__all__ = ["app", "main"]
