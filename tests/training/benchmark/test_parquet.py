"""A benchmark's rows as Parquet: read back by pyarrow they are those of the store."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.training.benchmark.small import episode, made_up_group, small
from tests.training.cli.test_bad_input import refused
from training.benchmark.output import Report
from training.benchmark.parquet import FILE, write_parquet
from training.benchmark.store import FILE as STORE
from training.benchmark.store import Store
from training.cli import main


def test_what_is_written_is_what_is_in_the_store(tmp_path: Path) -> None:
    pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra `parquet`")
    assert main(small(tmp_path, "--parquet")) == 0
    table = pq.read_table(tmp_path / FILE)
    types = {field.name: str(field.type) for field in table.schema}
    asked = ("suite", "seed", "steps", "ate_rmse_m", "success", "end", "nees")
    assert [types[name] for name in asked] == [
        "string", "int64", "int64", "double", "bool", "string", "list<element: float>",
    ]  # fmt: skip
    settings = json.loads(table.schema.metadata[b"mecanum"])
    assert settings["agents"] == ["nearest-frontier"] and settings["seeds"] == {"rooms": [0, 1, 2]}
    found = {tuple(row[name] for name in table.column_names[:5]): row for row in table.to_pylist()}
    with Store(tmp_path / STORE) as store:
        kept = dict(store.rows(store.made_by()))
    assert found.keys() == kept.keys() and len(found) == 3
    for key, row in kept.items():
        assert {name: found[key][name] for name in row.metrics} == row.metrics
        for curve in ("coverage_by_time", "coverage_by_path", "nees"):
            np.testing.assert_array_equal(np.float32(found[key][curve]), getattr(row, curve))


def test_what_no_episode_has_is_a_number_none_has(tmp_path: Path) -> None:
    pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra `parquet`")
    assert episode(("rooms", "rectangular", 0, "a", "ekf")).metrics["time_to_99_s"] is None
    report = Report.of([made_up_group(coverage=[0.5, 1])], baseline=None, config={})
    write_parquet(tmp_path, report)
    table = pq.read_table(tmp_path / FILE, columns=["time_to_99_s", "coverage"])
    assert {str(kind) for kind in table.schema.types} == {"double"}
    assert table.to_pydict() == {"time_to_99_s": [None, None], "coverage": [0.5, 1.0]}


def test_the_extra_is_asked_for_before_anything_is_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    line = refused(small(tmp_path / "out", "--parquet"), capsys)
    assert "--parquet needs pyarrow; install it with pip install 'mecanum-slam[parquet]'" in line
    assert not (tmp_path / "out").exists()
