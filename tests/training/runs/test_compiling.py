"""That a run says that it compiles, and that it is quiet where there is nothing to compile."""

from __future__ import annotations

import time

import pytest
from numba import njit

from training.runs import compiling
from training.runs.compiling import VARIABLE, compiled_s, compiling_shown


def test_it_says_how_many_kernels_of_ours_are_compiled(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(VARIABLE, "1")

    def inner(x: float) -> float:
        return 2.0 * x

    def outer(x: float) -> float:
        return float(kernel(x) + 1.0)

    inner.__module__ = outer.__module__ = "slam.somewhere"
    kernel, caller = njit(inner), njit(outer)
    with compiling_shown(silent_s=0.0, every_s=0.0):
        assert caller(3.0) == 7.0
        assert caller(4.0) == 9.0  # compiled by now
        njit(lambda x: x)(1.0)  # of somebody else: not counted
    said = capsys.readouterr().err.splitlines()
    assert [line.split(": ")[1].split(" of")[0] for line in said] == ["1", "2", "2"]
    assert all(line.startswith("compiling kernels, once after an installation") for line in said)
    njit(outer)(3.0)  # after the block nobody listens
    assert capsys.readouterr().err == ""


def test_it_is_quiet_at_first_and_where_it_is_asked_to_be(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(VARIABLE, "1")
    with compiling_shown(silent_s=1e6):
        njit(lambda x: x)(1.0)
    monkeypatch.setenv(VARIABLE, "0")
    before_s, began_s = compiled_s(), time.monotonic()
    with compiling_shown(silent_s=0.0, every_s=0.0):
        njit(lambda x: x)(1.0)
    assert capsys.readouterr().err == ""
    assert 0.0 < compiled_s() - before_s <= time.monotonic() - began_s  # counted all the same


def test_it_does_not_count_beyond_what_it_expected(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(VARIABLE, "1")
    monkeypatch.setattr(compiling, "_EPISODE", 1)
    with compiling_shown(silent_s=0.0, every_s=0.0):
        for _ in range(2):
            kernel = lambda x: x  # noqa: E731
            kernel.__module__ = "slam.somewhere"
            njit(kernel)(1.0)
    first, second = (line.split(": ")[1] for line in capsys.readouterr().err.splitlines())
    assert first.startswith("1 of about 1, ") and second.startswith("2, ")
