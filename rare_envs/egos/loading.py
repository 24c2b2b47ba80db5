"""Egos by name, file, address or function, where only a text is given."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from rare_envs.egos.needs import RULE_BASED_EGOS

LOADER = "agents.loading"
"""Module whose `load_ego` does it. It stands above this package and is named as a string, as entry points are."""


def load_named_ego(ego: Any) -> Any:
    """Return the ego that a name or file stands for, see `agents.load_ego`, and any other ego as it is.

    Example:
        >>> load_named_ego("idm")
        'idm'
        >>> type(load_named_ego("imitation")).__name__
        'LearnedEgo'

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: It is none of these, or cannot be loaded.
    """
    if not isinstance(ego, str | Path) or ego in RULE_BASED_EGOS:
        return ego
    return importlib.import_module(LOADER).load_ego(ego)
