"""Files that are replaced whole, files that somebody else may have written, archives in them, and JSON text.

Whoever is killed while writing, or runs out of space, leaves the earlier file. What somebody else may have written is
read only where it is an ordinary file of a bounded size, from which no more is made than so many values.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import re
import secrets
import stat
import sys
import zipfile
from collections.abc import Container, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

if TYPE_CHECKING:
    import pyarrow.parquet

MAX_TEXT_BYTES, MAX_VALUES = 2**25, 500_000
"""Bytes of a text, and values in it, each of which takes some 100 bytes: 1,000 failures of 500 numbers have as many."""
DIGESTED_BYTES = 2**27
"""Bytes at each end of a file that its digest is of: all of an ego, and those of a table that a change moves."""


@contextlib.contextmanager
def replace_file(path: str | Path) -> Iterator[Path]:
    """Yield the path of a draft in the same folder; it takes the file's place when the block ends without an error.

    The draft is on the disk before it takes the place, and the change of the folder after it: a power cut leaves the
    earlier file or the new one. It keeps the ending of the name, which libraries read the format from. A folder of
    somebody else may hold links: none is written through, as that in the file's place is replaced itself, and the draft
    is a new file by a name that nobody foresees. Others may do no more with the file than with the one before it.
    """
    path = Path(path).absolute()  # the working directory may change
    draft = path.with_name(f".{path.stem[:50]}.{secrets.token_hex(8)}.part{path.suffix}")
    os.close(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0), 0o666))
    try:
        yield draft
        _sync(draft)
        with contextlib.suppress(FileNotFoundError):
            if stat.S_ISREG(before := path.lstat().st_mode):
                draft.chmod(before & draft.stat().st_mode)
        draft.replace(path)
    except OSError as error:
        error.filename = error.filename or str(path)  # which a full disk does not name
        raise
    finally:
        draft.unlink(missing_ok=True)
    _sync(path.parent)


def replace_text(path: str | Path, text: str) -> None:
    """Write text in UTF-8 in place of what a file holds; see `replace_file`."""
    with replace_file(path) as draft:
        draft.write_text(text, encoding="utf-8")


def open_ordinary(path: str | Path, most: int = sys.maxsize) -> BinaryIO:
    """Open an ordinary file of at most so many bytes for reading.

    Raises:
        OSError: There is no such file, or it cannot be read.
        ValueError: It is something else, such as a folder, a pipe or a device without an end, or has more bytes.
    """
    # a pipe would be waited for
    number = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    found = os.fstat(number)
    if stat.S_ISREG(found.st_mode) and found.st_size <= most:
        return os.fdopen(number, "rb")
    os.close(number)
    if not stat.S_ISREG(found.st_mode):
        raise ValueError(f"{str(path)!r} is no ordinary file.")
    raise ValueError(f"{str(path)!r} has {found.st_size:,} bytes, more than {most:,}.")


def read_bytes(path: str | Path, most: int) -> bytes:
    """Return what an ordinary file of at most so many bytes holds; see `open_ordinary`."""
    with open_ordinary(path, most) as file:
        content = file.read(most + 1)
    if len(content) > most:  # it has grown, or the system makes it as it is read
        raise ValueError(f"{str(path)!r} has more than {most:,} bytes.")
    return content


def read_text_file(path: str | Path, most: int = MAX_TEXT_BYTES) -> str:
    """Return the text of an ordinary file in UTF-8, with or without a mark of the order of bytes; see `read_bytes`."""
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{str(path)!r} is no text in UTF-8: {error.reason} at byte {error.start:,}.") from error


MAX_ARCHIVE_BYTES, MAX_MEMBERS = 2**30, 10_000
"""Bytes of an archive, and members of it."""
MAX_UNPACKED, MAX_RATIO = 2**26, 4
"""Bytes that any members may unpack to, and the factor by which larger ones may grow: weights and noise do not shrink
when they are packed."""


def read_members(path: str | Path, names: Container[str] | None = None) -> dict[str, bytes]:
    """Return what the members of a zip file hold by name, those of some names or all.

    Raises:
        OSError: There is no such file, or it cannot be read.
        ValueError: It is no ordinary file, no zip file, is damaged, or would unpack to far more than its own size.
    """
    with open_ordinary(path, MAX_ARCHIVE_BYTES) as file:
        if not zipfile.is_zipfile(file):
            raise ValueError(f"{str(path)!r} is not a zip file (or is cut short).")
        file.seek(0)
        if sum(block.count(b"PK\1\2") for block in iter(functools.partial(file.read, 1 << 20), b"")) > MAX_MEMBERS:
            raise ValueError(f"{str(path)!r} has more than {MAX_MEMBERS:,} members.")
        size = os.fstat(file.fileno()).st_size
        try:
            with zipfile.ZipFile(file) as archive:
                members = [member for member in archive.infolist() if names is None or member.filename in names]
                unpacked = sum(member.file_size for member in members)
                if unpacked > max(MAX_UNPACKED, MAX_RATIO * size):
                    raise ValueError(f"it would unpack from {size / 1e6:,.1f} to {unpacked / 1e6:,.0f} MB")
                if not {member.compress_type for member in members} <= {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
                    raise ValueError("it is packed by another method than deflate, which may unpack without bound")
                found = dict[str, bytes]()
                for member in members:
                    with archive.open(member) as unpacking:  # the size that it states is no bound of a plain read
                        found[member.filename] = unpacking.read(member.file_size)
                return found
        except Exception as error:  # the archive and each kind of compression have errors of their own
            raise ValueError(f"{str(path)!r} is damaged: {error}.") from error


MAX_FOOTER_BYTES = 2**24
"""Bytes of the end of a Parquet file that describes it: a thousand row groups of 15 columns have an eighth of that."""


@contextlib.contextmanager
def open_parquet(path: str | Path) -> Iterator[pyarrow.parquet.ParquetFile]:
    """Yield an ordinary Parquet file; a ValueError says in one line what is wrong with it."""
    import pyarrow.parquet  # slow, and only tables need it

    try:
        with open_ordinary(path) as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - 8))
            if int.from_bytes(file.read(4), "little") > MAX_FOOTER_BYTES:
                raise ValueError("its end, which describes it, is too large.")
            file.seek(0)
            with pyarrow.parquet.ParquetFile(file) as table:  # Arrow itself opens names in UTF-8 only
                yield table
    except (OSError, ValueError, KeyError, pyarrow.lib.ArrowException) as error:  # of damaged tables
        raise ValueError(f"Cannot read {str(path)!r}: {' '.join(str(error).split())}") from error


def digest_file(path: Path) -> str:
    """Return the BLAKE2b digest of an ordinary file; of a larger one, of its first and last `DIGESTED_BYTES`."""
    digest = hashlib.blake2b(digest_size=16)
    with open_ordinary(path) as file:
        for start in (0, max(DIGESTED_BYTES, os.fstat(file.fileno()).st_size - DIGESTED_BYTES)):
            file.seek(start)
            for _ in range(DIGESTED_BYTES >> 20):
                digest.update(file.read(1 << 20))
    return digest.hexdigest()


def _sync(path: Path) -> None:
    """Bring a file, or the list of names of a folder, from the system's memory to the disk."""
    if path.is_dir() and os.name != "posix":  # folders cannot be opened there
        return
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


