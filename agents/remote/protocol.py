"""Messages between the simulation and a remote ego: msgpack maps, arrays as bytes, spaces; and the keys of a secret.

See docs/egos.md. The server's key pair is derived from the shared secret by scrypt, which makes guessing expensive. The
client derives it too, and takes the public key as that of the server; its own key pair is fresh. Neither key is ever
sent in the clear, and the handshake fails for a client that does not know the server's public key, so only holders of
the secret get through.

References:
    CurveZMQ, https://rfc.zeromq.org/spec/26/: each handshake agrees on fresh keys, so that a message can be neither
    read, changed nor repeated, and recorded traffic stays secret if the shared secret leaks later.
    Percival and Josefsson, RFC 7914 (scrypt); N = 2^14, r = 8, p = 1 is its recommendation for interactive use.
"""

from __future__ import annotations

import functools
import hashlib
import math
import os
import reprlib
from typing import Any, TypeGuard

import msgpack
import numpy as np
import zmq
from gymnasium import spaces
from numpy.typing import NDArray
from zmq.utils import z85

from rare_envs.plugins import reason_of

PROTOCOL = 1
"""Version of the protocol; both sides must speak the same."""
MAX_BYTES, MAX_ANSWER_BYTES = 2**28, 2**24
"""Largest message, and the largest with actions: 65,536 rows of 32 numbers."""
MAX_BATCH = 2**16
"""Most rows of a batch."""
MAX_COUNT = 2**63 - 1
"""Largest number of a session or message."""
DTYPES = ("<f4", "<f8", "<i4", "<i8", "|u1")
"""Types of arrays, by NumPy's names."""
_MAX_BOUNDS = 1024
"""Entries of a space's bound that are sent."""
_LIMITS = {"max_array_len": _MAX_BOUNDS, "max_map_len": 64, "max_str_len": 2**16, "max_ext_len": 0}
_MAX_CONTAINERS = 1000
"""Lists and maps of a message: those of one byte each would otherwise take a hundred times its size."""
_MAX_AXES = 5
_MAX_ENTRIES = 2**23
"""Entries of one observation, in a space that a client accepts."""
SECRET_VARIABLE = "RARE_ENVS_SECRET"
"""Environment variable with the shared secret; on a command line other users could read it."""

Message = dict[str, Any]
Socket = zmq.Socket[bytes]


class MalformedMessage(ValueError):
    """A message that is not of the protocol's form, or cannot be answered; docs/egos.md has the codes."""

    def __init__(self, reason: str, code: str = "malformed") -> None:
        super().__init__(reason)
        self.code = code


def demand(holds: object, what: str, code: str = "malformed") -> None:
    """Refuse a message unless a condition holds."""
    if not holds:
        raise MalformedMessage(what, code)


def pack(message: Message) -> bytes:
    """Return a message as bytes."""
    content: bytes = msgpack.packb(message, use_bin_type=True)
    return content


def unpack(content: bytes) -> Message:
    """Return the message in some bytes, whoever wrote them."""
    demand(len(content) <= MAX_BYTES, f"a message of {len(content)} bytes, more than {MAX_BYTES}")
    containers = 0

    def count(container: Any) -> Any:
        nonlocal containers
        containers += 1
        demand(containers <= _MAX_CONTAINERS, f"more than {_MAX_CONTAINERS} lists and maps")
        demand(isinstance(container, list) or all(isinstance(key, str) for key in container), "no map from text")
        return container

    hooks = {"object_hook": count, "list_hook": count}
    try:
        message = msgpack.unpackb(content, raw=False, max_bin_len=len(content), **_LIMITS, **hooks)
    except MalformedMessage:
        raise
    except Exception as error:  # msgpack raises many kinds
        raise MalformedMessage(f"no msgpack: {type(error).__name__}: {error}") from error
    if not isinstance(message, dict):
        raise MalformedMessage("no map from text")
    return message


def open_envelope(frames: list[bytes]) -> tuple[list[bytes], bytes]:
    """Return the empty delimiter of REQ, if it is there, and the message of frames; "" for several frames."""
    delimiter = [b""] if len(frames) > 1 and frames[0] == b"" else []
    return delimiter, frames[-1] if len(frames) == len(delimiter) + 1 else b""


