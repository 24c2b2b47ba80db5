"""What all commands share: options from the fields of questions, answers as text or JSON, errors in one line."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import inspect
import json
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, NoReturn, get_type_hints

import typer
from typer import Argument, Option
from typer.core import TyperCommand, TyperGroup

from rare_envs.plugins import EgoGone, clean_text
from rare_envs.startup import advise_install, find_missing_libraries, restore_signals, use_one_thread
from rare_envs.study.arguments import (
    GATE_CODES,
    KEYS,
    BadInput,
    ExecutorOptions,
    Question,
    UnwrittenResults,
    option_name,
    read_question_file,
    read_whole,
)

DOUBTFUL = 3
"""Exit code of a command that is done, with warnings that make its number doubtful."""
LONGEST_LINE = 4_000
"""Characters of an error or a warning: files and names may bring along any number."""
WHOLE = 1_000
"""Characters of a summary in a list of commands: more than any has."""
_SIGPIPE = int(getattr(signal, "SIGPIPE", 13))
"""Signal of a reader that is gone; Windows has none of this number."""
_ENDING = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGINT") if hasattr(signal, name)]
"""Signals to end; Windows has no SIGHUP."""
_UsageError: type[Exception] = typer.BadParameter.__bases__[0]
"""Error that Typer raises for a wrong option or a missing word; older versions of Typer take it from click."""
_PLAIN_WORDS = (
    (r"Value error, ", ""),
    (r"Input should be a valid number, unable to parse string as a number", "expected a number, such as 0.05"),
    (r"Input should be greater than or equal to", "expected at least"),
    (r"Input should be a valid integer, unable to parse string as an \w+", "expected a whole number"),
)
"""What Typer says of a wrong value in words of the library that it checks values with, and what is said instead."""


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
        options = {each.name: each for each in self.get_params(ctx) if each.param_type_name == "option"}
        panels = {title: names.split() for title, names in PANELS.items()}
        listed = [name for names in panels.values() for name in names]
        panels = {"Options": [name for name in options if name not in listed], **panels}
        if len(options) <= FEW:
            panels = {"Options": [name for names in panels.values() for name in names]}
        sections = {"Arguments": [each for each in self.get_params(ctx) if each.name not in options]}
        sections |= {title: [options[name] for name in names if name in options] for title, names in panels.items()}
        for title, parameters in sections.items():
            if rows := [row for each in parameters if (row := each.get_help_record(ctx))]:
                with formatter.section(title):
                    formatter.write_dl(rows)


class SummarisedCommands(TyperGroup):
    """Commands whose summaries are not cut in the list of them."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands, each with the whole first sentence of its help, in several lines where it is long."""
        commands = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        rows = [(name, found.get_short_help_str(limit=WHOLE)) for name, found in commands if found is not None]
        with formatter.section("Commands"):
            formatter.write_dl(rows)


