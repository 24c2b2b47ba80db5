"""Entries of base files: distributions by their keys, small records by their fields, and the checks of numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Any, TypeVar

from rare_envs.distributions.beta import BetaDistribution
from rare_envs.distributions.coordinate_mixture import CoordinateMixture
from rare_envs.distributions.truncated_mixture import TruncatedGaussianMixture

FileDistribution = TruncatedGaussianMixture | CoordinateMixture | BetaDistribution
RecordT = TypeVar("RecordT")


def read_distribution(data: Mapping[str, Any]) -> FileDistribution:
    """Return the distribution of the kind that the keys of a file tell: Beta, a mixture in coordinates, or plain.

    Raises:
        ValueError: A key is missing or its value is not valid.
    """
    if "alpha" in data:
        return BetaDistribution.from_dict(data)
    if "coordinates" in data or data.get("order") or data.get("logarithmic"):
        return CoordinateMixture.from_dict(data)
    return TruncatedGaussianMixture.from_dict(data)


def read_record(kind: type[RecordT], what: str, data: object) -> RecordT:
    """Return a frozen dataclass from an object of a file, with the same names.

    Args:
        kind: The dataclass, whose constructor checks the values.
        what: Key of the object, for messages.
        data: The object.

    Raises:
        ValueError: Not an object, or a name is unknown or missing, or a value is not valid.
    """
    names = [each.name for each in fields(kind)]  # type: ignore[arg-type]  # a dataclass
    if not isinstance(data, Mapping):
        raise ValueError(f"Expected {what} as an object with {', '.join(names)}, got {data!r}.")
    unknown = [str(name) for name in data if name not in names]
    needed = [each.name for each in fields(kind) if each.default is MISSING]  # type: ignore[arg-type]
    missing = [name for name in needed if name not in data]
    if unknown or missing:
        wrong = f"unknown {', '.join(unknown)}" if unknown else f"no {', '.join(missing)}"
        raise ValueError(f"Expected {what} as an object with {', '.join(names)}, got {wrong}.")
    return kind(**data)


def require_count(what: str, value: object, least: int = 1) -> None:
    """Raise a ValueError unless a value is a whole number, `least` or more."""
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ValueError(f"Expected {what} as a whole number, {least} or more, got {value!r}.")


def require_number(what: str, value: object, low: float = 0.0, high: float = math.inf) -> None:
    """Raise a ValueError unless a value is a finite number above `low` and at most `high`."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not low < value <= high or math.isinf(value):
        above = f"above {low:g}" if math.isinf(high) else f"above {low:g}, at most {high:g}"
        raise ValueError(f"Expected {what} as a number {above}, got {value!r}.")


def require_text(what: str, value: object) -> None:
    """Raise a ValueError unless a value is a text that is not empty."""
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"Expected {what} as a text, got {value!r}.")
