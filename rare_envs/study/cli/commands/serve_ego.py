"""Command `serve-ego`: an ego served to simulations in other processes or on other machines."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from rare_envs.study.cli.options import AlgoOption, EgoArgument, StatsOption, TrustOption
from rare_envs.study.errors import BadInput
from rare_envs.threads import use_one_thread


@use_one_thread()
def serve_ego_command(
    ego: EgoArgument,
    bind: Annotated[
        str, typer.Option(help="Address; beyond 127.0.0.1 it needs RARE_ENVS_SECRET.")
    ] = "tcp://127.0.0.1:5555",
    algo: AlgoOption = None,
    stats: StatsOption = None,
    trust: TrustOption = False,
) -> None:
    """Serve an ego to simulations in other processes or on other machines (estimate --ego tcp://...)."""
    serve_ego(ego, bind, algo=algo, trust=trust, stats=stats)


def serve_ego(spec: str, bind: str, algo: str | None = None, trust: bool = False, stats: str | None = None) -> None:
    """Answer requests for an ego until it is interrupted.

    Args:
        spec: As for `agents.load_ego`.
        bind: Address to listen on, such as "tcp://127.0.0.1:5555".
        algo: Algorithm of a `.zip`, if the file does not tell.
        trust: As for `agents.load_ego`.
        stats: Likewise.

    Raises:
        BadInput: The ego cannot be loaded or served, or the address cannot be used.
    """
    import agents
    from rare_envs.egos.validation import is_policy

    try:
        from agents.remote.server import EgoServer
        from agents.remote.zmq_link import read_secret
    except ImportError as error:
        raise BadInput("Serving needs pyzmq and msgpack: pip install 'rare-envs[remote]'.") from error
    try:
        ego = agents.load_ego(spec, algo=algo, trust=trust, stats=stats)
        if not is_policy(ego):
            raise ValueError(f"Expected an ego with predict, got {spec!r}, which needs more than observations.")
        server = EgoServer(ego, bind, read_secret(), name=spec)
    except (ValueError, OSError) as error:
        raise BadInput(error) from error
    with server:
        print(f"Serving {spec} at {server.address}; stop with Ctrl-C.", file=sys.stderr, flush=True)
        server.run()
