"""Command lines of the trainings: options from a function's signature, one line for an error.

Typer reads the options of a command from its signature. A command here may take a whole group of options as one
parameter, annotated with a dataclass; `spread_options` puts the fields of the class into the signature.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import inspect
import itertools
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, get_type_hints

import typer

RunFolderOption = Annotated[Path, typer.Option(help="Folder of the training; one that was stopped in it is continued.")]
LocationOption = Annotated[str | None, typer.Option(help="Location, if an NGSIM file has several.")]


@dataclass(frozen=True, kw_only=True)
class RecordingOptions:
    """Options that name recorded traffic, of which one is given."""

    data: Annotated[Path | None, typer.Option(help="Folder with the files of US 101 (compact tables, or events).")] = (
        None
    )
    ngsim: Annotated[Path | None, typer.Option(help="Raw NGSIM file (CSV or text).")] = None
    highd: Annotated[Path | None, typer.Option(help="Folder with the files of highD.")] = None
    tgsim: Annotated[Path | None, typer.Option(help="File of TGSIM, or a folder with several.")] = None
    i24: Annotated[Path | None, typer.Option(help="JSON file of I-24 MOTION, unpacked.")] = None

    KINDS: ClassVar[tuple[str, ...]] = ("data", "ngsim", "highd", "tgsim", "i24")
    """Names of the options."""

    def kind_and_path(self) -> tuple[str, Path]:
        """Return the option that is given, such as "highd", and its path; a ValueError without one, or with several."""
        given = [(kind, getattr(self, kind)) for kind in self.KINDS if getattr(self, kind) is not None]
        if len(given) != 1:
            options = [f"--{kind}" for kind in self.KINDS]
            raise ValueError(f"Expected one of {', '.join(options[:-1])} and {options[-1]}, with a path.")
        return given[0]


@dataclass(frozen=True, kw_only=True)
class EventOptions(RecordingOptions):
    """Options that name recordings of which events are extracted."""

    coifman: Annotated[Path | None, typer.Option(help="I-80 data of Coifman and Li (.mat or text).")] = None
    location: LocationOption = None
    between: Annotated[
        tuple[float, float] | None, typer.Option(help="First and last Unix time to read of I-24 MOTION [s].")
    ] = None

    KINDS: ClassVar[tuple[str, ...]] = (*RecordingOptions.KINDS, "coifman")


@contextlib.contextmanager
def report_errors(program: str) -> Iterator[None]:
    """Print an error of the arguments or of a file in one line with the program's name, and exit with code 2.

    An interruption is a line too, and code 130.
    """
    try:
        yield
    except (OSError, ValueError, KeyboardInterrupt) as error:
        typer.echo(f"{program}: {error or 'stopped'}", err=True)
        raise typer.Exit(130 if isinstance(error, KeyboardInterrupt) else 2) from None


def run_command(command: Callable[..., None]) -> None:
    """Run a function as the program, its parameters as options and its docstring as help, and end the process."""
    about: dict[str, Any] = {"context_settings": {"max_content_width": 120}, "rich_markup_mode": None}
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, **about)
    app.command()(command)
    app()


def spread_options(command: Callable[..., None]) -> Callable[..., None]:
    """Return the command with the fields of its option classes as options of its own."""
    groups: dict[str, type[Any]] = {}
    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command, eval_str=True).parameters.items():
        group = parameter.annotation
        if isinstance(group, type) and is_dataclass(group):
            groups[name] = group
            hints = get_type_hints(group, include_extras=True)  # each in the module of the class that has the field
            hints |= {
                field: Annotated[hints[field], typer.Option(help=text)] for field, text in _read_docs(group).items()
            }
            options = inspect.signature(group).parameters.values()
            parameters += [option.replace(annotation=hints[option.name]) for option in options]
        else:
            parameters.append(parameter)

    @functools.wraps(command)
    def spread(**values: Any) -> None:
        for name, group in groups.items():
            taken = {field.name: values.pop(field.name) for field in fields(group) if field.name in values}
            try:
                values[name] = group(**taken)
            except ValueError as error:
                raise typer.BadParameter(str(error)) from None
        command(**values)

    keyword_only = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in parameters]
    spread.__signature__ = inspect.Signature(keyword_only)  # type: ignore[attr-defined]
    spread.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    del spread.__wrapped__
    return spread


def _read_docs(group: type[Any]) -> dict[str, str]:
    """Return the docstrings of the fields of a class, in one line each."""
    (body,) = ast.parse(inspect.getsource(group)).body
    assert isinstance(body, ast.ClassDef)
    found = {}
    for field, after in itertools.pairwise(body.body):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(after, ast.Expr):
            text = ast.literal_eval(after.value)
            found[field.target.id] = re.sub(r"\s+", " ", text).replace("`", "")
    return {name: text for name, text in found.items() if name != "KINDS"}
