"""JSON text of files: an object, or one line that says what is wrong, and text that people can read."""

import json
import re
from typing import Any

_MAX_DIGITS = 300
"""Digits of a whole number that is a float still, which ends at 1.8e308."""


def parse_json_object(text: str, source: str) -> dict[str, Any]:
    """Return the JSON object that a text holds.

    Args:
        text: The text.
        source: What it was read from, for the message of an error.

    Raises:
        ValueError: If it is not valid JSON, or no object.

    Example:
        >>> parse_json_object('{"format": 1}', "the header")
        {'format': 1}
        >>> parse_json_object("[1]", "The header")
        Traceback (most recent call last):
            ...
        ValueError: The header: expected a JSON object, got list.
    """
    try:
        data = json.loads(text, parse_int=_parse_int)
    except RecursionError:
        raise ValueError(f"{source} is not valid JSON for this program: nested too deeply.") from None
    except ValueError as error:
        raise ValueError(f"{source} is not valid JSON: {error}.") from None
    if not isinstance(data, dict):
        raise ValueError(f"{source}: expected a JSON object, got {type(data).__name__}.")
    return data


def format_json(value: dict[str, Any]) -> str:
    """Return JSON with one entry per line, but lists of numbers in one line.

    Example:
        >>> print(format_json({"p": 0.5, "interval": [0.25, 0.75]}))
        {
          "p": 0.5,
          "interval": [0.25, 0.75]
        }
    """
    text = json.dumps(value, indent=2, allow_nan=False)
    # a line that ends with a bracket is no part of a string, which would have no line breaks
    return re.sub(r"\[\n([^\[\]{}\"]*)\n *\]", lambda match: f"[{' '.join(match[1].split())}]", text)


def _parse_int(digits: str) -> int:
    """Return a whole number that a float can hold.

    Raises:
        ValueError: If it is larger.
    """
    if len(digits) > _MAX_DIGITS:
        raise ValueError(f"a whole number of {len(digits)} digits")
    return int(digits)
