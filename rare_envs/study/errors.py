"""Errors in the input of a person, and folders for output."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

MAX_MESSAGE = 2_000
"""Characters of a message, which may repeat a name or a value of any length; of a longer one the middle is left out."""


class BadInput(Exception):
    r"""Input that cannot be used; the message is one line, of at most `MAX_MESSAGE` characters, that says what to do.

    Example:
        >>> raise BadInput("Expected a seed,\n  got None.")
        Traceback (most recent call last):
            ...
        rare_envs.study.errors.BadInput: Expected a seed, got None.
    """

    def __init__(self, message: object) -> None:
        text = " ".join(str(message).split())
        half = MAX_MESSAGE // 2 - 3
        super().__init__(text if len(text) <= MAX_MESSAGE else f"{text[:half]} ... {text[-half:]}")


@contextlib.contextmanager
def as_bad_input(*kinds: type[BaseException]) -> Iterator[None]:
    """Raise errors of these kinds as `BadInput`."""
    try:
        yield
    except kinds as error:
        raise BadInput(error) from error


@contextlib.contextmanager
def output_folder(path: Path) -> Iterator[None]:
    """Make the folder for results before the work, so that no run ends without a place to write to.

    If the work fails, new folders are removed again, as far as they are empty.
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


@contextlib.contextmanager
def output_file(path: Path) -> Iterator[None]:
    """Make the folder of a file before the work, as `output_folder` does."""
    if path.is_dir():
        raise BadInput(f"Expected a file to write, got the folder {str(path)!r}.")
    with output_folder(path.parent):
        yield


def _writable_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = "there is a file of that name" if os.path.isfile(path) else error.strerror
        raise BadInput(f"Cannot make the folder {str(path)!r}: {reason}.") from error
    if not os.access(path, os.W_OK):
        raise BadInput(f"Cannot write to the folder {str(path)!r}.")
