"""Egos in other processes and on other machines: client, server and protocol.

The names are imported on first use, since pyzmq and msgpack are optional: `pip install 'rare-envs[remote]'`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rare_envs.plugins import make_lazy_getattr

if TYPE_CHECKING:
    from agents.remote.client import RemoteEgo, RemoteError
    from agents.remote.server import EgoServer

__all__ = ["EgoServer", "RemoteEgo", "RemoteError"]

_LAZY = {
    "EgoServer": "agents.remote.server",
    "RemoteEgo": "agents.remote.client",
    "RemoteError": "agents.remote.client",
}

__getattr__ = make_lazy_getattr(__name__, _LAZY)
