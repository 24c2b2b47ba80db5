"""Trust in code that a folder of somebody else names: it is asked for once, and remembered by what it was given for.

A run's question may name code: an ego or a measure `module:name`, an environment that a module registers. Whoever asks
the question means that code. Whoever replays or resumes a folder that came from elsewhere does not, and modules are
found in the working directory, where such a folder may bring its own. So each run that is made here is noted, and a
folder whose question is not among these runs no code without trust.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

MAX_NOTES = 2**24
"""Bytes of the notes that are read, the last ones: 250,000 runs."""


def note_own_run(question: Mapping[str, Any], code: Sequence[str]) -> None:
    """Note that a question with code `module:name` was asked here; the code may change and is still one's own."""
    if code:
        _append_note(_digest_own(question, code))


def check_code_trust(question: Mapping[str, Any], code: Sequence[str], folder: Path, trust: bool) -> None:
    """Refuse a folder's question that names code, unless it was asked here, or trusted before with the same code.

    With `trust` it is trusted from now on, for as long as question and code stay what they are.
    """
    trusted = _digest_trusted(question, code)
    if trust and code and trusted is not None:
        _append_note(trusted)
    if not trust and code and not {trusted, _digest_own(question, code)} & _read_notes():
        files = {name: find_module_file(name) for name in code}
        named = ", ".join(f"{name!r}{f' ({path})' if path else ''}" for name, path in files.items())
        raise ValueError(
            f"The run in {str(folder)!r} was not made here, and its question runs code: {named}. Look at that code, "
            "then add --trust (trust=True) once; that is remembered until question or code change."
        )


def find_module_file(name: str) -> Path | None:
    """Return the file of the module in `module:name`, found without running anything; None if there is none."""
    parts = name.partition(":")[0].split(".")
    for folder in (os.getcwd(), *sys.path):
        base = Path(folder, *parts)
        for path in (base / "__init__.py", base.with_name(f"{base.name}.py")):
            with contextlib.suppress(OSError, ValueError):
                if path.is_file():
                    return path.resolve()
    return None


def _digest_own(question: Mapping[str, Any], code: Sequence[str]) -> str:
    """Return what identifies a question and the places of its code."""
    return _digest("own", question, [[name, str(find_module_file(name))] for name in code])


def _digest_trusted(question: Mapping[str, Any], code: Sequence[str]) -> str | None:
    """Return what identifies a question and the content of its code; None where that content cannot be read.

    Importing `a.b` runs `a/__init__.py` too. A compiled module has no content here: trust in it is asked for each time.
    """
    contents = []
    for name in code:
        path = find_module_file(name)
        if path is None:
            return None
        folders = path.parents[: name.partition(":")[0].count(".") + (path.name == "__init__.py")]
        files = [path, *(folder / "__init__.py" for folder in folders)]
        try:
            content = b"".join(file.read_bytes() for file in files if file.exists())
        except OSError:
            return None
        contents.append([name, hashlib.sha256(content).hexdigest()])
    return _digest("trusted", question, contents)


def _digest(kind: str, question: Mapping[str, Any], code: list[list[str]]) -> str:
    return hashlib.sha256(json.dumps([kind, dict(question), code], sort_keys=True).encode()).hexdigest()


def find_notes() -> Path:
    """Return the file with the notes, in the user's folder for states of programs (XDG_STATE_HOME)."""
    state = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(state) / "rare-envs" / "runs"


def _read_notes() -> set[str]:
    with contextlib.suppress(OSError), find_notes().open("rb") as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - MAX_NOTES))
        return set(file.read().decode("ascii", "replace").split())
    return set()


def _append_note(digest: str) -> None:
    """Add a note, if there is not one; a folder that cannot be written to makes the next replay ask."""
    if digest in _read_notes():
        return
    with contextlib.suppress(OSError):
        find_notes().parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with find_notes().open("a", encoding="ascii") as file:
            file.write(f"{digest}\n")
