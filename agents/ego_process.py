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
from rare_envs.egos.errors import is_policy
from rare_envs.threads import use_one_thread


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


def load_or_explain(arguments: str) -> object:
    """Return an ego, or a `FailedEgo` with the reason why there is none.

    Args:
        arguments: Of `agents.load_ego`, as JSON.
    """
    from agents.loading import load_ego

    try:
        ego = load_ego(**json.loads(arguments))
        if not is_policy(ego):
            raise ValueError(f"Expected an ego with predict for a process of its own, got {ego!r}.")
    except (ValueError, OSError) as error:
        return FailedEgo(str(error))
    return ego


def main(number: str, arguments: str) -> None:
    """Load an ego and answer for it.

    Args:
        number: Of the inherited socket.
        arguments: Of `agents.load_ego`, as JSON.
    """
    with use_one_thread(), socket.socket(fileno=int(number)) as link:
        serve_socket(link, RequestHandler(load_or_explain(arguments)))


if __name__ == "__main__":
    main(*sys.argv[1:])