class OneLineErrors(SummarisedCommands):
    """Commands whose errors are one line on standard error and exit code 2."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command; where an error names an argument of Python, name the option that stands for it."""
        try:
            return super().invoke(ctx)
        except BadInput as error:
            error.args = (name_options(str(error), self.get_command(ctx, ctx.invoked_subcommand)),)
            raise

    def main(self, *args: Any, **extra: Any) -> NoReturn:
        """Run a command and exit."""
        words = list((args[0] if args else extra.get("args")) or sys.argv[1:])
        received: list[int] = []
        code: Any = None
        ended = False
        try:
            restore_signals()
            for stream in (sys.stdout, sys.stderr):  # which may be those of a test, or not take every name
                if reconfigure := getattr(stream, "reconfigure", None):
                    reconfigure(errors="backslashreplace")
            with signals_as_exceptions(received), one_line_warnings():
                code = super().main(*args, **{**extra, "standalone_mode": False})
                ended = code != 128 + signal.SIGINT
        except _UsageError as error:
            if advice := advise_elsewhere(error, words):
                _fail(advice)
            said = getattr(error, "format_message")()  # noqa: B009  (differs by version)
            for pattern, plain in _PLAIN_WORDS:
                said = re.sub(pattern, plain, said)
            path = getattr(getattr(error, "ctx", None), "command_path", "") or self._find_path(words)
            help_command = " ".join(["rare-envs", *path.split()[1:]])
            _fail(f"{said.rstrip('.')}{'' if said.endswith('?') else '.'} See {help_command} --help.")
        except (BadInput, EgoGone) as error:
            _fail(str(error))
        except ImportError:
            missing = ", ".join(find_missing_libraries())
            if not missing:
                raise
            _fail(f"{self._find_path(words)} needs {missing}, not installed: {advise_install('driving')}.")
        except BrokenPipeError:  # whoever read the answer has enough of it
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # nothing more to say when Python flushes
            sys.exit(128 + _SIGPIPE)
        except (KeyboardInterrupt, typer.Abort):
            pass
        if not ended:
            number = signal.Signals(received[0] if received else signal.SIGINT)
            print_stderr(f"rare-envs: stopped by {number.name}")
            code = 128 + number
        sys.exit(code if isinstance(code, int) else 0)

    def _find_path(self, words: list[str]) -> str:
        """Return the command that words begin with, for an error that does not know its command."""
        path: list[str] = ["rare-envs"]
        command: Any = self
        for word in words:
            command = getattr(command, "commands", {}).get(word)
            if command is None:
                break
            path.append(word)
        return " ".join(path)


ELSEWHERE = {
    "plan": "rare-envs estimate SCENARIO --plan",
    "bases": "rare-envs list SCENARIO, or rare-envs list bases",
    "export-ego": "rare-envs export EGO.zip EGO.onnx",
    "train-drivers": "python -m training.imitation",
    "serve-ego": "python -m agents.remote",
    "bench": "python -m benchmarks.samplers",
}
"""Words that are no command, and the command that does what they say."""


SYNONYMS = {
    **dict.fromkeys(("--cov", "--precision", "--target"), "--target-cov"),
    **dict.fromkeys(("--pilot", "--budget", "--samples", "--simulations", "--n-sim", "--n"), "--max-sim"),
    **dict.fromkeys(("--given-base", "--assume-base"), "--assume-traffic"),
    **dict.fromkeys(("--jobs", "--threads", "--processes", "--n-jobs"), "--workers"),
    **dict.fromkeys(("--policy", "--model"), "--ego"),
    **dict.fromkeys(("--traffic", "--bases", "--distribution"), "--base"),
    **dict.fromkeys(("--output", "--folder", "--dir"), "--out"),
    **dict.fromkeys(("--most", "--max"), "--limit"),
    **dict.fromkeys(("--scenarios", "--env"), "--scenario"),
}
"""Words for options that people may think of first, and the options."""


def advise_elsewhere(error: Exception, words: Sequence[str]) -> str:
    """Return where an option or a command is that a line of words has in vain; empty if there is no such place."""
    option, context = getattr(error, "option_name", None), getattr(error, "ctx", None)
    if option is None:
        typed = re.match("No such command '(.*?)'", getattr(error, "message", ""))
        better = ELSEWHERE.get(typed[1]) if typed else None
        return f"No such command {typed[1]!r}: it is {better}." if typed and better else ""
    parameters = getattr(getattr(context, "command", None), "params", ())
    if (better := SYNONYMS.get(option)) in [name for each in parameters for name in each.opts]:
        return f"No such option {option}: it is {better}."
    key, keys = (
        option.lstrip("-").replace("-", "_"),
        _file_keys(context),
    )
    is_off = key.startswith("no_") and key[3:] in keys
    key = key[3:] if is_off else key
    if key not in keys:
        return ""
    at = next((number for number, word in enumerate(words) if word.partition("=")[0] == option), 0)
    value = words[at].partition("=")[2] or next(iter(words[at + 1 : at + 2]), "VALUE")
    if key in KEYS and KEYS[key].type == "bool":
        value = "false" if is_off else "true"
    return f"No such option {option}: put {key}: {value} into a file for --config."


