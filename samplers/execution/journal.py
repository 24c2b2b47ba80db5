"""Journal: the finished simulations of a run in a file, so that one that was interrupted can be continued.

Methods draw by their seed alone. A continued run therefore asks for the same points in the same order, takes their
outcomes from the journal for as long as it has any, and comes to the result of an undisturbed run.

The file is a `RecordFile`. Its first record is a JSON object that says what the run is. Each other one is a batch: a
line of JSON, with the wall time of the run so far, then f as float64. What was written is on the disk after
`SYNC_SECONDS`, or after the batch if that takes longer.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.execution.record_file import JournalError, NothingRecorded, RecordFile
from samplers.problem import FloatArray
from samplers.system import sync_folder

SYNC_SECONDS = 1.0
"""Longest time for which finished simulations are not on the disk yet: what a power cut loses, beside the batch."""


class JournalRecord(NamedTuple):
    """A batch of finished simulations."""

    points: str
    """Digest of x, see `digest_points`."""
    f: FloatArray
    """Outcomes, shape (n,), or the numbers of another answer."""
    notes: dict[str, Any]
    """What else is known of them, JSON-ready; `n_sim` is their number where it is not that of f."""

    @property
    def n_sim(self) -> int:
        """Number of simulations."""
        return int(self.notes.get("n_sim", len(self.f)))


def digest_points(x: NDArray[Any]) -> str:
    """Return the digest of points x (n, d), by which a record knows them again."""
    return hashlib.blake2b(repr(x.shape).encode() + x.tobytes(), digest_size=16).hexdigest()


def digest_request(kind: str, *arrays: NDArray[Any]) -> str:
    """Return the digest of what is asked for: its kind, points and, of gradients, terms and ticks."""
    return kind + " ".join(digest_points(array) for array in arrays)


class JournalFile:
    """Finished simulations of a run, in their order; one process alone has the file open.

    Attributes:
        path: Of the file.
        head: What the run is, JSON-ready.
        n: Simulations that have been read or written so far.
        n_dropped: Bytes at the end of the file that were dropped: a record that was cut while it was written.
        earlier_seconds: Wall time of the run before this journal was opened, up to its last record [s].

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "journal.bin"
        ...     journal = JournalFile.create(path, {"seed": 1})
        ...     journal.append(JournalRecord("of x", np.array([2.0, -1.0]), {}))
        ...     journal.close()
        ...     journal = JournalFile.open(path)
        ...     print(journal.head, journal.read_next().f, journal.read_next())
        ...     journal.close()
        {'seed': 1} [ 2. -1.] None
    """

    def __init__(
        self, records: RecordFile, head: dict[str, Any], n_dropped: int = 0, earlier_seconds: float = 0.0
    ) -> None:
        """Use an open file that stands behind its head; see `create` and `open`."""
        self.path, self.head, self.n, self.n_dropped = records.path, head, 0, n_dropped
        self.earlier_seconds = earlier_seconds
        self._records = records
        self._waiting: list[tuple[int, bytes]] = []  # records not yet written, with their numbers in the file
        self._opened = self._synced = time.monotonic()
        self._warned = False

    @property
    def has_simulations(self) -> bool:
        """Whether there are finished simulations, read, written or still to be read."""
        return self.n > 0 or self._records.has_more

    @classmethod
    def create(cls, path: Path, head: dict[str, Any], replace: bool = False) -> JournalFile:
        """Begin a journal.

        Args:
            path: Of the file; one without any finished simulations is replaced.
            head: What the run is, JSON-ready.
            replace: Replace a journal with finished simulations too.

        Raises:
            JournalError: There is one already, or another process has it open.
            OSError: It cannot be written.
        """
        records = RecordFile(path, new=True)
        try:
            if not replace and records.size and _has_simulations(records):
                raise JournalError(f"There is a journal already, {str(path)!r}: remove it, or choose another file.")
            records.clear()
            records.write(_encode(head))
            records.sync()
            sync_folder(path.parent)
        except BaseException:
            records.close()
            raise
        return cls(records, head)

    @classmethod
    def open(cls, path: Path, mend: bool = False) -> JournalFile:
        """Continue a journal, all of whose checksums are verified; a record at its end that was cut is dropped.

        Args:
            path: Of the file.
            mend: Of a damaged journal, keep what stands before the damage; one whose first record is damaged is left
                as it is.

        Raises:
            NothingRecorded: It was cut before its first record.
            JournalError: It is damaged, with `mend` in its first record, or another process has it open.
            OSError: It cannot be read.
        """
        records = RecordFile(path)
        try:
            dropped = records.mend(drop=mend)
            first = records.read()
            if first is None:
                raise NothingRecorded(f"{str(path)!r} was cut before its first record; nothing is recorded in it.")
            head = json.loads(first)
            if not isinstance(head, dict):
                raise ValueError("its head is no object")
        except (ValueError, RecursionError) as error:
            records.close()
            if isinstance(error, NothingRecorded):
                raise
            words = str(error) if isinstance(error, JournalError) else f"{str(path)!r} is no journal: {error}."
            raise JournalError(words) from error
        except BaseException:
            records.close()
            raise
        earlier, records.last = _read_elapsed(records.last), None
        return cls(records, head, dropped, earlier)

    def read_next(self) -> JournalRecord | None:
        """Return the next batch; None at the end of the journal.

        Raises:
            JournalError: It is no batch.
        """
        payload = None if self._waiting else self._records.read()
        if payload is None:
            return None
        try:
            line, values = payload.split(b"\n", 1)
            fields = json.loads(line)
            record = JournalRecord(
                str(fields["points"]), np.frombuffer(values, "<f8").astype(np.float64), fields["notes"]
            )
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise JournalError(f"{str(self.path)!r} is no journal of this version: {error}.") from error
        self.n += record.n_sim
        return record

    def append(self, record: JournalRecord) -> None:
        """Write finished simulations; those that cannot be written now are tried again with the next ones.

        Warns:
            UserWarning: They cannot be written; once.
        """
        line = {"points": record.points, "notes": record.notes, "elapsed": round(self._elapsed(), 3)}
        number = self._waiting[-1][0] + 1 if self._waiting else self._records.n
        self._waiting.append((number, _encode(line) + np.asarray(record.f, dtype="<f8").tobytes()))
        self.n += record.n_sim
        try:
            self._write_waiting()
            if time.monotonic() - self._synced >= SYNC_SECONDS:
                self._records.sync()
                self._synced = time.monotonic()
        except OSError as error:
            self._warn(error)

    def flush(self) -> bool:
        """Write what is left, and return whether all simulations so far are in a file that is still there."""
        try:
            self._write_waiting()
        except OSError as error:
            self._warn(error)
        return not self._waiting and self._records.exists

    def close(self) -> None:
        """Leave the journal for later."""
        try:
            self._write_waiting()
            self._records.sync()
        except OSError as error:
            self._warn(error)
        except ValueError:  # closed before
            return
        self._records.close()

    def remove(self) -> None:
        """Remove the journal of a run that is done."""
        self._waiting.clear()
        self._records.remove()

    def _elapsed(self) -> float:
        """Return the wall time of the run so far, without that between an interruption and its resumption [s]."""
        return self.earlier_seconds + time.monotonic() - self._opened

    def _write_waiting(self) -> None:
        while self._waiting:
            number, payload = self._waiting[0]
            if number == self._records.n:  # else it was written before an interruption
                self._records.write(payload)
            del self._waiting[0]

    def _warn(self, error: OSError) -> None:
        """Warn once that simulations are not kept."""
        if not self._warned:
            self._warned = True
            warnings.warn(
                f"Cannot write {str(self.path)!r}: {error.strerror}. The run goes on, but if it is interrupted now the "
                "simulations from here on are lost.",
                stacklevel=4,
            )


def _has_simulations(records: RecordFile) -> bool:
    """Return whether a file has batches, or is damaged or of another kind, so that somebody may want to keep it."""
    try:
        records.mend()
    except NothingRecorded:
        return False
    except JournalError:
        return True
    return records.read() is not None and records.read() is not None


def _read_elapsed(payload: bytes | None) -> float:
    """Return the wall time [s] that a record has; 0 where it has none, as the head."""
    try:
        elapsed = float(json.loads((payload or b"").split(b"\n", 1)[0])["elapsed"])
    except (ValueError, KeyError, TypeError, RecursionError, OverflowError):
        return 0.0
    return elapsed if 0.0 <= elapsed < math.inf else 0.0


def _encode(fields: dict[str, Any]) -> bytes:
    return json.dumps(fields).encode() + b"\n"
