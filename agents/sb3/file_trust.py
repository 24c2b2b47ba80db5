"""Trust in a file that can run code: whether other users could have written it or replaced it."""

from __future__ import annotations

import os
import stat
from pathlib import Path

TRUST = "if you trust where the file comes from, load it with trust=True (--trust)"
"""Advice on a file that was not opened."""
TRUST_CONSEQUENCE = "it is opened as Stable-Baselines3 does, and whatever code is in it runs"
"""Consequence of trust=True."""
TRUST_ADVICE = (
    "others may have put something else there: copy it to a folder of your own, or take away their right to write "
    f"(chmod o-w). With --trust (trust=True) it is opened nevertheless; mind that {TRUST_CONSEQUENCE}, "
    "where otherwise only what is known to be harmless is made of it"
)
"""Advice on a risk."""


def check_origin(*files: Path | None) -> None:
    """Refuse files that other users may have written.

    Raises:
        ValueError: One of them is at risk; the message says why and what to do.
    """
    if reasons := find_origin_risks(*files):
        raise ValueError(f"Will not open it: {'; '.join(reasons)}; {TRUST_ADVICE}.")


def find_origin_risks(*files: Path | None) -> list[str]:
    """Return reasons not to open files; empty if there are none. Files that do not exist give none.

    A file is at risk if everybody may write to it or replace it, in its folder or one above. Where everybody may add
    files but not replace those of others (/tmp), a file of another user is at risk.

    Example:
        >>> find_origin_risks(None, Path("/no/such/file"))
        []
    """
    if os.name != "posix":  # others' rights are not in the mode
        return []
    risks = [risk for file in files if file is not None and file.exists() for risk in _find_risks(file.resolve())]
    return list(dict.fromkeys(risks))


def _find_risks(path: Path) -> list[str]:
    status = path.stat()
    risks = [f"{str(path)!r} is writable by everybody"] if status.st_mode & stat.S_IWOTH else []
    for folder in path.parents:
        mode = folder.stat().st_mode
        if not mode & stat.S_IWOTH:
            continue
        if not mode & stat.S_ISVTX:
            risks.append(f"the folder {str(folder)!r} is writable by everybody")
        elif folder == path.parent and status.st_uid not in (0, os.getuid()):
            risks.append(f"{str(path)!r} belongs to another user, in a folder to which everybody may add")
    return risks