def _file_keys(context: Any) -> Sequence[str]:
    """Return the keys that the file of --config may have for the command of a context."""
    callback = getattr(getattr(context, "command", None), "callback", None)
    return tuple(getattr(callback, "file_keys", ()))


def name_options(message: str, command: Any) -> str:
    """Return a message with the options of a command, or of those in a group, in place of their names in Python."""
    if message.startswith("'"):
        return message
    options: dict[str, str] = {}
    for each in (command, *getattr(command, "commands", {}).values()):
        for parameter in getattr(each, "params", ()):
            for option in [word for word in getattr(parameter, "opts", ()) if word.startswith("--")][:1]:
                options[parameter.name] = options[option[2:].replace("-", "_")] = option
    for name, option in options.items():
        before = r"(?<![-\w'\"/.])" if "_" in name else "^Expected "
        after = r"(?![-\w'\"/(=]|\.\w)"
        message = re.sub(f"{before}{name}{after}", option if "_" in name else f"Expected {option}", message)
    return message


@contextlib.contextmanager
def signals_as_exceptions(received: list[int]) -> Iterator[None]:
    """Raise a KeyboardInterrupt on SIGTERM and SIGHUP, where they would end the process without a word."""

    def end(number: int, _: object) -> None:
        received.append(number)
        raise KeyboardInterrupt(f"ended by {signal.Signals(number).name}")

    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in _ENDING:
            if signal.getsignal(number) is signal.SIG_DFL:  # nohup has SIGHUP ignored, Python has SIGINT handled
                before[number] = signal.signal(number, end)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


LINGER = 10.0
"""Time that threads, processes and exit handlers of an ego have after the answer [s]."""


def end_soon(code: int) -> None:
    """Ignore signals to end, and end the process that has given its answer by itself, whatever an ego left running."""
    for number in _ENDING:
        signal.signal(number, signal.SIG_IGN)

    def end() -> None:
        if threading.main_thread().is_alive():  # somebody called the command in a process of their own
            return
        print_stderr(f"rare-envs: done; something that the ego started does not end, and was left after {LINGER:g} s")
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
        os._exit(code)

    timer = threading.Timer(LINGER, end)
    timer.daemon = True
    timer.start()


@contextlib.contextmanager
def one_line_warnings() -> Iterator[None]:
    """Print warnings in one line."""

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        print_stderr("rare-envs: " + " ".join(str(message).split()))

    before = warnings.showwarning
    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = before


def print_stderr(line: str) -> None:
    """Print a line on standard error, if there still is anybody to read it."""
    with contextlib.suppress(OSError, ValueError):
        print(clean_text(line[:LONGEST_LINE]), file=sys.stderr, flush=True)


def _fail(message: str) -> NoReturn:
    """Print an error in one line, and exit."""
    print_stderr("rare-envs: " + " ".join(message.split()))
    sys.exit(2)


class Answer(NamedTuple):
    """What a command says at its end."""

    data: Mapping[str, Any]
    """For --json."""
    text: str | Callable[[], None]
    """For people, or what prints it."""
    code: int = 0
    """Exit code."""

    def print(self, as_json: bool) -> None:
        """Print it to its end: the first signal meanwhile changes nothing, as the command is about to end."""
        from samplers.estimation import defer_signals  # slow to import, and known by now

        whole = False
        try:
            with defer_signals():
                if as_json or isinstance(self.text, str):
                    print(json.dumps(self.data, indent=2, allow_nan=False) if as_json else clean_text(str(self.text)))
                else:
                    self.text()
                whole = True
        except KeyboardInterrupt:
            if not whole:
                raise


def describe_report(report: Any, out: Path | None, details: bool) -> Answer:
    """Return the answer of a `Report`, of a run in a folder `out` or of none."""
    from rare_envs.study.text import print_report, report_as_json

    doubtful = DOUBTFUL if report.doubtful else 0
    show = functools.partial(print_report, report, out, details)
    code = doubtful if report.verdict is None else GATE_CODES[report.verdict.decision]
    return Answer(report_as_json(report), show, code)


