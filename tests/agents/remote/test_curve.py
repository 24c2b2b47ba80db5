"""CURVE keys follow from the secret alone."""

from __future__ import annotations

import hashlib

import pytest

zmq = pytest.importorskip("zmq", reason="the extra remote is optional")
from agents.remote.curve import derive_server_keys  # noqa: E402


def test_keys_follow_from_the_secret() -> None:
    public, private = derive_server_keys(b"open sesame")
    assert zmq.curve_public(private) == public
    derive_server_keys.cache_clear()
    assert derive_server_keys(b"open sesame") == (public, private)
    others = [derive_server_keys(secret) for secret in (b"open sesame ", b"open barley", b"")]
    assert len({public, *(key for key, _ in others)}) == 4


def test_the_secret_key_is_that_of_scrypt() -> None:
    """So that a client in another language can derive it: scrypt, then Z85 (RFC 32 of ZeroMQ), by its alphabet."""
    alphabet = "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ.-:+=^!/*?&<>()[]{}@%$#"
    raw = hashlib.scrypt(b"open sesame", salt=b"rare-envs ego server", n=16384, r=8, p=1, dklen=32)
    words = [int.from_bytes(raw[k : k + 4], "big") for k in range(0, 32, 4)]
    letters = "".join(alphabet[word // 85**power % 85] for word in words for power in (4, 3, 2, 1, 0))
    assert derive_server_keys(b"open sesame")[1].decode() == letters


def test_a_zeromq_without_curve_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zmq.has", lambda name: False)
    derive_server_keys.cache_clear()
    with pytest.raises(ValueError, match="needs a ZeroMQ with CURVE"):
        derive_server_keys(b"open sesame")
