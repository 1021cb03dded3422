"""``mecanum study accuracy``: what it refuses, before any episode is run."""

from __future__ import annotations

from pathlib import Path

import pytest

from training.cli import main


@pytest.mark.parametrize(
    ("option", "hint"),
    [
        (("--rooms", "apartment,kave"), "did you mean 'cave'?"),
        (("--slam", "ekf,dp-slamm"), "did you mean 'dp-slam'?"),
        (("--agent", "nearest"), "valid: "),
        (("--noise", "slipery"), "did you mean 'slippery'?"),
        (("--seeds", "a"), "seeds"),
    ],
)
def test_bad_options_are_refused_in_one_line(
    option: tuple[str, str], hint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["study", "accuracy", *option, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert hint in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()
