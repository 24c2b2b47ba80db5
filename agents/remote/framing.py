"""Frames on a byte stream: each message follows its length, an unsigned 32-bit big-endian integer."""

from __future__ import annotations

import struct
from collections.abc import Callable

LENGTH = struct.Struct(">I")
"""Length of a message in bytes, before the message."""


def add_length(content: bytes) -> bytes:
    r"""Return a message with its length before it.

    Example:
        >>> add_length(b"ping")
        b'\x00\x00\x00\x04ping'
    """
    return LENGTH.pack(len(content)) + content


def read_message(read: Callable[[int], bytes]) -> bytes:
    r"""Read one message.

    Args:
        read: Returns as many bytes as it is asked for; fewer at the end of the stream.

    Raises:
        EOFError: The stream ends before the message does.

    Example:
        >>> import io
        >>> read_message(io.BytesIO(b"\x00\x00\x00\x04ping").read)
        b'ping'
    """
    head = read(LENGTH.size)
    if len(head) < LENGTH.size:
        raise EOFError("the stream ended")
    (size,) = LENGTH.unpack(head)
    content = read(size)
    if len(content) < size:
        raise EOFError(f"the stream ended after {len(content)} of {size} bytes")
    return content
