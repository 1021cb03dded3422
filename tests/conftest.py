"""Shared by all tests: Hypothesis without deadlines, and derandomised so that CI sees what a developer saw."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import settings

# Gymnasium's check_env tries every render mode: windows are drawn to memory, wherever the tests run.
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
# Tests look at every line of standard error: what they say must not depend on what is compiled already.
os.environ.setdefault("MECANUM_COMPILING", "0")

# What is imported is half a million objects that stay, and a kernel is compiled by way of as many that go: looked
# through as often as Python does by default, they cost 5 % of the tests' time, and 14 % of the kernels'.
gc.set_threshold(20_000, 20, 50)

# A first call compiles its Numba kernel: a deadline would measure that.
settings.register_profile("mecanum", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("mecanum")


def pytest_collection_finish() -> None:
    """Leave what is imported out of every later look for garbage, those that tests ask for among them."""
    gc.freeze()


@pytest.fixture
def pygame(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Pygame, drawing to memory; its display is closed after the test."""
    module = pytest.importorskip("pygame", reason="needs the extra `human`")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield module
    module.display.quit()
