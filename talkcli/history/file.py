"""Code that writes and searches the SQLite file of a history.

All functions may wait for the disk. If the file can't be used, they raise HistoryError.
"""

from __future__ import annotations

import contextlib
import math
import os
import sqlite3
import stat
import time
from typing import TYPE_CHECKING
from urllib.parse import quote

from talkcli.errors import TalkError
from talkcli.history.rows import COLUMNS, SCHEMA, row_chars, to_row

if TYPE_CHECKING:
    from collections.abc import Sequence

    from talkcli.goals.goal import Goal
    from talkcli.history.rows import Row

    #: The device and inode number of a file.
    FileIdentity = tuple[int, int]

#: Goals that ended longer ago than this are deleted.
MAX_AGE_S = 90 * 24 * 3600.0
#: How long the clock must run without being set before goals are deleted by age. A robot may boot with a wrong time.
STEADY_CLOCK_S = 600.0
#: If the time of day moves this far from the monotonic clock, somebody has set the clock.
_CLOCK_TOLERANCE_S = 60.0
#: Maximum size of the goals and their indexes. Together with the write-ahead log (WAL), the file has at most 64 MB.
MAX_CONTENT_BYTES = 56_000_000
#: Maximum size of the WAL. It can't be emptied while another program reads the file.
MAX_WAL_BYTES = 7_000_000
#: How long to wait while another process writes to the file.
_LOCK_WAIT_S = 2.0
#: With NORMAL, a crash of the server loses no written goals, and a power failure loses only the newest ones. With FAST,
#: deleted texts are overwritten if this needs no additional writing.
_PRAGMAS = """
PRAGMA journal_mode = WAL; PRAGMA synchronous = NORMAL; PRAGMA secure_delete = FAST;
PRAGMA wal_autocheckpoint = 256; PRAGMA journal_size_limit = 1048576;
"""
#: Returns the size of the used pages. A page has 4,096 bytes, which is SQLite's default.
_CONTENT_BYTES = "SELECT (page_count - freelist_count) * 4096 FROM pragma_page_count, pragma_freelist_count"
#: Deletes the goals before the first one that ended in the given time span. Therefore, a goal with a wrong time is kept
#: as long as the goals before it. `+` prevents a slower search with an index.
_DELETE_TOO_OLD = """
DELETE FROM goals WHERE number <
    (SELECT number FROM goals WHERE +ended_at BETWEEN ? AND ? ORDER BY number LIMIT 1)
"""
#: Deletes the oldest 5 % of the goals.
_DELETE_OLDEST = """
DELETE FROM goals WHERE number <=
    (SELECT number FROM goals ORDER BY number LIMIT 1 OFFSET (SELECT count(*) / 20 FROM goals))
"""
_INSERT = f"INSERT INTO goals ({', '.join(COLUMNS)}) VALUES ({', '.join('?' * len(COLUMNS))})"
#: SQLite's error messages for a file with invalid content. In Python 3.10, its exceptions have no error codes.
_DAMAGED = ("malformed", "not a database")
#: Number of steps of a search between two checks of its time limit. This many steps take about 1 ms.
_STEPS_PER_CHECK = 100_000


class HistoryError(TalkError):
    """The history can't be read or written."""

    code = "history_failed"

    def __init__(self, error: Exception, file: FileIdentity | None) -> None:
        """Create the error.

        Args:
            error: what has failed.
            file: the file that was used, or None if there was none.
        """
        super().__init__(getattr(error, "strerror", None) or str(error))
        #: the file if its content is invalid, otherwise None
        self.damaged_file = file if any(each in str(error) for each in _DAMAGED) else None


