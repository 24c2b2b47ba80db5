"""Messages between the simulation and a remote ego: msgpack maps, arrays as bytes, spaces. See docs/egos.md."""

from __future__ import annotations

import math
from typing import Any, TypeGuard

import msgpack
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rare_envs.egos.errors import reason_of

PROTOCOL = 1
"""Version of the protocol; both sides must speak the same."""
MAX_BYTES = 256 * 2**20
"""Largest message."""
MAX_BATCH = 2**16
"""Most rows of a batch."""
MAX_COUNT = 2**63 - 1
"""Largest number of a session or message."""
DTYPES = ("<f4", "<f8", "<i4", "<i8", "|u1")
"""Types of arrays, by NumPy's names."""
_LIMITS = {"max_array_len": 4096, "max_map_len": 64, "max_str_len": 2**16, "max_ext_len": 0}
_MAX_AXES = 5
MAX_BOUNDS = 1024
"""Entries of a space's bound that are sent."""
MAX_ENTRIES = 2**23
"""Entries of one observation, in a space that a client accepts."""

Message = dict[str, Any]


class MalformedMessage(ValueError):
    """A message that is not of the protocol's form."""


def pack(message: Message) -> bytes:
    """Return a message as bytes."""
    content: bytes = msgpack.packb(message, use_bin_type=True)
    return content


def unpack(content: bytes) -> Message:
    """Return the message in some bytes, whoever wrote them.

    Raises:
        MalformedMessage: They are no msgpack map with text for keys, or too many.
    """
    if len(content) > MAX_BYTES:
        raise MalformedMessage(f"a message of {len(content)} bytes, more than {MAX_BYTES}")
    try:
        message = msgpack.unpackb(content, raw=False, strict_map_key=True, max_bin_len=len(content), **_LIMITS)
    except Exception as error:  # msgpack raises many kinds
        raise MalformedMessage(f"no msgpack: {type(error).__name__}: {error}") from error
    if not isinstance(message, dict) or not all(isinstance(key, str) for key in message):
        raise MalformedMessage("no map from text")
    return message


def pack_array(values: NDArray[Any]) -> Message:
    """Return an array as a map of dtype, shape and little-endian bytes in C order.

    Raises:
        MalformedMessage: It holds something else than numbers.
    """
    if values.dtype == bool:
        values = values.astype(np.uint8)
    elif np.issubdtype(values.dtype, np.integer) and values.dtype != np.uint8:
        values = values.astype("<i8")
    elif np.issubdtype(values.dtype, np.floating):
        values = values.astype("<f8" if values.dtype == np.float64 else "<f4")
    if values.dtype.str not in DTYPES:
        raise MalformedMessage(f"an array of {values.dtype}, expected numbers")
    return {"dtype": values.dtype.str, "shape": list(values.shape), "data": values.tobytes()}


def unpack_array(given: Any) -> NDArray[Any]:
    """Return the array in a map that `pack_array` made.

    Raises:
        MalformedMessage: It is not of that form, or dtype, shape and bytes do not go together.
    """
    if not isinstance(given, dict) or set(given) != {"dtype", "shape", "data"}:
        raise MalformedMessage("an array is a map of dtype, shape and data")
    dtype, shape, data = given["dtype"], given["shape"], given["data"]
    if dtype not in DTYPES:
        raise MalformedMessage(f"dtype {dtype!r}, expected one of {', '.join(DTYPES)}")
    if not is_shape(shape):
        raise MalformedMessage(f"shape {shape!r:.100}")
    if not isinstance(data, bytes) or len(data) != math.prod(shape) * np.dtype(dtype).itemsize:
        raise MalformedMessage(f"data do not fill shape {shape} of {dtype}")
    return np.frombuffer(bytearray(data), dtype=dtype).reshape(shape)  # a bytearray, so that it can be written to


def pack_observation(observed: Any) -> Message:
    """Return an array, or a mapping from names to arrays, as a map; the latter has the entry "parts"."""
    if isinstance(observed, dict):
        return {"parts": {name: pack_array(np.asarray(part)) for name, part in observed.items()}}
    return pack_array(np.asarray(observed))


def unpack_observation(given: Any, batch: int) -> Any:
    """Return the observations in a map that `pack_observation` made.

    Raises:
        MalformedMessage: It is not of that form, or has another number of rows.
    """
    named = isinstance(given, dict) and set(given) == {"parts"}
    parts = given["parts"] if named else {"": given}
    if not isinstance(parts, dict) or not parts or not all(isinstance(name, str) for name in parts):
        raise MalformedMessage("parts is a map from names to arrays")
    arrays = {name: unpack_array(part) for name, part in parts.items()}
    for part in arrays.values():
        if part.ndim < 2 or len(part) != batch:
            raise MalformedMessage(f"expected observations of {batch} rows, got shape {part.shape}")
    return arrays if named else arrays[""]


def is_count(value: object, most: int = MAX_COUNT) -> TypeGuard[int]:
    """Return whether a value is an integer from 0 to most; a bool is none."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= most


def is_shape(value: object, most: int = MAX_BYTES) -> TypeGuard[list[int]]:
    """Return whether a value is a list of sizes with a product of at most `most`."""
    if not isinstance(value, list) or len(value) > _MAX_AXES or not all(is_count(size, most) for size in value):
        return False
    return math.prod(value) <= most


def encode_space(space: Any) -> Message | None:
    """Return a space as a map; None for a space that the protocol cannot express."""
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
        MalformedMessage: It is not of that form.
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
