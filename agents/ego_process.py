"""Program of the process in which an untrusted ego answers; `agents.remote.subprocess_link` starts it.

    python -m agents.ego_process SOCKET ARGUMENTS

SOCKET is the number of an inherited socket, ARGUMENTS are those of `agents.load_ego` as JSON.
"""

from __future__ import annotations

import json
import socket
import sys

from agents.remote.framing import add_length, read_message
from agents.remote.request_handler import RequestHandler


def serve_socket(link: socket.socket, handler: RequestHandler) -> None:
    """Answer until the other side is gone."""
    with link.makefile("rwb") as stream:
        while True:
            try:
                content = read_message(stream.read)
            except EOFError:
                return
            stream.write(add_length(handler.handle(b"", content)))
            stream.flush()


class FailedEgo:
    """Stands for an ego that could not be loaded: it answers the hello with the reason."""

    def __init__(self, reason: str) -> None:
        """Keep the reason."""
        self.reason = reason

    @property
    def observation_space(self) -> None:
        """No space.

        Raises:
            ValueError: Always, with the reason.
        """
        raise ValueError(self.reason)


def main(number: str, arguments: str) -> None:
    """Load an ego and answer for it.

    Args:
        number: Of the inherited socket.
        arguments: Of `agents.load_ego`, as JSON.
    """
    import torch

    from agents.loading import Ego, load_ego

    torch.set_num_threads(1)
    ego: object
    try:
        ego = load_ego(**json.loads(arguments))
        if not isinstance(ego, Ego):
            raise ValueError(f"Expected an ego with predict for a process of its own, got {ego!r}.")
    except (ValueError, OSError) as error:
        ego = FailedEgo(str(error))
    with socket.socket(fileno=int(number)) as link:
        serve_socket(link, RequestHandler(ego))


if __name__ == "__main__":
    main(*sys.argv[1:])
