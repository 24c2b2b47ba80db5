"""Names of egos and drivers, settings in them, and what a name that leads nowhere may have meant."""

from __future__ import annotations

import difflib
import math
from dataclasses import fields
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

from rare_envs.plugins import did_you_mean

RULE_BASED = "idm"
"""The Intelligent Driver Model with lane keeping."""
LANE_CHANGING = "idm+mobil"
"""The same with lane changes by MOBIL; a driver of the traffic."""
HUMAN = "human"
"""An attentive human driver by a published model."""
VISION = "vision"
"""The shipped ego with a camera."""
SHIPPED_EGOS = ("imitation",)
"""Shipped drivers that were trained to be egos: by their mean actions they keep lane and distance, see docs/egos.md."""
SHIPPED_DRIVERS = ("mgail", "gail")
"""Shipped drivers of the traffic."""


def read_settings(kind: type, query: str) -> dict[str, Any]:
    """Return numbers for fields of a dataclass from "name=value&name=value".

    Args:
        kind: The dataclass; its fields with a number as default can be set. One that is true or false takes 1 or 0.
        query: The settings; empty for none.

    Raises:
        ValueError: If a name is unknown or given twice, or a value is no finite number of the field's kind.
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


def report_missing_file(path: Path) -> FileNotFoundError:
    """Return the error for an ego whose file does not exist, with files that a mistyped path may have meant."""
    return FileNotFoundError(f"No ego at {str(path)!r}{_describe_neighbours(path)}.")


def _describe_neighbours(path: Path) -> str:
    """Return which files of the same kind are in the folder, or what is wrong with it."""
    if not path.parent.is_dir():
        return f": the folder {str(path.parent)!r} does not exist"
    names = sorted(entry.name for entry in path.parent.glob(f"*{path.suffix}"))
    near = difflib.get_close_matches(path.name, names, n=3, cutoff=0.5) or names[:3]
    if not near:
        return f": the folder {str(path.parent)!r} has no {path.suffix}"
    return f"; in that folder: {', '.join(near)}"
