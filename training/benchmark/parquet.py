"""A benchmark's rows as Parquet, for pandas, DuckDB and the like: typed columns, one row an episode."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from slam.formats import atomic_write
from training.benchmark.output import KEY_COLUMNS, TEAM_COLUMNS, Report
from training.runs.errors import needs_extra

__all__ = ["FILE", "require", "write_parquet"]

FILE = "episodes.parquet"

_CURVES = ("coverage_by_time", "coverage_by_path", "nees")


def require() -> None:
    """Raise ``BadInput`` where pyarrow is not installed."""
    with needs_extra("parquet", "--parquet"):
        import pyarrow  # noqa: F401


def write_parquet(out: Path, report: Report) -> None:
    """Write ``episodes.parquet``: key, metrics and curves; the settings as JSON in the schema's metadata."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    groups = [entry.group for entry in report.entries]
    pairs = [pair for group in groups for pair in zip(group.keys, group.rows, strict=True)]
    columns = {name: pa.array([key[k] for key, _ in pairs]) for k, name in enumerate(KEY_COLUMNS)}
    for name in TEAM_COLUMNS if report.has_teams else ():
        columns[name] = pa.array([getattr(group, name) for group in groups for _ in group.rows])
    for name in dict.fromkeys(name for _, row in pairs for name in row.metrics):
        values = [row.metrics.get(name) for _, row in pairs]
        columns[name] = pa.array(values, _type(pa, values))
    for name in _CURVES:
        columns[name] = pa.array([getattr(row, name) for _, row in pairs], pa.list_(pa.float32()))
    table = pa.table(columns).replace_schema_metadata({"mecanum": json.dumps(report.config)})
    file = io.BytesIO()
    pq.write_table(table, file, compression="zstd")
    atomic_write(out / FILE, file.getvalue())


def _type(pa: Any, values: Iterable[Any]) -> Any:
    """Return a metric's type; one that no episode has is a number that none has."""
    found = {type(value) for value in values} - {type(None)}
    exact = {bool: pa.bool_(), int: pa.int64(), str: pa.string()}
    return exact.get(found.pop(), pa.float64()) if len(found) == 1 else pa.float64()
