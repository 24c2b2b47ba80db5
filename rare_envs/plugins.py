"""Modules of the user's own, by name."""

from __future__ import annotations

import contextlib
import difflib
import os
import sys
from collections.abc import Iterable, Iterator


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


def did_you_mean(name: str, valid: Iterable[str]) -> str:
    """`" (did you mean 'x'?)"` for the nearest valid name, empty if none is near."""
    names = {v: v for v in valid}
    names |= {v.split("/")[-1]: v for v in names}  # an id without its namespace
    near = difflib.get_close_matches(name, list(names), n=1)
    return f" (did you mean {names[near[0]]!r}?)" if near else ""
