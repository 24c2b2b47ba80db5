"""Modules of the user's own, by name."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def working_directory_first() -> Iterator[None]:
    """Find modules in the working directory, as `python -m` does and console scripts do not."""
    here = os.getcwd()
    sys.path.insert(0, here)
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):
            sys.path.remove(here)
