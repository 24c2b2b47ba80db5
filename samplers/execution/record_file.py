"""Record file: checksummed records, one behind the other, in a file that one process alone has open.

The file is `MAGIC`, then records. A record is the length of its payload (8 bytes, little-endian), a CRC-32 of that
length (4 bytes), the payload, and a BLAKE2b digest (16 bytes). Both checksums begin with the digest of the record
before, so that a record that was changed, removed or moved does not match.
"""

from __future__ import annotations

import hashlib
import os
import stat
import struct
import zlib
from pathlib import Path
from typing import IO, NamedTuple

from samplers.system import lock_file

MAGIC = b"samplers records 1\n"
_HEADER = struct.Struct("<QI")
_DIGEST_SIZE = 16
_BLOCK = 1 << 20


class JournalError(ValueError):
    """A journal cannot be used: it is damaged, in use, or of another run."""

    final = True
    """Simulating again would not help."""


class NothingRecorded(JournalError):
    """A journal was cut before its first record was written, so that nothing is lost by beginning it anew."""


class _Place(NamedTuple):
    """Where the next record stands."""

    n: int = 0
    """Records before it."""
    end: int = len(MAGIC)
    """Byte at which it begins."""
    digest: bytes = b""
    """Of the record before."""


class RecordFile:
    """Records of bytes, read and written in their order.

    An interruption of a call leaves the file as it was before the call or as it is after it; `n` says which.

    Attributes:
        path: Of the file.
        last: Payload of the last record that `mend` has verified; None before, and where there is none.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     records = RecordFile(Path(folder) / "records.bin", new=True)
        ...     records.clear()
        ...     records.write(b"first")
        ...     records.close()
        ...     records = RecordFile(Path(folder) / "records.bin")
        ...     print(records.mend(), records.read(), records.read())
        ...     records.close()
        0 b'first' None
    """

    def __init__(self, path: Path, new: bool = False) -> None:
        """Open and lock a file.

        Args:
            path: Of the file.
            new: Make it where there is none; `clear` begins it.

        Raises:
            JournalError: Another process has it open, or it is no ordinary file.
            OSError: It cannot be opened.
        """
        self.path, self._absolute = path, path.absolute()  # the working directory may change
        flags = os.O_RDWR | (os.O_CREAT if new else 0) | getattr(os, "O_BINARY", 0)
        # unbuffered, so that nothing is left behind of a write that failed
        self._file: IO[bytes] = open(os.open(path, flags, 0o666), "r+b", buffering=0)
        self._place = _Place()  # one value, so that no interruption comes between its parts
        self.last: bytes | None = None
        if not stat.S_ISREG(os.fstat(self._file.fileno()).st_mode):  # a pipe would be waited for
            self._file.close()
            raise JournalError(f"{str(path)!r} is no ordinary file.")
        if not lock_file(self._file) or not self.exists:
            self._file.close()
            raise JournalError(f"Another process is writing {str(path)!r}: wait for it to end, or choose another file.")

    @property
    def size(self) -> int:
        """Length of the file in bytes."""
        return os.fstat(self._file.fileno()).st_size

    @property
    def n(self) -> int:
        """Number of records that have been read or written."""
        return self._place.n

    @property
    def exists(self) -> bool:
        """Whether the path still names this file."""
        try:
            return os.path.samestat(os.fstat(self._file.fileno()), self._absolute.stat())
        except OSError:
            return False

    @property
    def has_more(self) -> bool:
        """Whether something stands behind the last record that was read or written; not of a closed file."""
        return not self._file.closed and self.size > self._place.end

    def clear(self) -> None:
        """Remove all records."""
        self._file.truncate(0)
        self._write_at(0, MAGIC)
        self.rewind()

    def rewind(self) -> None:
        """Go back to the first record."""
        self._place = _Place()

    def read(self) -> bytes | None:
        """Return the next record and step over it; None where there is no whole one."""
        self._file.seek(self._place.end)
        header = self._file.read(_HEADER.size)
        if len(header) < _HEADER.size:
            return None
        length, checksum = _HEADER.unpack(header)
        if checksum != self._checksum(length) or length > self.size:
            return None
        payload, digest = self._file.read(length), self._file.read(_DIGEST_SIZE)
        if len(payload) < length or digest != self._digest_of(payload):
            return None
        self._step_over(length, digest)
        return payload

    def write(self, payload: bytes) -> None:
        """Write a record behind the last one that was read or written; if that fails, nothing of it stays.

        Raises:
            OSError: It cannot be written.
        """
        digest, header = self._digest_of(payload), _HEADER.pack(len(payload), self._checksum(len(payload)))
        self._write_at(self._place.end, header + payload + digest)
        self._step_over(len(payload), digest)

    def mend(self, drop: bool = False) -> int:
        """Verify all records, drop one at the end that was cut while it was written, and go back to the first one.

        A power cut leaves a record that ends too early, one whose last parts are missing, or zeros.

        Args:
            drop: Drop all records from the first damaged one on, whatever the damage; not from the first of all on,
                before which nothing stands that could be kept.

        Returns:
            Number of bytes dropped.

        Raises:
            NothingRecorded: The file was cut in its first bytes.
            JournalError: A record is damaged otherwise, or the file is of another kind; the file is left as it is.
        """
        self._file.seek(0)
        begun = self._file.read(len(MAGIC))
        if begun != MAGIC and MAGIC.startswith(begun):
            raise NothingRecorded(f"{str(self.path)!r} was cut at its beginning; nothing is recorded in it.")
        if begun != MAGIC:
            raise JournalError(f"{str(self.path)!r} is of another kind or version: remove it to begin anew.")
        self.rewind()
        n, self.last = 0, None
        while (payload := self.read()) is not None:
            n, self.last = n + 1, payload
        dropped = self.size - self._place.end
        if dropped and not ((drop and n) or self._is_cut()):
            where = f": record {n + 1} does" if n else " from its first record on, which does"
            raise JournalError(f"{str(self.path)!r} is damaged{where} not match its checksum.")
        self._file.truncate(self._place.end)
        self.rewind()
        return dropped

    def sync(self) -> None:
        """Return when all that was written is on the disk."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Leave the file to others."""
        self._file.close()

    def remove(self) -> None:
        """Remove the file."""
        if self.exists:
            self._absolute.unlink()
        self._file.close()

    def _write_at(self, end: int, content: bytes) -> None:
        rest = memoryview(content)
        try:
            self._file.seek(end)
            while rest:  # a full disk takes a part
                rest = rest[self._file.write(rest) :]
        except OSError:
            self._file.truncate(end)
            raise

    def _step_over(self, length: int, digest: bytes) -> None:
        """Go behind the next record, whose payload has a length."""
        n, end, _ = self._place
        self._place = _Place(n + 1, end + _HEADER.size + length + _DIGEST_SIZE, digest)

    def _is_cut(self) -> bool:
        """Return whether what stands behind the last whole record is one record, or zeros alone."""
        end = self._place.end
        self._file.seek(end)
        header = self._file.read(_HEADER.size)
        if len(header) < _HEADER.size:
            return True
        length, checksum = _HEADER.unpack(header)
        if checksum == self._checksum(length):
            return bool(end + _HEADER.size + length + _DIGEST_SIZE >= self.size)
        if header.strip(b"\0"):
            return False
        while block := self._file.read(_BLOCK):
            if block.strip(b"\0"):
                return False
        return True

    def _checksum(self, length: int) -> int:
        return zlib.crc32(self._place.digest + length.to_bytes(8, "little"))

    def _digest_of(self, payload: bytes) -> bytes:
        return hashlib.blake2b(self._place.digest + payload, digest_size=_DIGEST_SIZE).digest()