def is_count(value: object, most: int = MAX_COUNT) -> TypeGuard[int]:
    """Return whether a value is an integer from 0 to most; a bool is none."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= most


def _check_shape(value: Any, most: int = MAX_BYTES) -> int:
    """Return the product of a list of sizes; refuse what is none, or has a product above `most`."""
    sizes = isinstance(value, list) and len(value) <= _MAX_AXES and all(is_count(size, most) for size in value)
    demand(sizes and math.prod(value) <= most, f"shape {show(value)}")
    return math.prod(value)


class _Short(reprlib.Repr):
    """Texts of bounded size of what a peer sent, which may be enormous."""

    def repr_bytes(self, x: bytes, level: int) -> str:
        return repr(x[: self.maxother])


def show(value: object, most: int = 50) -> str:
    """Return the first letters of the text of a value that a peer sent."""
    return _Short().repr(value)[:most]


# --- arrays --------------------------------------------------------------------------------------


def pack_array(values: NDArray[Any]) -> Message:
    """Return an array of numbers as a map of dtype, shape and little-endian bytes in C order."""
    wide = values.dtype.itemsize >= 8
    sent = {"b": "|u1", "u": "|u1" if values.dtype == np.uint8 else "<i8", "i": "<i8", "f": "<f8" if wide else "<f4"}
    demand(values.dtype.kind in sent, f"an array of {values.dtype}, expected numbers")
    dtype = sent[values.dtype.kind]
    return {"dtype": dtype, "shape": list(values.shape), "data": values.astype(dtype, copy=False).tobytes()}


def unpack_array(given: Any) -> NDArray[Any]:
    """Return the array in a map that `pack_array` made."""
    demand(
        isinstance(given, dict) and set(given) == {"dtype", "shape", "data"},
        "an array is a map of dtype, shape and data",
    )
    dtype, shape, data = given["dtype"], given["shape"], given["data"]
    demand(dtype in DTYPES, f"dtype {show(dtype)}, expected one of {', '.join(DTYPES)}")
    _check_shape(shape)
    filled = isinstance(data, bytes) and len(data) == math.prod(shape) * np.dtype(dtype).itemsize
    demand(filled, f"data do not fill shape {shape} of {dtype}")
    return np.frombuffer(bytearray(data), dtype=dtype).reshape(shape)  # a bytearray, so that it can be written to


def pack_observation(observed: Any) -> Message:
    """Return an array, or a mapping from names to arrays, as a map; the latter has the entry "parts"."""
    if isinstance(observed, dict):
        return {"parts": {name: pack_array(np.asarray(part)) for name, part in observed.items()}}
    return pack_array(np.asarray(observed))


def unpack_observation(given: Any, batch: int) -> Any:
    """Return the observations of a number of rows in a map that `pack_observation` made."""
    named = isinstance(given, dict) and set(given) == {"parts"}
    parts = given["parts"] if named else {"": given}
    demand(isinstance(parts, dict) and parts, "parts is a map from names to arrays")
    arrays = {name: unpack_array(part) for name, part in parts.items()}
    for part in arrays.values():
        rows = part.ndim >= 2 and len(part) == batch
        demand(rows, f"expected observations of {batch} rows, got shape {part.shape}")
    return arrays if named else arrays[""]


# --- spaces --------------------------------------------------------------------------------------


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
    return values.ravel().tolist() if values.size <= _MAX_BOUNDS else None


def decode_space(given: Any, nested: bool = False) -> spaces.Space[Any] | None:
    """Return the space in a map that `encode_space` made; None if there is none. Parts may not have parts."""
    if given is None:
        return None
    try:
        if "parts" in given and not nested:
            boxes = [part["shape"] for part in given["parts"].values() if part and "shape" in part]
            entries = sum(_check_shape(shape, _MAX_ENTRIES) for shape in boxes)
            demand(entries <= _MAX_ENTRIES, f"{entries} entries of all parts, more than {_MAX_ENTRIES}")
            parts = {name: decode_space(part, nested=True) for name, part in given["parts"].items()}
            return spaces.Dict(parts) if parts and None not in parts.values() else None  # type: ignore[arg-type]
        if "n" in given:
            demand(is_count(given["n"]), "n is a whole number")
            return spaces.Discrete(given["n"])
        _check_shape(given["shape"], _MAX_ENTRIES)
        dtype: Any = np.uint8 if given.get("dtype") == "|u1" else np.float32
        widest = (0, 255) if dtype == np.uint8 else (-np.inf, np.inf)
        bounds = []
        for end, limit in zip(("low", "high"), widest, strict=True):  # one number, or one for every entry
            bound = np.asarray(limit if given.get(end) is None else given[end], dtype=np.float64)
            demand(not np.isnan(bound).any(), "a bound is NaN")
            whole = bound.reshape(given["shape"]) if bound.ndim else np.full(given["shape"], bound)
            bounds.append(whole.clip(*widest).astype(dtype))
        low, high = bounds
        return spaces.Box(low, high, dtype=dtype)
    except Exception as error:  # the server may have sent anything
        raise MalformedMessage(f"a space {show(given, 100)}: {reason_of(error):.200}") from error


# --- secrets -------------------------------------------------------------------------------------


@functools.cache
def derive_server_keys(secret: bytes) -> tuple[bytes, bytes]:
    """Return the server's public and secret key, 40 letters of Z85 each."""
    if not zmq.has("curve"):
        raise ValueError("A secret needs a ZeroMQ with CURVE, which this one lacks: install another pyzmq.")
    scrypted = hashlib.scrypt(secret, salt=b"rare-envs ego server", n=2**14, r=8, p=1, dklen=32)
    private = z85.encode(scrypted)
    return zmq.curve_public(private), private


def read_secret() -> bytes | None:
    """Return the shared secret from the environment; None without one."""
    return os.environ.get(SECRET_VARIABLE, "").encode() or None
