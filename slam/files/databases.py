"""SQLite files of which nothing is trusted: what they hold is looked at before any of it is read."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from slam.files.names import plain_name, quoted
from slam.files.reading import MOST_TEXT, check_file

__all__ = ["check_tables", "open_database", "trust"]

_LONGEST_QUERY_S = 30.0
_SLOWEST_DISK = 10e6  # bytes a second
_CHECKED_EVERY = 100_000  # instructions of SQLite's machine


@contextmanager
def open_database(path: Path, *, mode: str = "ro") -> Iterator[sqlite3.Connection]:
    """Open an SQLite file; until :func:`trust` is called, what takes too long is broken off.

    That is half a minute, or what it takes to read all of the file.

    Parameters
    ----------
    mode
        ``ro``: nothing is changed or made; ``rwc``: it is made where it is not there.

    Raises
    ------
    ValueError, sqlite3.Error
        For what is no regular file; for a file that is damaged or takes too long.
    """
    if mode == "ro" or path.exists() or path.is_symlink():
        check_file(path, what="database")
    size = path.stat().st_size if path.exists() else 0
    until = time.monotonic() + max(_LONGEST_QUERY_S, size / _SLOWEST_DISK)  # a check reads all of it
    uri = f"{path.absolute().as_uri()}?mode={mode}"
    # Two runs of the same command wait for each other's rows.
    with closing(sqlite3.connect(uri, uri=True, timeout=60.0, isolation_level=None)) as database:
        database.set_progress_handler(lambda: time.monotonic() > until, _CHECKED_EVERY)
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_TEXT)
        database.execute("PRAGMA trusted_schema = OFF")
        yield database


def check_tables(database: sqlite3.Connection, names: Collection[str], *, alone: bool = False) -> None:
    """Raise ``sqlite3.DatabaseError`` where a table is a view, virtual, computed or damaged; it may be missing.

    ``alone``: also where there is anything else, such as a trigger, which would run when rows are added.
    """
    for kind, name, sql in database.execute("SELECT type, name, sql FROM sqlite_schema").fetchall():
        ours = name in names
        if kind == "index" and sql is None:  # of a primary key
            continue
        if (ours and kind != "table") or (alone and not (ours or str(name).startswith("sqlite_"))):
            raise sqlite3.DatabaseError(f"it holds the {quoted(kind)} {quoted(name)}, which is not its writer's")
        if ours and (
            str(sql).upper().startswith("CREATE VIRTUAL")
            or any(column[-1] for column in database.execute(f"PRAGMA table_xinfo({name})"))
        ):
            raise sqlite3.DatabaseError(f"its table {name} is computed")
    problem = database.execute("PRAGMA quick_check(1)").fetchone()[0]
    if problem != "ok":
        raise sqlite3.DatabaseError(plain_name(" ".join(str(problem).split()), 200))


def trust(database: sqlite3.Connection) -> None:
    """Let statements take their time: what runs was checked."""
    database.set_progress_handler(None, 0)
