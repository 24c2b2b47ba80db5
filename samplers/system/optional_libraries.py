"""Optional libraries: a missing one is named with the command that installs it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def needs_library(library: str, purpose: str) -> Iterator[None]:
    """Raise an error that says what to install if an import in the block fails because a library is missing.

    Args:
        library: Its name, for pip and for import.
        purpose: What needs it, at the beginning of a sentence.

    Raises:
        ImportError: If the library, or a part of it, cannot be found.

    Example:
        >>> with needs_library("carlib", "A drawing"):
        ...     import carlib
        Traceback (most recent call last):
            ...
        ImportError: A drawing needs carlib: pip install carlib.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != library:
            raise
        raise ImportError(f"{purpose} needs {library}: pip install {library}.", name=library) from None
