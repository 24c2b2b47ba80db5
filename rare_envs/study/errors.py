"""Input that a person typed and that cannot be used."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


class BadInput(Exception):
    """Something the user gave cannot be used; the message is one line that says what to do."""

    def __init__(self, message: object) -> None:
        super().__init__(" ".join(str(message).split()))


@contextlib.contextmanager
def output_folder(path: Path) -> Iterator[None]:
    """Make the folder for results before the work, so that no run ends without a place to write to.

    What was made goes again, as far as it is empty, if the work fails.

    Args:
        path: The folder; it may exist.

    Raises:
        BadInput: It is a file, or cannot be made or written to.
    """
    new = [folder for folder in (path, *path.parents) if not os.path.exists(folder)]
    try:
        _writable_folder(path)
        yield
    except BaseException:
        for folder in new:  # the innermost first
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


def _writable_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = "there is a file of that name" if os.path.isfile(path) else error.strerror
        raise BadInput(f"Cannot make the folder {str(path)!r}: {reason}.") from error
    if not os.access(path, os.W_OK):
        raise BadInput(f"Cannot write to the folder {str(path)!r}.")
