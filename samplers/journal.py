"""Journal: the finished simulations of a run in a file, so that one that was interrupted can be continued.

Methods draw by their seed alone. A continued run therefore asks for the same points in the same order, takes their
outcomes from the journal for as long as it has any, and comes to the result of an undisturbed run.

The file is a database of SQLite in WAL mode, which one process alone has open. A chunk of finished simulations is a row
of its own transaction, under a digest of its points. What was written is on the disk after `SYNC_SECONDS`, or after the
chunk if that takes longer.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import itertools
import json
import os
import sqlite3
import stat
import time
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray

SYNC_SECONDS = 1.0
"""Longest time for which finished simulations are not on the disk yet: what a power cut loses, beside the chunk."""
FORMAT = 0x72656A31
"""Application id of the file."""
TABLE = (
    "CREATE TABLE chunks (id INTEGER PRIMARY KEY, points TEXT UNIQUE, width INTEGER, n_sim INTEGER, seconds REAL, "
    "notes TEXT, numbers BLOB, digest BLOB)"
)
COLUMNS = "id, points, width, n_sim, seconds, notes, numbers"
INSERT = f"INSERT OR IGNORE INTO chunks ({COLUMNS}, digest) VALUES (?, ?, ?, ?, ?, ?, ?, ?)"
AMEND = "UPDATE chunks SET notes = ?, digest = ? WHERE id = ?"
MAGIC, HEADER_SIZE = b"SQLite format 3\0", 100
HEAD = 0
"""Number of the record that says what the run is, in its notes; chunks have 1 and more."""


class JournalError(ValueError):
    """A journal cannot be used: it is damaged, in use, or of another run; simulating again would not help."""

    final = True


class NothingRecorded(JournalError):
    """A journal was cut before its first record was written, so that nothing is lost by beginning it anew."""


class JournalInUse(JournalError):
    """Another process has the journal open."""


class _Damaged(JournalError):
    """A record does not match its digest."""

    def __init__(self, path: Path, number: int = HEAD, how: str = "") -> None:
        self.number = number
        where = f": record {number + 1} does" if number > HEAD else " from its first record on, which does"
        super().__init__(f"{str(path)!r} is damaged{how or f'{where} not match its checksum'}.")


class _Row(NamedTuple):
    """A record as it is stored, but for its digest."""

    id: int
    points: str
    width: int
    n_sim: int
    seconds: float
    notes: str
    numbers: bytes

    @property
    def digest(self) -> bytes:
        return hashlib.blake2b(repr(self[:6]).encode() + self.numbers, digest_size=16).digest()


def digest_points(x: NDArray[Any]) -> str:
    """Return the digest of points x, by which a record knows them again."""
    return hashlib.blake2b(repr(x.shape).encode() + np.ascontiguousarray(x).tobytes(), digest_size=16).hexdigest()


class Journal:
    """Finished simulations of a run; an interruption of a call leaves the file as before the call, or as after it.

    Attributes:
        path: Of the file.
        head: What the run is, JSON-ready.
        earlier_seconds: Wall time of the run before this journal was opened, up to its last record [s].
    """

    def __init__(self, path: Path, connection: sqlite3.Connection, head: dict[str, Any]) -> None:
        """Use an open file; see `create` and `open`."""
        self.path, self.head, self._absolute = path, head, path.absolute()  # the working directory may change
        self._connection, self._file = connection, os.stat(path)
        self._waiting: list[_Row] = []  # not yet written
        self._opened = self._synced = time.monotonic()
        self._earlier, self._last_taken, self._warned = self._number_of_last(), HEAD, False
        last = connection.execute("SELECT seconds FROM chunks ORDER BY id DESC LIMIT 1").fetchone()
        self.earlier_seconds: float = last[0]

    @classmethod
    def create(cls, path: Path, head: dict[str, Any], replace: bool = False) -> Journal:
        """Begin a journal in the place of one without finished simulations, or of any (`replace`), that is not open."""
        try:  # somebody may want to keep what has chunks, or is damaged or of another kind
            with contextlib.closing(cls.open(path)) as journal:
                keep = journal.has_simulations
        except JournalInUse:
            raise
        except (FileNotFoundError, JournalError) as error:
            keep = not isinstance(error, FileNotFoundError | NothingRecorded)
        if keep and not replace:
            raise JournalError(f"There is a journal already, {str(path)!r}: remove it, or choose another file.")
        _make(path)
        connection = _connect(path)
        try:
            _fill(connection, [_Row(HEAD, "", 0, 0, 0.0, json.dumps(head), b"")])
            connection.execute("PRAGMA wal_checkpoint")
        except sqlite3.Error as error:
            connection.close()
            raise OSError(errno.EIO, str(error)) from error
        return cls(path, connection, head)

    @classmethod
    def open(cls, path: Path, mend: bool = False) -> Journal:
        """Continue a journal, all of whose digests are verified.

        Of a damaged one, `mend` keeps what stands before the damage; if that is its first record it is left as it is.
        Raises NothingRecorded for one that was cut before its first record.
        """
        _check_own(path)
        missing = _count_missing(path)
        try:
            if missing and mend:  # zeros, which no record consists of
                os.truncate(path, os.stat(path).st_size + missing)
            elif missing and not _wal(path).exists():  # where the end is if it was being copied from there
                raise _Damaged(path)
            connection = _connect(path)
            try:
                return cls(path, connection, _verify(path, connection))
            except BaseException as error:
                connection.close()
                if isinstance(error, sqlite3.DatabaseError):
                    raise _Damaged(path) from error
                raise
        except _Damaged as damage:
            if missing and not mend:
                raise JournalError(f"{str(path)!r} is damaged: its end is missing.") from damage
            if not (mend and damage.number > HEAD):
                raise
            new = path.with_name(f"{path.name}.mended")
            _make(new)
            with contextlib.closing(_connect(path)) as damaged, contextlib.closing(_connect(new)) as mended:
                _fill(mended, itertools.islice(_good_rows(path, damaged), damage.number))
            _wal(path).unlink(missing_ok=True)
            os.replace(new, path)
            return cls.open(path)

    @property
    def n(self) -> int:
        """Simulations in the file."""
        return int(self._connection.execute("SELECT coalesce(sum(n_sim), 0) FROM chunks").fetchone()[0])

    @property
    def has_simulations(self) -> bool:
        """Whether there are finished simulations."""
        return bool(self._waiting) or self._number_of_last() > HEAD

    @property
    def has_others(self) -> bool:
        """Whether an earlier run has recorded something after the last chunk that this one has found."""
        return self._last_taken < self._earlier

    def find(self, points: str) -> tuple[FloatArray, dict[str, Any]] | None:
        """Return table and notes of some points by their digest; None where they are not recorded."""
        found = self._connection.execute(f"SELECT {COLUMNS} FROM chunks WHERE points = ?", (points,)).fetchone()
        if found is None:
            return None
        row = _Row(*found)
        self._last_taken = max(self._last_taken, row.id)
        try:
            numbers = np.frombuffer(row.numbers, "<f8").astype(np.float64)
            return numbers.reshape(-1, row.width), dict(json.loads(row.notes))
        except (ValueError, TypeError, RecursionError) as error:
            raise JournalError(f"{str(self.path)!r} is no journal of this version: {error}.") from error

    def append(self, points: str, table: FloatArray, notes: dict[str, Any], n_sim: int) -> None:
        """Write the table (n, k) and notes of n_sim finished simulations under the digest of their points.

        Those that cannot be written are tried again with the next ones; a UserWarning says so once.
        """
        numbers = np.ascontiguousarray(table, dtype="<f8").tobytes()
        elapsed = self.earlier_seconds + time.monotonic() - self._opened  # without that between two parts of the run
        seconds, text = round(elapsed, 3), json.dumps(notes)
        self._waiting.append(_Row(-1, points, table.shape[1], n_sim, seconds, text, numbers))
        self._write_waiting()

    def amend(self, head: dict[str, Any]) -> None:
        """Write another head in the place of the one that it has."""
        row = _Row(HEAD, "", 0, 0, 0.0, json.dumps(head), b"")
        try:
            self._connection.execute(AMEND, (row.notes, row.digest, HEAD))
        except sqlite3.Error as error:
            raise OSError(errno.EIO, str(error)) from error
        self.head = head

    def flush(self) -> int:
        """Write what is left, and return how many simulations are in the file, if it is still there."""
        self._write_waiting()
        return self.n if self._exists else 0

    def close(self) -> None:
        """Leave the journal for later."""
        with contextlib.suppress(sqlite3.ProgrammingError):  # closed before
            self._write_waiting()
        self._connection.close()

    def remove(self) -> None:
        """Remove the journal of a run that is done."""
        there = self._exists
        self._connection.close()
        if there:
            for name in _list_files(self._absolute):
                name.unlink(missing_ok=True)

    @property
    def _exists(self) -> bool:
        """Whether the path still names this file."""
        try:
            return os.path.samestat(self._file, self._absolute.stat())
        except OSError:
            return False

    def _number_of_last(self) -> int:
        return int(self._connection.execute("SELECT max(id) FROM chunks").fetchone()[0])

    def _write_waiting(self) -> None:
        try:
            while self._waiting:  # a record that was written before an interruption is ignored: its points are there
                row = self._waiting[0]._replace(id=self._number_of_last() + 1)
                self._insert(row)
                del self._waiting[0]
            if time.monotonic() - self._synced >= SYNC_SECONDS:
                self._connection.execute("PRAGMA wal_checkpoint")
                self._synced = time.monotonic()
        except sqlite3.OperationalError as error:
            if not self._warned:
                self._warned = True
                warnings.warn(
                    f"Cannot write {str(self.path)!r}: {error}. The run goes on, but if it is interrupted now the "
                    "simulations from here on are lost.",
                    stacklevel=4,
                )

    def _insert(self, row: _Row) -> None:
        self._connection.execute(INSERT, (*row, row.digest))


def _connect(path: Path) -> sqlite3.Connection:
    """Return a connection to a file that nobody else has; raise a JournalError for one in use and for no journal."""
    uri = f"file:{quote(os.fsencode(path.absolute()))}?mode=rw"
    connection = sqlite3.connect(uri, uri=True, timeout=0.0, isolation_level=None)
    begun = () if path.stat().st_size else ("journal_mode = MEMORY",)  # no file that a kill would leave beside it
    try:
        for statement in ("locking_mode = EXCLUSIVE", "trusted_schema = OFF", *begun, "journal_mode = WAL"):
            connection.execute(f"PRAGMA {statement}")
        connection.execute("PRAGMA synchronous = NORMAL")
        connection.execute("BEGIN IMMEDIATE")  # takes the lock, which stays
        connection.execute("COMMIT")
    except sqlite3.OperationalError as error:
        connection.close()
        if "locked" in str(error):
            words = f"Another process is writing {str(path)!r}: wait for it to end, or choose another file."
            raise JournalInUse(words) from error
        raise OSError(errno.EIO, str(error)) from error
    except (sqlite3.DatabaseError, UnicodeDecodeError) as error:  # the second of a message that quotes the damage
        connection.close()
        if "malformed" in str(error) or isinstance(error, UnicodeDecodeError):
            raise _Damaged(path) from error
        raise JournalError(f"{str(path)!r} is of another kind or version: remove it to start again.") from error
    return connection


def _fill(connection: sqlite3.Connection, rows: Iterable[_Row]) -> None:
    """Write the table of a new journal and records, all or nothing."""
    for statement in ("BEGIN", f"PRAGMA application_id = {FORMAT}", TABLE):
        connection.execute(statement)
    connection.executemany(INSERT, ((*row, row.digest) for row in rows))
    connection.execute("COMMIT")


def _count_missing(path: Path) -> int:
    """Return how many bytes are missing at the end of a file by its header."""
    found = os.stat(path)
    with path.open("rb") as file:
        header = file.read(HEADER_SIZE)
    if len(header) < HEADER_SIZE and MAGIC.startswith(header[: len(MAGIC)]) and not _wal(path).exists():
        raise NothingRecorded(f"{str(path)!r} was cut at its beginning; nothing is recorded in it.")
    if len(header) < HEADER_SIZE or not header.startswith(MAGIC):
        return 0
    page_size, n_pages = int.from_bytes(header[16:18], "big"), int.from_bytes(header[28:32], "big")
    return max(min(page_size * n_pages, 2**30 + found.st_size) - found.st_size, 0)  # a header may be damaged too


def _verify(path: Path, connection: sqlite3.Connection) -> dict[str, Any]:
    """Return the head of a journal all of whose records match their digests."""
    schema = [sql for (sql,) in connection.execute("SELECT sql FROM sqlite_master") if sql]
    if not schema:
        raise NothingRecorded(f"{str(path)!r} was cut before its first record; nothing is recorded in it.")
    # a view in the table's place may have rows without end, and triggers change what is written
    if connection.execute("PRAGMA application_id").fetchone()[0] != FORMAT or schema != [TABLE]:
        raise JournalError(f"{str(path)!r} is of another kind or version: remove it to start again.")
    notes, head = [row.notes for row in _good_rows(path, connection) if row.id == HEAD], None
    with contextlib.suppress(ValueError, RecursionError):
        head = json.loads(notes[0])
    if not isinstance(head, dict):
        raise JournalError(f"{str(path)!r} is no journal: its head is no object.")
    # what no record shows: a damaged index finds none of them, and in damaged pages nothing can be written
    if connection.execute("PRAGMA integrity_check(1)").fetchone() != ("ok",):
        ((number,),) = connection.execute("SELECT count(*) FROM chunks NOT INDEXED")
        raise _Damaged(path, number, ": its records match their checksums, but what finds them does not fit them")
    return head


def _good_rows(path: Path, connection: sqlite3.Connection) -> Iterator[_Row]:
    """Yield the records in their order; raise `_Damaged` at one that is."""
    number = HEAD
    try:
        for *fields, digest in connection.execute(f"SELECT {COLUMNS}, digest FROM chunks ORDER BY id"):
            row = _Row(*fields)
            if row.id != number or not isinstance(row.numbers, bytes) or row.digest != digest:
                raise _Damaged(path, number)
            yield row
            number += 1
    except sqlite3.DatabaseError as error:
        raise _Damaged(path, number) from error
    if number == HEAD:
        raise _Damaged(path)


def _list_files(path: Path) -> list[Path]:
    """Return a journal and the files that SQLite keeps beside one."""
    return [path, *(path.with_name(f"{path.name}-{end}") for end in ("wal", "journal", "shm"))]


def _make(path: Path) -> None:
    """Make an empty file in the place of whatever is there; raise what is wrong with the place."""
    for name in _list_files(path):
        name.unlink(missing_ok=True)
    os.close(os.open(path, os.O_CREAT | os.O_EXCL, 0o666))  # which follows no link


def _check_own(path: Path) -> None:
    """Refuse a journal that is a link or a pipe or has another name too, as SQLite writes in place.

    A rollback journal beside it, which names a file that SQLite removes, is of somebody else: none stays in WAL mode.
    """
    if os.path.lexists(rollback := f"{path}-journal"):
        raise JournalError(f"There is {rollback!r}, which no run leaves and which may remove other files: remove it.")
    for name in _list_files(path):
        with contextlib.suppress(FileNotFoundError):
            found = os.lstat(name)
            if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:
                raise JournalError(
                    f"{str(name)!r} is no ordinary file, or has another name too, which would be written to as well: "
                    "put a copy in its place."
                )


def _wal(path: Path) -> Path:
    """Return the file that SQLite keeps beside a database for what is not yet in it."""
    return path.with_name(f"{path.name}-wal")
