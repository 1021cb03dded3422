"""The part ``soak`` in short, and that it finds what grows."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from training.cli import main
from training.studies.reliability.soak.part import SOAK, slope


def rows(mb_per_h: float, *, handles: int = 0, hours: float = 2.0) -> dict[Any, Any]:
    rng = np.random.default_rng(0)
    found = {}
    for k in range(int(hours * 120)):
        at = 30.0 * k + 3.0 * np.arange(10)
        mb = 400.0 + mb_per_h * at / 3600.0 + rng.normal(0.0, 2.0, 10)
        samples = [[t, m, 7 + handles * (t > 3600.0), 2] for t, m in zip(at.tolist(), mb.tolist(), strict=True)]
        found[0, k, 30.0] = {"pid": 1, "steps": 100, "unsound": 0, "samples": samples}
    return found


def test_what_grows_is_found_and_what_does_not_is_not() -> None:
    assert SOAK.sum_up(rows(0.0))["failures"] == []
    life = SOAK.sum_up(rows(20.0))
    assert life["lives"][0]["slope"][1] < 20.0 < life["lives"][0]["slope"][2] and "MB/h" in life["failures"][0]
    assert "handles [7, 8]" in SOAK.sum_up(rows(0.0, handles=1))["failures"][0]
    short = SOAK.sum_up({key: row for key, row in rows(0.0).items() if key[1] < 2})
    assert short["lives"][0]["slope"] is None and short["failures"] == []


def test_one_outlier_is_no_slope() -> None:
    hours = np.linspace(0.0, 1.0, 101)
    values = np.where(hours == 1.0, 500.0, 400.0 + 3.0 * hours)
    assert slope(hours, values)[0] == pytest.approx(3.0)


def test_the_command_runs_parts_one_after_the_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["study", "reliability", "--parts", "soak", "--hours", "0.001", "--out", str(tmp_path)]
    assert main(argv) == 0
    found = json.loads((tmp_path / "soak.json").read_text())
    assert found["tried"] > 0 and found["lives"][0]["samples"] > 0
    assert "<h2>soak</h2>" in (tmp_path / "report.html").read_text()
    assert "0 failed" in capsys.readouterr().out
