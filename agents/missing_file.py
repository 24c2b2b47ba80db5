"""Errors for files of egos that do not exist, with what stands beside them."""

from __future__ import annotations

import difflib
from pathlib import Path

SHOWN = 3
"""Neighbours that are named."""


def report_missing_file(path: Path) -> FileNotFoundError:
    """Return the error for an ego whose file does not exist, with files that a mistyped path may have meant.

    Example:
        >>> report_missing_file(Path("no/such/ego.zip"))
        FileNotFoundError("No ego at 'no/such/ego.zip': the folder 'no/such' does not exist.")
    """
    return FileNotFoundError(f"No ego at {str(path)!r}{_describe_neighbours(path)}.")


def _describe_neighbours(path: Path) -> str:
    """Return which files of the same kind are in the folder, or what is wrong with it."""
    if not path.parent.is_dir():
        return f": the folder {str(path.parent)!r} does not exist"
    names = sorted(entry.name for entry in path.parent.glob(f"*{path.suffix}"))
    near = difflib.get_close_matches(path.name, names, n=SHOWN, cutoff=0.5) or names[:SHOWN]
    if not near:
        return f": the folder {str(path.parent)!r} has no {path.suffix}"
    return f"; in that folder: {', '.join(near)}"
