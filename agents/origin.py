"""Where a file comes from: whether others could have changed it."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from agents.ego import innermost, kind_of
from agents.saved import find_statistics


def doubts(spec: str) -> list[str]:
    """Reasons not to open what an ego's name stands for, if opening it can run code; empty if there are none.

    Args:
        spec: As for `agents.load_ego`.
    """
    spec = innermost(spec)
    kind, path = kind_of(spec), Path(spec)
    if kind == "url":
        return [f"{spec!r} is a remote place"]
    if kind != "zip":
        return []
    files = [path, find_statistics(path)] if path.exists() else []
    return [doubt for file in files if file is not None for doubt in writable_by_others(file)]


def writable_by_others(path: Path) -> list[str]:
    """Where others may write: the file, its folder, or a folder above in which they may put another in its place."""
    found, path = [], path.resolve()
    if path.stat().st_mode & stat.S_IWOTH:
        found.append(f"{str(path)!r} is writable by everybody")
    if path.stat().st_uid not in (0, os.getuid()):
        found.append(f"{str(path)!r} belongs to another user")
    for folder in path.parents:
        mode = folder.stat().st_mode
        if mode & stat.S_IWOTH and (folder == path.parent or not mode & stat.S_ISVTX):
            found.append(f"the folder {str(folder)!r} is writable by everybody")
    return found
