"""Serialization: values as JSON has them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def to_json_value(value: Any) -> Any:
    """Return value with None for NaN and infinities inside it, and Python's numbers for those of NumPy.

    Args:
        value: A number, a string, None, or lists, tuples and dicts of these.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: to_json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json_value(item) for item in value]
    return value
