"""Command lines of the trainings: options from a function's signature, one line for an error."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

import typer


@contextlib.contextmanager
def report_errors(program: str) -> Iterator[None]:
    """Print an error of the arguments or of a file in one line, and exit with code 2.

    Args:
        program: Name that the line begins with.

    Raises:
        typer.Exit: The block raises OSError or ValueError.
    """
    try:
        yield
    except (OSError, ValueError) as error:
        typer.echo(f"{program}: {error}", err=True)
        raise typer.Exit(2) from None


def run_command(command: Callable[..., None]) -> None:
    """Run a function as the program that the command line calls, and end the process.

    Args:
        command: Function whose parameters are the options; its docstring is the help.
    """
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(command)
    app()