class HistoryWriter:
    """Writes ended goals to a file, which it creates if necessary. Only one thread may use it."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._connection: sqlite3.Connection | None = None
        #: the file that was opened last
        self._file: FileIdentity | None = None
        #: the difference between the time of day and the monotonic time, and when this difference last changed
        #: (monotonic)
        self._clock_offset, self._steady_since = math.inf, 0.0

    def write(self, goals: Sequence[Goal], damaged_file: FileIdentity | None = None) -> str | None:
        """Write goals, and delete old ones. Return a message if a removed or damaged file was replaced.

        Goals are deleted if they are too old or don't fit. All goals are written in one transaction.

        Args:
            goals: the goals, in the order in which they ended.
            damaged_file: a file that a search has found to be damaged, or None.

        Returns:
            A message about a new file that replaces a removed or damaged one, or None.

        Raises:
            HistoryError: none of the goals was written.
        """
        try:
            if damaged_file and damaged_file == _identity(self._path):
                return self._start_anew(goals)
            return self._write(goals)
        except (sqlite3.Error, OSError) as error:
            self.close()
            failure = HistoryError(error, self._file)
            if damaged_file or not failure.damaged_file:
                raise failure from error
        return self.write(goals, failure.damaged_file)

    def close(self) -> None:
        """Close the file if it is open. A transaction that has not been committed is rolled back."""
        connection, self._connection = self._connection, None
        with contextlib.suppress(sqlite3.Error):
            if connection:
                connection.close()

    def _write(self, goals: Sequence[Goal]) -> str | None:
        """Write goals, and delete old ones. If the file was removed, start a new one and return a message."""
        message = None
        if self._connection and _identity(self._path) != self._file:
            self.close()  # close the file before a new one is created, because closing removes the WAL
            message = f"{self._path} was removed or replaced, so a new history was started"
        connection = self._connection or self._open()
        wal = f"{self._path}-wal"
        is_large = os.path.exists(wal) and os.path.getsize(wal) > MAX_WAL_BYTES
        if is_large and connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()[0]:
            raise OSError("another program has been reading the file for too long")
        connection.execute("BEGIN IMMEDIATE")
        rows = list(map(to_row, goals))
        added_bytes = 4 * sum(map(row_chars, rows))  # a character has at most four bytes
        while connection.execute(_CONTENT_BYTES).fetchone()[0] + added_bytes > MAX_CONTENT_BYTES:
            if connection.execute(_DELETE_OLDEST).rowcount == 0:
                break
        connection.executemany(_INSERT, rows)
        if self._is_clock_steady():
            connection.execute(_DELETE_TOO_OLD, (time.time() - MAX_AGE_S, time.time()))
        connection.execute("COMMIT")
        return message

    def _is_clock_steady(self) -> bool:
        """Return whether the clock has run for `STEADY_CLOCK_S` without being set."""
        now = time.monotonic()
        offset = time.time() - now
        if abs(offset - self._clock_offset) > _CLOCK_TOLERANCE_S:
            self._clock_offset, self._steady_since = offset, now
        return now - self._steady_since >= STEADY_CLOCK_S

    def _open(self) -> sqlite3.Connection:
        """Open the file, and create it if necessary. Return the connection."""
        os.makedirs(os.path.dirname(self._path), mode=0o700, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            os.close(os.open(self._path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o600))
        status = os.lstat(self._path)
        if not stat.S_ISREG(status.st_mode) or status.st_uid != os.geteuid():
            raise OSError("it must be a regular file that belongs to the server's user")
        self._file = status.st_dev, status.st_ino
        self._connection = sqlite3.connect(self._path, timeout=_LOCK_WAIT_S, isolation_level=None)
        self._connection.executescript(_PRAGMAS + SCHEMA)
        return self._connection

    def _start_anew(self, goals: Sequence[Goal]) -> str:
        """Rename a damaged file, and write goals to a new one. Return a message that explains the change."""
        self.close()
        for suffix in ("", "-wal", "-shm"):
            with contextlib.suppress(FileNotFoundError):
                os.replace(self._path + suffix, f"{self._path}.damaged{suffix}")
        self._write(goals)
        return f"{self._path} was damaged; it was renamed to {self._path}.damaged, and a new history was started"


def search(path: str, condition: str, values: Sequence[object], count: int, deadline: float) -> list[Row]:
    """Return the newest rows that fulfil an SQL condition, oldest first. A missing or new file has no rows.

    Args:
        path: the file.
        condition: the SQL expression, with placeholders.
        values: the values of the placeholders.
        count: the maximum number of rows.
        deadline: the monotonic time at which to give up.

    Raises:
        HistoryError: the file can't be read, or reading takes too long.
    """
    query = f"SELECT {', '.join(COLUMNS)} FROM goals WHERE {condition} ORDER BY number DESC LIMIT ?"
    file = _identity(path)
    # SQLite can't create the index of the WAL if the disk is full or read-only. In that case, leave out the WAL.
    for mode in ("mode=ro", "immutable=1") if file else ():
        uri = f"file:{quote(os.fsencode(path))}?{mode}"
        try:
            with contextlib.closing(sqlite3.connect(uri, timeout=_LOCK_WAIT_S, uri=True)) as connection:
                connection.set_progress_handler(lambda: time.monotonic() > deadline, _STEPS_PER_CHECK)
                return connection.execute(query, (*values, count)).fetchall()[::-1]
        except sqlite3.Error as error:
            if time.monotonic() > deadline:
                raise HistoryError(TimeoutError("the search took too long"), file) from error
            if mode == "mode=ro" and "no such table" in str(error):
                return []  # The server has created the file, but has written nothing yet.
            if mode == "immutable=1" or type(error) is sqlite3.DatabaseError or "locked" in str(error):
                raise HistoryError(error, file) from error
    return []


def _identity(path: str) -> FileIdentity | None:
    """Return the device and inode number of a file, or None if there is no file."""
    try:
        status = os.stat(path)
    except FileNotFoundError:
        return None
    return status.st_dev, status.st_ino
