"""Folder of a reproduction: where it holds another one, it is refused before any run is made."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rare_envs.study.errors import BadInput


def check_reproduction_folder(out: Path, study: Mapping[str, Any]) -> None:
    """Refuse a folder with runs of another paper, seed, scale or ego.

    Args:
        out: Folder of the files; it need not exist.
        study: What the runs are to be of, as the first line of each file of runs has it under `study`.

    Raises:
        BadInput: A file of runs in the folder is of something else.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with Path(folder, "runs.jsonl").open("w") as file:
        ...         print('{"study": {"paper": "tian2024", "seed": 0}}', file=file)
        ...     check_reproduction_folder(Path(folder), {"paper": "tian2024", "seed": 0})  # these runs go on
    """
    for file in sorted(out.glob("*.jsonl")):
        held = _read_study(file)
        if held is not None and held != study:
            raise BadInput(
                f"{out} holds {_describe_study(held)}; this is {_describe_study(study)}: choose another --out."
            )


def discard_runs(file: Path, paper: str) -> None:
    """Delete a file of runs if they are of a paper; others stay, for `check_reproduction_folder` to refuse.

    Args:
        file: Which need not exist.
        paper: By its name on the command line.
    """
    held = _read_study(file) if file.is_file() else {}
    if held is None or held.get("paper") == paper:
        file.unlink()


def _read_study(file: Path) -> Mapping[str, Any] | None:
    """Return what the runs of a file are of; None for a file without a whole line."""
    with file.open(encoding="utf-8", errors="replace") as lines:
        first = lines.readline()
    if not first.endswith("\n"):
        return None
    try:
        study = json.loads(first)["study"]
    except (ValueError, KeyError, TypeError):
        return {}
    return study if isinstance(study, dict) else {}


def _describe_study(study: Mapping[str, Any]) -> str:
    """Return what runs are of in words."""
    if not study:
        return "runs of another command or version"
    return ", ".join(str(value) if name == "paper" else f"{name} {value}" for name, value in study.items())
