"""Settings of an ego in its name, such as "idm?time_headway=2&desired_speed=20"."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any
from urllib.parse import parse_qsl

from rare_envs.plugins import did_you_mean


def read_settings(kind: type, query: str) -> dict[str, Any]:
    """Return numbers for fields of a dataclass from "name=value&name=value".

    Args:
        kind: The dataclass; its fields with a number as default can be set. One that is true or false takes 1 or 0.
        query: The settings; empty for none.

    Raises:
        ValueError: If a name is unknown or given twice, or a value is no finite number of the field's kind.

    Example:
        >>> from rare_envs.control.idm import IDM
        >>> read_settings(IDM, "time_headway=2&cut_off=1")
        {'time_headway': 2.0, 'cut_off': True}
        >>> read_settings(IDM, "headway=2")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        ValueError: Unknown setting 'headway' (did you mean 'time_headway'?); expected desired_speed, time_headway, ...
    """
    known = {each.name: type(each.default) for each in fields(kind) if isinstance(each.default, int | float)}
    given: dict[str, Any] = {}
    for name, text in parse_qsl(query, keep_blank_values=True):
        if name not in known:
            raise ValueError(f"Unknown setting {name!r}{did_you_mean(name, known)}; expected {', '.join(known)}.")
        if name in given:
            raise ValueError(f"Expected {name} once, got it again as {text!r}.")
        given[name] = _read_number(name, text, known[name])
    return given


def _read_number(name: str, text: str, kind: type) -> Any:
    """Return a value of a field as what its default is: a float, a whole number, true or false."""
    try:
        value = float(text)
    except ValueError:
        raise ValueError(f"Expected {name} to be a number, got {text!r}.") from None
    if not math.isfinite(value) or value < 0 or (kind is not float and value != int(value)):
        raise ValueError(f"Expected {name} to be a {'finite' if kind is float else 'whole'} number >= 0, got {text!r}.")
    if kind is bool and value not in (0.0, 1.0):
        raise ValueError(f"Expected {name} to be 1 (yes) or 0 (no), got {text!r}.")
    return kind(value)
