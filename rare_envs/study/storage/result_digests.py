"""Digests of the files of a finished run: one that was damaged, edited or taken from another run is noticed."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rare_envs.study.storage.names import BLOCKS, EPISODES, FAILURES, FAULT_BLOCKS, FAULTS, RESULT

DIGESTED = (RESULT, FAILURES, BLOCKS, FAULTS, FAULT_BLOCKS, EPISODES)
"""Files that hold numbers of a run; pictures follow from them."""
_BLOCK = 1 << 20


def digest_results(folder: Path) -> dict[str, str]:
    """Return the BLAKE2b digests of the files with numbers in a folder, by name.

    Raises:
        OSError: One of them cannot be read.
    """
    return {name: _digest_file(folder / name) for name in DIGESTED if (folder / name).is_file()}


def find_changed_results(folder: Path, about: Mapping[str, Any]) -> list[str]:
    """Return the files with numbers that are not what the run wrote: changed, removed or added since.

    Args:
        folder: Of the run.
        about: What its study.json holds. One without digests, of an earlier version, tells nothing.

    Raises:
        OSError: A file cannot be read.
    """
    written = about.get("results")
    if not isinstance(written, Mapping):
        return []
    now = digest_results(folder)
    return [name for name in DIGESTED if now.get(name) != written.get(name)]


def _digest_file(path: Path) -> str:
    digest = hashlib.blake2b(digest_size=16)
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()
