"""Options of all commands, from the fields of questions, the file of --config, and their sections on a help page."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import typer
from typer import Argument, Option
from typer.core import TyperCommand

from rare_envs.scenarios.registry import complete_id
from rare_envs.study.arguments import KEYS, ExecutorOptions, Question, option_name
from rare_envs.study.cli.shell import FIELDS, Command, read_count, run_command

PANELS = {
    "Ego and scenario": "ego base scenario sites drivers observation action",
    "Question": "measure gamma",
    "Precision and budget": "method max_sim target_cov confidence plan",
    "Gate": "max_p max_rate max_ratio assume_traffic",
    "Run": "seed workers executor address time_limit memory_limit on_error mend config trust",
    "Output": "out force details as_json help",
}
"""Titles of the sections of a help page and their options, most used first; others are in a section before these."""
FEW = 12
"""Options of a command that need no sections."""


class PanelCommand(TyperCommand):
    """A command whose options are in the sections `PANELS` on its help page, if they are many."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments, and the options in their sections."""
        known = {each.name: each for each in self.get_params(ctx)}
        options = [name for name, each in known.items() if each.param_type_name == "option"]
        panels = {title: [name for name in names.split() if name in options] for title, names in PANELS.items()}
        listed = [name for names in panels.values() for name in names]
        first = [name for name in options if name not in listed]
        if len(options) <= FEW:
            first, panels = first + listed, {}
        sections = {"Arguments": [name for name in known if name not in options], "Options": first, **panels}
        for title, names in sections.items():
            if rows := [row for name in names if (row := known[name].get_help_record(ctx))]:
                with formatter.section(title):
                    formatter.write_dl(rows)


SCENARIO = ("base", "drivers", "observation", "action")
"""Fields of `Question` that are options of each command that drives an ego."""
WORLD_IN_FILES = ("horizon", "noise", "weather", "collisions", "algo", "stats")
RUN_IN_FILES = ("chunk", "core", "device", "ensemble_run", "executor", "address", "time_limit", "memory_limit")
"""Fields that files alone give to commands that estimate: of the scenario and the ego, and of the run."""
EGO_FILE = ("algo", "stats")
KINDS: dict[str, Any] = {"noise": Literal["on", "fixed", "off"], "executor": Literal["local", "ray"] | None}
"""Types of options of which the fields have another."""


def split_words(texts: Iterable[str] | None) -> list[str]:
    """Return the words of texts in which commas stand between words."""
    return [word.strip() for text in texts or () for word in text.split(",") if word.strip()]


EnvArgument = Annotated[str, Argument(metavar="SCENARIO", help=FIELDS["env_id"].metadata["help"], callback=complete_id)]
EgoArgument = Annotated[str, Argument(metavar="EGO", help="Policy under test, as for estimate --ego.")]
RunArgument = Annotated[Path, Argument(metavar="RUN", help="Folder that rare-envs estimate --out has written.")]
ForceOption = Annotated[bool, Option("--force", help="Replace what is there already.")]
DetailsOption = Annotated[bool, Option("--details", help="Print the method, all intervals, parameters and remarks.")]
JsonOption = Annotated[bool, Option("--json", help="Print one JSON object and nothing else.")]


def _make_option(name: str, changes: Mapping[str, str]) -> inspect.Parameter:
    """Return the option of a field, with changes to what `typer.Option` is told."""
    field, kinds = FIELDS[name], {**get_type_hints(Question), **get_type_hints(ExecutorOptions), **KINDS}
    about: dict[str, Any] = {key: field.metadata[key] for key in ("help", "show_default") if key in field.metadata}
    about |= changes
    if field.metadata.get("count"):
        option = Option(parser=read_count, metavar="INTEGER", **about)
    else:
        option = Option(f"--{option_name(field).replace('_', '-')}", **about)
    return _keyword(name, kinds[name], "on" if name == "noise" else field.default, option)


def _keyword(name: str, kind: Any, default: Any, option: Any) -> inspect.Parameter:
    annotation = kind if option is None else Annotated[kind, option]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def command(
    *names: str, more: Sequence[str] = (), texts: Sequence[str] = (), stopped: str = "", **about: Mapping[str, str]
) -> Callable[[Callable[..., Any]], Callable[..., None]]:
    """Let a function be a command of Typer: the answer that it returns, if any, is printed, as JSON with --json.

    Its parameter `asked` becomes the options of these fields of `Question`, and it gets a mapping of them and of
    `more`, which are in the file of --config alone; `executor` is made of those of `ExecutorOptions`. The file may give
    all of these, and parameters of the function that are `texts`. `typed` gets the names of what was typed or filed.
    `stopped` is said of an early interruption. `about` has the words of options that are others than those of the
    fields.
    """
    keys = [key for key, field in KEYS.items() if field.name in (*names, *more)]

    def decorate(function: Callable[..., Any]) -> Callable[..., None]:
        signature = inspect.signature(function, eval_str=True)
        parameters = [_keyword("context", typer.Context, inspect.Parameter.empty, None)]
        for name, parameter in signature.parameters.items():
            if name == "asked":
                parameters += [_make_option(each, about.get(each, {})) for each in names]
            elif name not in ("typed", "executor", *(t for t in texts if parameter.annotation in (str, str | None))):
                parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
        if more:
            only = ", ".join(key for key in keys if KEYS[key].name in more)
            text = "YAML file of options (key: value), which the command line overrides, and of further settings: "
            parameters.append(_keyword("config", Path | None, None, Option(help=f"{text}{only}.")))
        if signature.return_annotation is not None:
            parameters.append(_keyword("as_json", JsonOption, False, None))
        run: Any = functools.partial(run_command, Command(function, names, more, texts, keys, stopped))
        run.__signature__ = inspect.Signature(parameters)
        run.__annotations__ = {each.name: each.annotation for each in parameters}
        run.__doc__, run.__name__, run.file_keys = function.__doc__, function.__name__, (*keys, *texts)
        return run  # type: ignore[no-any-return]

    return decorate