def answering(work: Callable[[], Answer | None], as_json: bool, stopped: str, details: bool) -> None:
    """Do the work of a command, print its answer, if any, and exit."""
    try:
        with use_one_thread(), keep_stdout_for_the_answer():
            answer = work()
    except (KeyboardInterrupt, BadInput) as error:
        report = getattr(error, "report", None)  # of `RunInterrupted` and `UnwrittenResults`, slow to import
        # whoever ended the process may not wait for more than one line
        own = type(error) is not KeyboardInterrupt  # such as `RunInterrupted`, with words of its own
        if isinstance(error, KeyboardInterrupt) and (own or stopped):
            print_stderr(str(error) if own else stopped)
        if report is not None:
            (report if isinstance(report, Answer) else describe_report(report, None, details)).print(as_json)
        raise
    if answer is not None:
        answer.print(as_json)
        raise typer.Exit(answer.code)


@contextlib.contextmanager
def telling_unwritten(kind: type[Any], tell: Callable[[Any], Answer]) -> Iterator[None]:
    """Let the result, of a kind, of what cannot be written be told as an answer."""
    try:
        yield
    except UnwrittenResults as error:
        if isinstance(error.report, kind):
            error.report = tell(error.report)
        raise


@contextlib.contextmanager
def keep_stdout_for_the_answer() -> Iterator[None]:
    """Send what is printed to standard error, what libraries in C and child processes print included."""
    with contextlib.redirect_stdout(sys.stderr):
        try:
            answer = os.dup(1)
            os.dup2(2, 1)
        except OSError:  # one of both is closed
            yield
            return
        try:
            yield
        finally:
            with contextlib.suppress(OSError, AttributeError, TypeError):  # there is none by this name on Windows
                ctypes.CDLL(None).fflush(None)  # what C's standard library still has to write
            os.dup2(answer, 1)
            os.close(answer)


SCENARIO = ("base", "drivers", "observation", "action")
"""Fields of `Question` that are options of each command that drives an ego."""
WORLD_IN_FILES = ("horizon", "noise", "weather", "collisions", "algo", "stats")
RUN_IN_FILES = ("chunk", "core", "device", "ensemble_run", "executor", "address", "time_limit", "memory_limit")
"""Fields that files alone give to commands that estimate: of the scenario and the ego, and of the run."""
EGO_FILE = ("algo", "stats")
EXECUTOR = tuple(field.name for field in fields(ExecutorOptions))
NOISE = {"on": True, "fixed": "fixed", "off": False}
"""Words of --noise for the `noise` argument of `DrivingProblem`."""
KINDS: dict[str, Any] = {"noise": Literal["on", "fixed", "off"], "executor": Literal["local", "ray"] | None}
"""Types of options of which the fields have another."""
OWNERS = {field.name: owner for owner in (Question, ExecutorOptions) for field in fields(owner)}
"""The class that has a field."""


def read_count(text: str) -> int:
    """Return the whole number that a text stands for, such as "10000" or "1e4"."""
    try:
        return read_whole(text)
    except ValueError:
        raise typer.BadParameter(f"expected a whole number, such as 10000 or 1e4, got {text!r}.") from None


def split_words(*texts: str) -> list[str]:
    """Return the words of texts in which commas stand between words."""
    return [word.strip() for text in texts for word in text.split(",") if word.strip()]


def read_environment(text: str | None) -> str | None:
    """Return the id of an environment with its namespace, where it was typed without."""
    from rare_envs.scenarios.registry import complete_id

    return None if text is None else complete_id(text)


def option_of(name: str, **changes: Any) -> Any:
    """Return the option of a field, with changes to what `typer.Option` is told."""
    field = next(each for each in fields(OWNERS[name]) if each.name == name)
    about = {key: field.metadata[key] for key in ("help", "show_default") if key in field.metadata} | changes
    if field.metadata.get("count"):
        return Option(parser=read_count, metavar="INTEGER", **about)
    return Option(f"--{option_name(field).replace('_', '-')}", **about)


