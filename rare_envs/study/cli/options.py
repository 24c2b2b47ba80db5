"""Options of the command line: those of `Question` and `ExecutorOptions` follow from their fields."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable
from dataclasses import Field, fields
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from rare_envs.study.arguments import ExecutorOptions, Question, option_name

SCENARIO = ("base", "drivers", "observation", "action", "horizon")
"""Fields of `Question` that are options of each command that drives an ego."""
WORLD = (*SCENARIO, "noise", "weather")
ASKED = (*WORLD, "method", "measure", "gamma", "seed", "collisions", "device", "ensemble_run", "trust")
EGO_FILE = ("algo", "stats")
EVERYTHING = tuple(field.name for field in fields(Question) if field.name != "env_id")
DEFAULT_BUDGET = "that of the method, 6,000 for two-stage"
NOISE = {"on": True, "fixed": "fixed", "off": False}
"""Words of --noise for the `noise` argument of `DrivingProblem`."""


def read_count(text: str) -> int:
    """Return the whole number that a text stands for, such as "10000" or "1e4"."""
    try:
        return int(text)
    except ValueError:
        pass
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not number.is_integer():
        raise typer.BadParameter(f"expected a whole number, such as 10000 or 1e4, got {text!r}.")
    return int(number)


def read_environment(text: str | None) -> str | None:
    """Return the id of an environment with its namespace, where it was typed without."""
    from rare_envs.scenarios.registry import complete_id

    return None if text is None else complete_id(text)


def count_option(help: str, **about: Any) -> Any:
    """Return an option that takes whole numbers, 1e4 too."""
    return typer.Option(help=help, parser=read_count, metavar="INTEGER", **about)


def option_of(name: str, owner: type[Any] = Question) -> Any:
    """Return the option of a field."""
    field = _find_field(owner, name)
    about = {key: field.metadata[key] for key in ("help", "show_default") if key in field.metadata}
    if field.metadata.get("count"):
        return count_option(**about)
    return typer.Option(field.metadata.get("flags", f"--{option_name(field).replace('_', '-')}"), **about)


def _find_field(owner: type[Any], name: str) -> Field[Any]:
    return next(each for each in fields(owner) if each.name == name)


EnvArgument = Annotated[
    str, typer.Argument(metavar="ENV", help="Environment, such as rare_envs/CutIn-v0.", callback=read_environment)
]
EgoArgument = Annotated[str, typer.Argument(metavar="EGO", help="An ego, as for estimate --ego.")]
RunArgument = Annotated[Path, typer.Argument(metavar="RUN", help="Folder that rare-envs estimate --out has written.")]
TrustOption = Annotated[bool, option_of("trust")]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace what the folder of --out has of an earlier run.")]
DetailsOption = Annotated[
    bool, typer.Option("--details", help="Print all intervals, and all parameters of the most likely failure.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]


class ExecutorKind(str, Enum):
    """Words of --executor."""

    LOCAL = "local"
    RAY = "ray"


class NoiseKind(str, Enum):
    """Words of --noise."""

    ON = "on"
    FIXED = "fixed"
    OFF = "off"


_KINDS: dict[str, Any] = {"noise": NoiseKind, "executor": ExecutorKind | None}
"""Types of options of which the fields have another."""


def take_options(*names: str, executor: bool = False) -> Callable[[Callable[..., Any]], Callable[..., None]]:
    """Let a command take options of `Question`, which it gets as the mapping `asked`."""
    groups: dict[str, tuple[type[Any], tuple[str, ...]]] = {"asked": (Question, names)}
    if executor:
        groups["places"] = (ExecutorOptions, tuple(field.name for field in fields(ExecutorOptions)))

    def decorate(command: Callable[..., Any]) -> Callable[..., None]:
        @functools.wraps(command)
        def spread(**values: Any) -> None:
            for group, (_, known) in groups.items():
                values[group] = {name: _read_choice(values.pop(name)) for name in known}
            command(**values)

        parameters: list[inspect.Parameter] = []
        for name, parameter in inspect.signature(command, eval_str=True).parameters.items():
            owner, known = groups.get(name, (None, ()))
            made = [parameter] if owner is None else [_make_parameter(owner, each) for each in known]
            parameters += [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in made]
        spread.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        spread.__annotations__ = {each.name: each.annotation for each in parameters}
        del spread.__wrapped__
        return spread

    return decorate


def _make_parameter(owner: type[Any], name: str) -> inspect.Parameter:
    """Return the option of a field, as Typer reads it from a signature."""
    kind = _KINDS.get(name) or get_type_hints(owner)[name]
    default = NoiseKind.ON if name == "noise" else _find_field(owner, name).default
    annotation = Annotated[kind, option_of(name, owner)]  # type: ignore[valid-type]  # known when the command is made
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _read_choice(value: Any) -> Any:
    """Return the argument that a word stands for."""
    if isinstance(value, NoiseKind):
        return NOISE[value.value]
    return value.value if isinstance(value, Enum) else value