MAX_DIGITS = 300
"""Digits of a whole number that a float can hold, which ends at 1.8e308."""


def _parse_int(digits: str) -> int:
    if len(digits) > MAX_DIGITS:
        raise ValueError(f"a whole number of {len(digits)} digits")
    return int(digits)


def parse_json_object(text: str, source: str) -> dict[str, Any]:
    """Return the JSON object that a text holds; `source` says in an error what it was read from."""
    if sum(map(text.count, ",[{")) > MAX_VALUES:
        raise ValueError(f"{source} has more than {MAX_VALUES:,} values.")
    try:
        data = json.loads(text, parse_int=_parse_int)
    except RecursionError:
        raise ValueError(f"{source} is not valid JSON for this program: nested too deeply.") from None
    except ValueError as error:
        raise ValueError(f"{source} is not valid JSON: {error}.") from None
    if not isinstance(data, dict):
        raise ValueError(f"{source}: expected a JSON object, got {type(data).__name__}.")
    return data


def read_json(path: str | Path) -> dict[str, Any]:
    """Return the JSON object of an ordinary file; see `read_text_file`."""
    return parse_json_object(read_text_file(path), repr(str(path)))


def format_json(value: dict[str, Any]) -> str:
    """Return JSON with one entry per line, but lists of numbers in one line."""
    text = json.dumps(value, indent=2, allow_nan=False)
    # a line that ends with a bracket is no part of a string, which would have no line breaks
    return re.sub(r"\[\n([^\[\]{}\"]*)\n *\]", lambda match: f"[{' '.join(match[1].split())}]", text)
