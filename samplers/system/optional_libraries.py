"""Optional libraries: a missing one is named with the command that installs it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def needs_library(library: str, purpose: str) -> Iterator[None]:
    """Raise an error that says what to install if an import in the block fails because a library is missing.

    Raises:
        ImportError: If the library, or a part of it, cannot be found.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != library:
            raise
        raise ImportError(f"{purpose} needs {library}: pip install {library}.", name=library) from None
