"""Behaviour that all commands share: errors in one line and answers as JSON."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Iterator
from typing import Any, NoReturn

import typer
from typer.core import TyperGroup

from rare_envs.egos.errors import EgoGone
from rare_envs.study.errors import BadInput

_UsageError: type[Exception] = typer.BadParameter.__bases__[0]
"""Error that Typer raises for a wrong option or a missing word; older versions of Typer take it from click."""


class OneLineErrors(TyperGroup):
    """Commands whose errors are one line on standard error and exit code 2."""

    def main(self, *args: Any, **extra: Any) -> NoReturn:
        """Run a command and exit."""
        try:
            code = super().main(*args, **{**extra, "standalone_mode": False})
        except _UsageError as error:
            words = getattr(error, "format_message")()  # noqa: B009  (its class differs by version)
            _fail(f"{words.rstrip('.')}{'' if words.endswith('?') else '.'} See rare-envs --help.")
        except (BadInput, EgoGone) as error:
            _fail(str(error))
        except (KeyboardInterrupt, typer.Abort):
            print("stopped", file=sys.stderr)
            sys.exit(130)
        sys.exit(code if isinstance(code, int) else 0)


def _fail(message: str) -> NoReturn:
    """Print an error in one line, and exit."""
    print("rare-envs: " + " ".join(message.split()), file=sys.stderr)
    sys.exit(2)


@contextlib.contextmanager
def show_interruption() -> Iterator[None]:
    """Print the message of a KeyboardInterrupt, which says how to continue the run; Typer would drop it."""
    try:
        yield
    except KeyboardInterrupt as error:
        if str(error):
            print(error, file=sys.stderr)
        raise


def print_json(value: dict[str, Any]) -> None:
    """Print the answer as one JSON object."""
    print(json.dumps(value, indent=2, allow_nan=False))
