"""Serve an ego to simulations in other processes or on other machines: estimate --ego tcp://HOST:PORT.

python -m agents.remote ppo.zip
python -m agents.remote process:ppo.zip --bind tcp://127.0.0.1:6000
RARE_ENVS_SECRET=... python -m agents.remote ppo.zip --bind 'tcp://*:5555'
"""

from __future__ import annotations

import argparse
import signal
import sys
from typing import NoReturn

from rare_envs.startup import advise_install, use_one_thread


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        """Print the error with where help is, and exit."""
        self.exit(2, f"agents.remote: {message}. See python -m agents.remote --help.\n")


def _read_arguments() -> argparse.Namespace:
    """Return what the command line asks for."""
    shape = argparse.RawDescriptionHelpFormatter
    parser = _Parser(prog="python -m agents.remote", description=__doc__, formatter_class=shape, allow_abbrev=False)
    parser.add_argument("ego", metavar="EGO", help="policy to serve: any that rare-envs estimate --ego takes")
    address = "address to listen at; an address beyond 127.0.0.1 needs RARE_ENVS_SECRET (default: %(default)s)"
    parser.add_argument("--bind", default="tcp://127.0.0.1:5555", help=address)
    parser.add_argument("--algo", help="algorithm of the policy file, if the file does not tell it")
    parser.add_argument("--stats", help="file of the policy's VecNormalize statistics, if not next to the policy file")
    parser.add_argument("--trust", action="store_true", help="allow the policy file to execute code")
    return parser.parse_args()


@use_one_thread()
def main() -> None:
    """Serve an ego until a signal ends it; bad input is one line and exit code 2."""
    asked = _read_arguments()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    import agents
    from rare_envs.plugins import is_policy

    try:
        from agents.remote.protocol import read_secret
        from agents.remote.server import EgoServer
    except ImportError:
        sys.exit(_say(f"Serving needs pyzmq and msgpack: {advise_install('remote')}."))
    try:
        loaded = agents.load_ego(asked.ego, algo=asked.algo, trust=asked.trust, stats=asked.stats)
        if not is_policy(loaded):
            raise ValueError(f"Expected an ego with predict, got {asked.ego!r}, which needs more than observations.")
        server = EgoServer(loaded, asked.bind, read_secret(), name=asked.ego)
    except (ValueError, OSError) as error:
        sys.exit(_say(str(error)))
    with server:
        _say(f"Serving {asked.ego} at {server.address}; stop with Ctrl-C.")
        try:
            server.run()
        except KeyboardInterrupt:
            _say("stopped")
            sys.exit(130)


def _say(words: str) -> int:
    """Print a line on standard error, and return the exit code of bad input."""
    print(f"agents.remote: {' '.join(words.split())}", file=sys.stderr, flush=True)
    return 2


if __name__ == "__main__":
    main()
