"""CurveZMQ keys from a shared secret: who has the secret can connect, and nobody else can read or change a message.

The server's key pair is derived from the secret by scrypt, which makes guessing expensive. The client derives it too,
and takes the public key as that of the server; its own key pair is fresh. Neither key is ever sent in the clear, and
the handshake fails for a client that does not know the server's public key, so only holders of the secret get through.

References:
    CurveZMQ, https://rfc.zeromq.org/spec/26/: each handshake agrees on fresh keys, so that a message can be neither
    read, changed nor repeated, and recorded traffic stays secret if the shared secret leaks later.
    Percival and Josefsson, RFC 7914 (scrypt); N = 2^14, r = 8, p = 1 is its recommendation for interactive use.
"""

from __future__ import annotations

import functools
import hashlib
from typing import Any

import zmq
from zmq.utils import z85

SECRET_VARIABLE = "RARE_ENVS_SECRET"
"""Environment variable with the shared secret; on a command line other users could read it."""
_SALT = b"rare-envs ego server"
_SCRYPT = {"n": 2**14, "r": 8, "p": 1, "dklen": 32}


@functools.cache
def derive_server_keys(secret: bytes) -> tuple[bytes, bytes]:
    """Return the server's public and secret key, 40 letters of Z85 each.

    Raises:
        ValueError: This ZeroMQ was built without CURVE.

    Example:
        >>> public, private = derive_server_keys(b"open sesame")
        >>> len(public), public == derive_server_keys(b"open barley")[0]
        (40, False)
    """
    if not zmq.has("curve"):
        raise ValueError("A secret needs a ZeroMQ with CURVE, which this one lacks: install another pyzmq.")
    private = z85.encode(hashlib.scrypt(secret, salt=_SALT, **_SCRYPT))
    return zmq.curve_public(private), private


def secure_server(socket: zmq.Socket[Any], secret: bytes) -> None:
    """Let only clients with the secret connect to a socket that will be bound."""
    socket.curve_publickey, socket.curve_secretkey = derive_server_keys(secret)
    socket.curve_server = True


def secure_client(socket: zmq.Socket[Any], secret: bytes) -> None:
    """Let a socket that will be connected talk only to the server with the secret."""
    socket.curve_serverkey = derive_server_keys(secret)[0]
    socket.curve_publickey, socket.curve_secretkey = zmq.curve_keypair()
