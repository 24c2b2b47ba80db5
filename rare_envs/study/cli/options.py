"""Options and answers of commands: options of `Question` and `ExecutorOptions` follow from their fields."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import typer

from rare_envs.study.arguments import ExecutorOptions, Question, option_name
from rare_envs.study.cli.shell import Answer, answering

SCENARIO = ("base", "drivers", "observation", "action", "horizon")
"""Fields of `Question` that are options of each command that drives an ego."""
WORLD = (*SCENARIO, "noise", "weather")
ASKED = (*WORLD, "method", "measure", "gamma", "seed", "collisions", "device", "ensemble_run", "trust")
EGO_FILE = ("algo", "stats")
EVERYTHING = tuple(field.name for field in fields(Question) if field.name != "env_id")
EXECUTOR = tuple(field.name for field in fields(ExecutorOptions))
NOISE = {"on": True, "fixed": "fixed", "off": False}
"""Words of --noise for the `noise` argument of `DrivingProblem`."""
KINDS: dict[str, Any] = {"noise": Literal["on", "fixed", "off"], "executor": Literal["local", "ray"] | None}
"""Types of options of which the fields have another."""


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


def option_of(name: str, owner: type[Any] = Question, **changes: Any) -> Any:
    """Return the option of a field, with changes to what `typer.Option` is told."""
    field = next(each for each in fields(owner) if each.name == name)
    about = {key: field.metadata[key] for key in ("help", "show_default") if key in field.metadata} | changes
    if field.metadata.get("count"):
        return typer.Option(parser=read_count, metavar="INTEGER", **about)
    return typer.Option(field.metadata.get("flags", f"--{option_name(field).replace('_', '-')}"), **about)


EnvArgument = Annotated[
    str, typer.Argument(metavar="ENV", help="Environment, such as rare_envs/CutIn-v0.", callback=read_environment)
]
EgoArgument = Annotated[str, typer.Argument(metavar="EGO", help="An ego, as for estimate --ego.")]
RunArgument = Annotated[Path, typer.Argument(metavar="RUN", help="Folder that rare-envs estimate --out has written.")]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace what the folder of --out has of an earlier run.")]
DetailsOption = Annotated[
    bool, typer.Option("--details", help="Print all intervals, and all parameters of the most likely failure.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]


def command(*names: str, stopped: str = "") -> Callable[[Callable[..., Answer | None]], Callable[..., None]]:
    """Let a function be a command of Typer: the answer that it returns, if any, is printed, as JSON with --json.

    Its parameter `asked` becomes the options of these fields of `Question`, `places` those of `ExecutorOptions`, and it
    gets a mapping of them; `typed` gets the names of what was typed. `stopped` is said of an early interruption.
    """
    groups: dict[str, tuple[type[Any], tuple[str, ...]]] = {
        "asked": (Question, names),
        "places": (ExecutorOptions, EXECUTOR),
    }

    def decorate(function: Callable[..., Answer | None]) -> Callable[..., None]:
        signature = inspect.signature(function, eval_str=True)
        taken = signature.parameters

        @functools.wraps(function)
        def run(context: typer.Context, as_json: bool = False, **values: Any) -> None:
            for group in groups.keys() & taken.keys():
                known = {name: values.pop(name) for name in groups[group][1]}
                values[group] = {name: NOISE[value] if name == "noise" else value for name, value in known.items()}
            if "typed" in taken:
                sources = {name: context.get_parameter_source(name) for name in context.params}
                values["typed"] = {name for name, source in sources.items() if source and source.name == "COMMANDLINE"}
            answering(functools.partial(function, **values), as_json, stopped, values.get("details", False))

        parameters = [_parameter("context", typer.Context)]
        for name, parameter in taken.items():
            if name in groups:
                owner, known = groups[name]
                parameters += [_parameter_of(owner, each) for each in known]
            elif name != "typed":
                parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
        if signature.return_annotation is not None:
            parameters.append(_parameter("as_json", JsonOption, False))
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {each.name: each.annotation for each in parameters}
        del run.__wrapped__
        return run

    return decorate


def _parameter(name: str, annotation: Any, default: Any = inspect.Parameter.empty) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _parameter_of(owner: type[Any], name: str) -> inspect.Parameter:
    """Return the option of a field, as Typer reads it from a signature."""
    kind = KINDS.get(name) or get_type_hints(owner)[name]
    default = "on" if name == "noise" else getattr(owner, name)
    return _parameter(name, Annotated[kind, option_of(name, owner)], default)
