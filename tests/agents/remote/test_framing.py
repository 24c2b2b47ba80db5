"""Messages on a byte stream come out as they went in, and a stream that ends early is told."""

from __future__ import annotations

import io

import pytest

from agents.remote.framing import add_length, read_message


def test_messages_come_out_as_they_went_in() -> None:
    messages = [b"", b"a", b"\x00" * 300, bytes(range(256)) * 300]
    stream = io.BytesIO(b"".join(map(add_length, messages)))
    assert [read_message(stream.read) for _ in messages] == messages


def test_the_length_is_big_endian() -> None:
    assert add_length(b"x" * 258)[:4] == b"\x00\x00\x01\x02"


@pytest.mark.parametrize(
    ("content", "reason"), [(b"", "ended"), (b"\x00\x00\x00", "ended"), (b"\x00\x00\x00\x05abc", "3 of 5")]
)
def test_a_stream_that_ends_early_is_told(content: bytes, reason: str) -> None:
    with pytest.raises(EOFError, match=reason):
        read_message(io.BytesIO(content).read)
