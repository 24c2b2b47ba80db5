"""JSON text of files: an object, or one line that says what is wrong."""

import json
from typing import Any


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
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"{source} is not valid JSON: {error}.") from None
    if not isinstance(data, dict):
        raise ValueError(f"{source}: expected a JSON object, got {type(data).__name__}.")
    return data
