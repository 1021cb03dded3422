"""Shared by all tests: Hypothesis without deadlines, and derandomised so that CI sees what a developer saw."""

from __future__ import annotations

from hypothesis import settings

# A first call compiles its Numba kernel: a deadline would measure that.
settings.register_profile("mecanum", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("mecanum")
