"""Shared by all tests: Hypothesis without deadlines, and derandomised so that CI sees what a developer saw."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import settings

# Gymnasium's check_env tries every render mode: windows are drawn to memory, wherever the tests run.
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
# Tests look at every line of standard error: what they say must not depend on what is compiled already.
os.environ.setdefault("MECANUM_COMPILING", "0")

# A first call compiles its Numba kernel: a deadline would measure that.
settings.register_profile("mecanum", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("mecanum")


@pytest.fixture
def pygame(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Pygame, drawing to memory; its display is closed after the test."""
    module = pytest.importorskip("pygame", reason="needs the extra `human`")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield module
    module.display.quit()