EnvArgument = Annotated[
    str,
    Argument(
        metavar="SCENARIO",
        help="Scenario: CutIn, cut-in and rare_envs/CutIn-v1 are the same.",
        callback=read_environment,
    ),
]
EgoArgument = Annotated[str, Argument(metavar="EGO", help="Policy under test, as for estimate --ego.")]
RunArgument = Annotated[Path, Argument(metavar="RUN", help="Folder that rare-envs estimate --out has written.")]
ForceOption = Annotated[bool, Option("--force", help="Replace what is there already.")]
DetailsOption = Annotated[bool, Option("--details", help="Print the method, all intervals, parameters and remarks.")]
JsonOption = Annotated[bool, Option("--json", help="Print one JSON object and nothing else.")]


def command(
    *names: str, more: Sequence[str] = (), texts: Sequence[str] = (), stopped: str = "", **about: Mapping[str, str]
) -> Callable[[Callable[..., Answer | None]], Callable[..., None]]:
    """Let a function be a command of Typer: the answer that it returns, if any, is printed, as JSON with --json.

    Its parameter `asked` becomes the options of these fields of `Question` and `ExecutorOptions`, and it gets a mapping
    of them and of `more`, which are in the file of --config alone. The file may give all of these, and parameters of
    the function that are `texts`. `typed` gets the names of what was typed or filed. `stopped` is said of an early
    interruption. `about` has the words of options that are others than those of the fields.
    """
    keys = [option_name(field) for owner in (Question, ExecutorOptions) for field in fields(owner)]
    keys = [key for key in keys if KEYS[key].name in (*names, *more)]

    def decorate(function: Callable[..., Answer | None]) -> Callable[..., None]:
        signature = inspect.signature(function, eval_str=True)
        taken = signature.parameters

        @functools.wraps(function)
        def run(context: typer.Context, as_json: bool = False, config: Path | None = None, **values: Any) -> None:
            sources = {name: context.get_parameter_source(name) for name in context.params}
            typed = {name for name, source in sources.items() if source and source.name == "COMMANDLINE"}
            filed = {} if config is None else read_question_file(config, keys, texts)
            known = {name: getattr(OWNERS[name], name, None) for name in more}
            for name in names:
                value = values.pop(name)
                known[name] = NOISE[value] if name == "noise" else value
            for name, value in filed.items():
                if name in known and name not in typed:
                    known[name] = value
                elif name in texts and name not in typed:
                    values[name] = [value] if "list" in str(taken[name].annotation) else value
            values |= {"asked": known} if "asked" in taken else {}
            values |= {"typed": typed | set(filed)} if "typed" in taken else {}
            answering(functools.partial(function, **values), as_json, stopped, values.get("details", False))

        keyword = functools.partial(inspect.Parameter, kind=inspect.Parameter.KEYWORD_ONLY)
        parameters = [keyword("context", annotation=typer.Context)]
        for name, parameter in taken.items():
            if name == "asked":
                kinds: Any = {**get_type_hints(Question), **get_type_hints(ExecutorOptions), **KINDS}
                for each in names:
                    default = "on" if each == "noise" else getattr(OWNERS[each], each)
                    parameters.append(
                        keyword(
                            each,
                            default=default,
                            annotation=Annotated[kinds[each], option_of(each, **about.get(each, {}))],
                        )
                    )
            elif name not in ("typed", *(text for text in texts if parameter.annotation in (str, str | None))):
                parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
        if more:
            only = ", ".join(key for key in keys if KEYS[key].name in more)
            help = (
                f"YAML file of options (key: value), which the command line overrides, and of further settings: {only}."
            )
            parameters.append(keyword("config", default=None, annotation=Annotated[Path | None, Option(help=help)]))
        if signature.return_annotation is not None:
            parameters.append(keyword("as_json", default=False, annotation=JsonOption))
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {each.name: each.annotation for each in parameters}
        run.file_keys = (*keys, *texts)  # type: ignore[attr-defined]
        del run.__wrapped__
        return run

    return decorate
