"""Files that are replaced whole, files that somebody else may have written, and JSON text.

Whoever is killed while writing, or runs out of space, leaves the earlier file. What somebody else may have written is
read only where it is an ordinary file of a bounded size.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

MAX_TEXT_BYTES = 2**28
"""Bytes of a text of a run: 1,000 failures with 10,000 numbers each have fewer."""


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
    finally:
        draft.unlink(missing_ok=True)
    _sync(path.parent)


def refuse_folder(path: Path) -> None:
    """Refuse to write a file where there is a folder; a link to one is none."""
    if path.is_dir() and not path.is_symlink():
        raise ValueError(f"Cannot write {str(path)!r}: there is a folder of that name.")


def refuse_link(path: Path) -> None:
    """Refuse a link in the place of a folder inside one of somebody else: what is written there would be elsewhere."""
    if path.is_symlink():
        raise ValueError(f"{str(path)!r} is a link, and nothing is written through one: remove it.")


def replace_text(path: str | Path, text: str) -> None:
    """Write text in UTF-8 in place of what a file holds; see `replace_file`."""
    with replace_file(path) as draft:
        draft.write_text(text, encoding="utf-8")


def check_ordinary(path: str | Path, most: int | None = None) -> None:
    """Refuse what is no ordinary file, such as a pipe or a device without an end, or has more bytes than `most`."""
    found = os.stat(path)
    if not stat.S_ISREG(found.st_mode):
        raise ValueError(f"{str(path)!r} is no ordinary file.")
    if most is not None and found.st_size > most:
        raise ValueError(f"{str(path)!r} has {found.st_size:,} bytes, more than {most:,}.")


def read_text_file(path: str | Path) -> str:
    """Return the text of an ordinary file in UTF-8 of at most `MAX_TEXT_BYTES`."""
    check_ordinary(path, MAX_TEXT_BYTES)
    return Path(path).read_text(encoding="utf-8")


def digest_file(path: Path) -> str:
    """Return the BLAKE2b digest of a file."""
    digest = hashlib.blake2b(digest_size=16)
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
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
    try:
        data = json.loads(text, parse_int=_parse_int)
    except RecursionError:
        raise ValueError(f"{source} is not valid JSON for this program: nested too deeply.") from None
    except ValueError as error:
        raise ValueError(f"{source} is not valid JSON: {error}.") from None
    if not isinstance(data, dict):
        raise ValueError(f"{source}: expected a JSON object, got {type(data).__name__}.")
    return data


def format_json(value: dict[str, Any]) -> str:
    """Return JSON with one entry per line, but lists of numbers in one line."""
    text = json.dumps(value, indent=2, allow_nan=False)
    # a line that ends with a bracket is no part of a string, which would have no line breaks
    return re.sub(r"\[\n([^\[\]{}\"]*)\n *\]", lambda match: f"[{' '.join(match[1].split())}]", text)
