"""Validation: checks of arguments and settings, whose ValueError states what was expected and what was given."""

import difflib
import math
import sys
from typing import TypeGuard

import numpy as np


def is_number(value: object) -> TypeGuard[float]:
    """Return whether value is a real number (a bool is none) that a float can hold."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return False
    return not isinstance(value, int) or abs(value) <= sys.float_info.max


def is_whole(value: object, least: int) -> TypeGuard[int]:
    """Return whether value is a whole number (a bool is none) of at least `least`."""
    return not isinstance(value, bool) and isinstance(value, int | np.integer) and bool(value >= least)


def check_number(name: str, value: object, low: float, high: float) -> None:
    """Raise a ValueError unless value is a number between low and high, both excluded."""
    if not is_number(value) or not low < value < high:
        between = f"a number above {low:g}" if high == math.inf else f"a number between {low:g} and {high:g}"
        wanted = "a finite number" if low == -math.inf else between
        raise ValueError(f"Expected {name} to be {wanted}, got {value!r}.")


def check_whole(name: str, value: object, least: int) -> None:
    """Raise a ValueError unless value is a whole number of at least `least`."""
    if not is_whole(value, least):
        raise ValueError(f"Expected {name} to be a whole number of at least {least}, got {value!r}.")


def check_name(kind: str, name: object, valid: list[str]) -> None:
    """Raise a ValueError that suggests the nearest valid name unless `name` is one."""
    if isinstance(name, str) and name in valid:
        return
    near = difflib.get_close_matches(str(name), valid, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    raise ValueError(f"Unknown {kind} {name!r}.{hint} Valid: {', '.join(valid)}.")


def check_setting(
    method: str, name: str, value: object, low: float, high: float, *, or_equal_high: bool = False
) -> None:
    """Raise a ValueError unless value is a number with low < value < high (or value = high, if that is allowed)."""
    if is_number(value) and (low < value < high or (or_equal_high and value == high)):
        return
    sign = "<=" if or_equal_high else "<"
    raise ValueError(f"{method}: expected a number {low:g} < {name} {sign} {high:g}, got {value!r}.")


def check_choice(method: str, name: str, value: object, choices: tuple[str, ...]) -> None:
    """Raise a ValueError unless value is one of the choices."""
    if not isinstance(value, str) or value not in choices:
        wanted = " or ".join(f'"{choice}"' for choice in choices)
        raise ValueError(f"{method}: expected {name} {wanted}, got {value!r}.")


def check_count(method: str, name: str, value: object, least: int) -> None:
    """Raise a ValueError unless value is a whole number of at least `least`."""
    if not is_whole(value, least):
        raise ValueError(f"{method}: expected {name} to be a whole number of at least {least}, got {value!r}.")
