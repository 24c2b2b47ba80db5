"""Input that a person typed and that cannot be used."""

from __future__ import annotations

import os
from pathlib import Path


class BadInput(Exception):
    """Something the user gave cannot be used; the message is one line that says what to do."""

    def __init__(self, message: object) -> None:
        super().__init__(" ".join(str(message).split()))


def writable_folder(path: Path) -> None:
    """Make the folder for results, so that no run ends without a place to write to.

    Args:
        path: The folder; it may exist.

    Raises:
        BadInput: It is a file, or cannot be made or written to.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = "there is a file of that name" if path.is_file() else error.strerror
        raise BadInput(f"Cannot make the folder {str(path)!r}: {reason}.") from error
    if not os.access(path, os.W_OK):
        raise BadInput(f"Cannot write to the folder {str(path)!r}.")
