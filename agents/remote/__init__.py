"""Egos in other processes and on other machines: client, server and protocol.

The names are imported on first use, since pyzmq and msgpack are optional: `pip install 'rare-envs[remote]'`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agents.remote.client import RemoteEgo, RemoteError
    from agents.remote.server import EgoServer

__all__ = ["EgoServer", "RemoteEgo", "RemoteError"]
_LAZY = {"EgoServer": "server", "RemoteEgo": "client", "RemoteError": "client"}


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LAZY[name]}"), name)
