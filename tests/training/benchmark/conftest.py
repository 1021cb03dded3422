"""Benchmarks in this process."""

from __future__ import annotations

from typing import Any

import pytest

from training.benchmark import run as benchmark
from training.runs.campaign import run_all


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the episodes in this process: starting another takes longer than they do."""

    def in_this_process(*args: Any, apart: bool, workers: int, **more: Any) -> None:
        run_all(*args, apart=False, workers=1, **more)

    monkeypatch.setattr(benchmark, "run_all", in_this_process)
