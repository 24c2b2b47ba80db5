"""Optional libraries of the exports, imported where they are needed."""

from __future__ import annotations

import importlib
from typing import Any


def import_scenariogeneration(part: str) -> Any:
    """Return `scenariogeneration.xosc` or `.xodr`.

    Raises:
        ValueError: It is not installed.
    """
    try:
        return importlib.import_module(f"scenariogeneration.{part}")
    except ImportError as error:
        raise ValueError(
            'OpenSCENARIO and OpenDRIVE need scenariogeneration: pip install "rare-envs[export]".'
        ) from error
