"""Command lines of the trainings: options from a function's signature, one line for an error."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer

RunFolderOption = Annotated[Path, typer.Option(help="Folder; a training that was stopped in it is taken up.")]
DataOption = Annotated[Path | None, typer.Option(help="Folder with the files of US 101: compact tables, or events.")]
NgsimOption = Annotated[Path | None, typer.Option(help="Or a raw NGSIM file, CSV or text.")]
HighdOption = Annotated[Path | None, typer.Option(help="Or a folder with highD's files.")]
LocationOption = Annotated[str | None, typer.Option(help="Location, where an NGSIM file has several.")]


def find_recordings(data: Path | None, ngsim: Path | None, highd: Path | None) -> tuple[str, Path]:
    """Return the one source of recordings among the options: "data", "ngsim" or "highd", and its path.

    Raises:
        ValueError: None is given, or several are.
    """
    named = [(kind, path) for kind, path in (("data", data), ("ngsim", ngsim), ("highd", highd)) if path is not None]
    if len(named) != 1:
        raise ValueError("Expected one of --data FOLDER, --ngsim FILE and --highd FOLDER.")
    return named[0]


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
