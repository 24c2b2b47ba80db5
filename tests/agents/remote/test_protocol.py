"""Messages and arrays survive packing; malformed ones are refused by what is wrong with them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

msgpack = pytest.importorskip("msgpack", reason="the extra remote is optional")
from agents.remote.protocol import (  # noqa: E402
    MAX_BYTES,
    MalformedMessage,
    is_count,
    is_shape,
    pack,
    pack_array,
    pack_observation,
    unpack,
    unpack_array,
    unpack_observation,
)


@pytest.mark.parametrize(
    ("values", "dtype"),
    [
        (np.arange(6.0).reshape(2, 3), "<f8"),
        (np.arange(6, dtype=np.float32).reshape(3, 2).T, "<f4"),
        (np.arange(4, dtype=np.float16), "<f4"),
        (np.arange(3, dtype=np.int32), "<i8"),
        (np.array([1, 2], ">i4"), "<i8"),
        (np.array([True, False]), "|u1"),
        (np.zeros((0, 7), np.uint8), "|u1"),
        (np.array([np.nan, np.inf, -0.0]), "<f8"),
    ],
)
def test_arrays_survive_in_a_type_that_holds_them(values: np.ndarray, dtype: str) -> None:
    packed = unpack(pack({"array": pack_array(values)}))["array"]
    assert packed["dtype"] == dtype
    np.testing.assert_array_equal(unpack_array(packed), values)


@pytest.mark.parametrize("values", [np.array(["a"]), np.array([None]), np.array([1j]), np.array(["2020"], "M8[Y]")])
def test_other_arrays_are_refused(values: np.ndarray) -> None:
    with pytest.raises(MalformedMessage, match="expected numbers"):
        pack_array(values)


def test_observations_of_one_and_of_several_kinds_survive() -> None:
    one, parts = np.ones((2, 7), np.float32), {"a": np.zeros((2, 1)), "b": np.full((2, 3, 3), 7, np.uint8)}
    np.testing.assert_array_equal(unpack_observation(pack_observation(one), 2), one)
    again = unpack_observation(pack_observation(parts), 2)
    assert set(again) == {"a", "b"}
    np.testing.assert_array_equal(again["b"], parts["b"])
    for wrong in (pack_observation(one[:1]), pack_array(np.ones(2)), {"parts": {}}, {"parts": 3}, None):
        with pytest.raises(MalformedMessage):
            unpack_observation(wrong, 2)


@pytest.mark.parametrize(
    "content", [b"", b"\xc1", msgpack.packb(3), msgpack.packb([1]), msgpack.packb({1: 2}), b"\x81\xa1a"]
)
def test_bytes_that_are_no_map_from_text_are_refused(content: bytes) -> None:
    with pytest.raises(MalformedMessage):
        unpack(content)


def test_a_message_that_is_too_large_is_refused_unread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agents.remote.protocol.MAX_BYTES", 10)
    with pytest.raises(MalformedMessage, match="a message of 11 bytes, more than 10"):
        unpack(b"x" * 11)
    assert MAX_BYTES == 2**28


@pytest.mark.parametrize(
    ("value", "valid"),
    [(0, True), (2**63 - 1, True), (2**63, False), (-1, False), (True, False), (1.0, False), ("1", False)],
)
def test_counts(value: Any, valid: bool) -> None:
    assert is_count(value) is valid


@pytest.mark.parametrize(
    ("value", "valid"),
    [
        ([], True),
        ([2, 3], True),
        ([0, 2**28], True),
        ([2**20, 2**9], False),
        ([1] * 6, False),
        ((2,), False),
        ([True], False),
    ],
)
def test_shapes(value: Any, valid: bool) -> None:
    assert is_shape(value) is valid
