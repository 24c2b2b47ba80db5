"""Egos in other processes and on other machines: client, server and protocol.

`EgoServer` is imported on first use, since pyzmq and msgpack are optional, of the extra `remote`.
"""

from typing import TYPE_CHECKING

from rare_envs.plugins import make_lazy_getattr

if TYPE_CHECKING:
    from agents.remote.server import EgoServer

__all__ = ["EgoServer"]

__getattr__ = make_lazy_getattr(__name__, {"EgoServer": "agents.remote.server"})
