"""Digest of the code, weights and base distributions of runs, by which runs of other code are told apart."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.util import find_spec
from pathlib import Path

SIMULATING_FILES = ("*.py", "*.safetensors", "*.json")
"""Patterns of the files that simulations come from: code, weights, base distributions."""
SIMULATING_PACKAGES = ("rare_envs", "samplers", "agents")


@cache
def digest_code() -> str:
    """Return a digest of the code and data that runs come from: other ones may give other numbers at the same seed.

    Example:
        >>> len(digest_code())
        16
    """
    digest = hashlib.blake2b(digest_size=8)
    for package in SIMULATING_PACKAGES:
        for path in sorted(path for end in SIMULATING_FILES for path in _find_folder(package).rglob(end)):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _find_folder(package: str) -> Path:
    """Return the folder of a package, which is not imported."""
    found = find_spec(package)
    assert found is not None and found.submodule_search_locations is not None
    return Path(found.submodule_search_locations[0])
