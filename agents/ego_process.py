"""The program of the process in which an untrusted ego answers; `agents.remote.subprocess_link` starts it."""

from __future__ import annotations

import json
import socket
import sys

from agents.remote.request_handler import RequestHandler
from agents.remote.subprocess_link import _SIZE


def _serve(link: socket.socket, answerer: RequestHandler) -> None:
    """Answer until the other side is gone."""
    with link.makefile("rwb") as stream:
        while len(head := stream.read(_SIZE.size)) == _SIZE.size:
            (content,) = answerer.answer(b"", [stream.read(_SIZE.unpack(head)[0])])
            stream.write(_SIZE.pack(len(content)) + content)
            stream.flush()


class _Unloaded:
    """Stands for an ego that could not be loaded."""

    def __init__(self, reason: str) -> None:
        self.reason = reason

    @property
    def observation_space(self) -> None:
        raise ValueError(self.reason)


def _main(number: str, arguments: str) -> None:
    import torch

    from agents.loading import load_ego

    torch.set_num_threads(1)
    try:
        ego = load_ego(**json.loads(arguments))
        if not callable(getattr(ego, "predict", None)):
            raise ValueError(f"Expected an ego with predict for a process of its own, got {ego!r}.")
    except (ValueError, OSError) as error:
        ego = _Unloaded(str(error))  # type: ignore[assignment]
    with socket.socket(fileno=int(number)) as link:
        _serve(link, RequestHandler(ego))


if __name__ == "__main__":
    _main(*sys.argv[1:])
