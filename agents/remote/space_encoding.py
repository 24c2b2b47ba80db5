"""Spaces as maps of the remote protocol. See docs/remote.md."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from agents.remote.protocol import MalformedMessage, Message, is_count, is_shape
from rare_envs.egos.errors import reason_of

MAX_BOUNDS = 1024
"""Entries of a space's bound that are sent."""
MAX_ENTRIES = 2**23
"""Entries of one observation, in a space that a client accepts."""


def encode_space(space: Any) -> Message | None:
    """Return a space as a map; None for a space that the protocol cannot express.

    Example:
        >>> encode_space(spaces.Box(-1.0, 1.0, (2,)))
        {'shape': [2], 'low': -1.0, 'high': 1.0}
        >>> decode_space(encode_space(spaces.Discrete(5)))
        Discrete(5)
    """
    if isinstance(space, spaces.Discrete):
        return {"n": int(space.n)}
    if isinstance(space, spaces.Dict):
        return {"parts": {name: encode_space(part) for name, part in space.items()}}
    if isinstance(space, spaces.Box):
        whole = {"dtype": "|u1"} if space.dtype == np.uint8 else {}
        return {"shape": list(space.shape), **whole, "low": _encode_bound(space.low), "high": _encode_bound(space.high)}
    return None


def _encode_bound(values: NDArray[Any]) -> Any:
    """Return a bound as one number if all entries are equal, as a list, or as None if there are too many entries."""
    if values.size and (values == values.flat[0]).all():
        return float(values.flat[0])
    return values.ravel().tolist() if values.size <= MAX_BOUNDS else None


def decode_space(given: Any) -> spaces.Space[Any] | None:
    """Return the space in a map that `encode_space` made; None if there is none.

    Raises:
        Malformed: It is not of that form.
    """
    try:
        return _decode_space(given, nested=False)
    except Exception as error:  # the server may have sent anything
        raise MalformedMessage(f"a space {given!r:.100}: {reason_of(error)}") from error


def _decode_space(given: Any, nested: bool) -> spaces.Space[Any] | None:
    """Return the space in a map; parts may not have parts of their own."""
    if given is None:
        return None
    if "parts" in given:
        if nested:
            raise MalformedMessage("parts of parts")
        parts = {name: _decode_space(part, nested=True) for name, part in given["parts"].items()}
        if not parts or None in parts.values():
            return None
        return spaces.Dict({name: part for name, part in parts.items() if part is not None})
    if "n" in given:
        if not is_count(given["n"]):
            raise MalformedMessage("n is a whole number")
        return spaces.Discrete(given["n"])
    shape = given["shape"]
    if not is_shape(shape, MAX_ENTRIES):
        raise MalformedMessage(f"shape {shape!r:.50}")
    dtype: Any = np.uint8 if given.get("dtype") == "|u1" else np.float32
    widest = (0, 255) if dtype == np.uint8 else (-np.inf, np.inf)
    low, high = (
        _decode_bound(given.get(end), shape, limit) for end, limit in zip(("low", "high"), widest, strict=True)
    )
    return spaces.Box(low.clip(*widest).astype(dtype), high.clip(*widest).astype(dtype), dtype=dtype)


def _decode_bound(given: Any, shape: list[int], limit: float) -> NDArray[np.float64]:
    """Return a bound for every entry, shape `shape`."""
    bound = np.asarray(limit if given is None else given, dtype=np.float64)
    if np.isnan(bound).any():
        raise MalformedMessage("a bound is NaN")
    return bound.reshape(shape) if bound.ndim else np.full(shape, bound)
