"""Messages between the simulation and a remote ego: msgpack maps, with arrays as bytes. See docs/remote.md."""

from __future__ import annotations

import math
from typing import Any, TypeGuard

import msgpack
import numpy as np
from numpy.typing import NDArray

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
        Malformed: They are no msgpack map with text for keys, or too many.
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
        Malformed: It holds something else than numbers.
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
        Malformed: It is not of that form, or dtype, shape and bytes do not go together.
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
        Malformed: It is not of that form, or has another number of rows.
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
