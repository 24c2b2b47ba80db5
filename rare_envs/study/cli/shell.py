"""What all commands share: answers as text or JSON, errors in one line, and signals."""

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
from typing import Any, NamedTuple, NoReturn

import typer
from typer.core import TyperGroup

from rare_envs.plugins import EgoGone, clean_text
from rare_envs.startup import advise_install, find_missing_libraries, restore_signals, use_one_thread
from rare_envs.study.arguments import (
    GATE_CODES,
    KEYS,
    BadInput,
    ExecutorOptions,
    as_bad_input,
    read_question_file,
    read_whole,
)

DOUBTFUL = 3
"""Exit code of a command that is done, with warnings that make its number doubtful."""
LONGEST_LINE = 4_000
"""Characters of an error or a warning: files and names may bring along any number."""
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


class OneLineErrors(TyperGroup):
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
    keys = getattr(getattr(getattr(context, "command", None), "callback", None), "file_keys", ())
    key = option.lstrip("-").replace("-", "_")
    is_off = key.startswith("no_") and key[3:] in keys
    key = key[3:] if is_off else key
    if key not in keys:
        return ""
    at = next((number for number, word in enumerate(words) if word.partition("=")[0] == option), 0)
    value = words[at].partition("=")[2] or next(iter(words[at + 1 : at + 2]), "VALUE")
    if key in KEYS and KEYS[key].type == "bool":
        value = "false" if is_off else "true"
    return f"No such option {option}: put {key}: {value} into a file for --config."


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


def tell(found: Any, out: Path | None = None, details: bool = False) -> Answer:
    """Return the answer of a report, a risk, two compared risks, or a comparison and its values for JSON.

    `out` is the folder that was written, if any. An answer stays what it is.
    """
    if isinstance(found, Answer):
        return found
    from rare_envs.study.report import Report
    from rare_envs.study.text import list_gate, print_report, report_as_json

    if isinstance(found, Report):
        show, verdict = functools.partial(print_report, found, out, details), found.verdict
        return Answer(report_as_json(found), show, _find_code(verdict, found.doubtful))
    if isinstance(found, tuple):
        compared, _, data = found
        limit, exact = (data["question"][name] for name in ("max_ratio", "assume_traffic"))
        verdict = None if limit is None else compared.meets(limit, exact)
        more = ["", compared.details(), "", compared.either.details()] if details else []
        lines = [*data["text"], *more, *([] if out is None else [f"Wrote {out}."]), *list_gate(verdict)]
        return Answer(data, "\n".join(lines), _find_code(verdict, compared.warnings))
    lines, gate = found.describe([] if out is None else [("Wrote", str(out))]), list_gate(found.verdict)
    lines[len(lines) - len(gate) :] = [*([found.details()] if details else []), *gate]
    return Answer(found.to_dict(), "\n".join(lines), _find_code(found.verdict, found.warnings))


def _find_code(verdict: Any, doubtful: Any) -> int:
    """Return the exit code of an answer with a verdict, or with none."""
    return GATE_CODES[verdict.decision] if verdict is not None else DOUBTFUL if doubtful else 0


def read_count(text: str) -> int:
    """Return the whole number that a text stands for, such as "10000" or "1e4"."""
    try:
        return read_whole(text)
    except ValueError:
        raise typer.BadParameter(f"expected a whole number, such as 10000 or 1e4, got {text!r}.") from None


class Command(NamedTuple):
    """A function that is a command, and what is known of its options, see `options.command`."""

    function: Callable[..., Any]
    names: Sequence[str]
    more: Sequence[str]
    texts: Sequence[str]
    keys: Sequence[str]
    """What the file of --config may have beside `texts`."""
    stopped: str


FIELDS = {field.name: field for field in KEYS.values()}
"""Fields of `Question` and `ExecutorOptions` by name."""
EXECUTOR = tuple(field.name for field in fields(ExecutorOptions))
NOISE = {"on": True, "fixed": "fixed", "off": False}
"""Words of --noise for the `noise` argument of `DrivingProblem`."""


def run_command(
    asked: Command, *, context: typer.Context, as_json: bool = False, config: Path | None = None, **values: Any
) -> None:
    """Do the work of a command with what was typed and what its file says, print its answer, if any, and exit."""
    sources = {name: context.get_parameter_source(name) for name in context.params}
    typed = {name for name, source in sources.items() if source and source.name == "COMMANDLINE"}
    filed = {} if config is None else read_question_file(config, asked.keys, asked.texts)
    known: dict[str, Any] = {name: FIELDS[name].default for name in asked.more if name != "env_id"}
    known |= {name: values.pop(name) for name in asked.names}
    known |= {"noise": NOISE[known["noise"]]} if "noise" in asked.names else {}
    taken = inspect.signature(asked.function).parameters
    for name in filed.keys() - typed:
        if name in asked.texts:
            values[name] = [filed[name]] if "list" in str(taken[name].annotation) else filed[name]
        elif name != "env_id":
            known[name] = filed[name]
        elif values["env"] is None:
            values["env"] = filed[name]
    where = {name: known.pop(name) for name in EXECUTOR if name in known}
    values |= {name: value for name, value in (("asked", known), ("typed", typed | set(filed))) if name in taken}
    try:
        with use_one_thread(), keep_stdout_for_the_answer():
            if "executor" in taken:
                with as_bad_input(ValueError):
                    values["executor"] = ExecutorOptions(**where).make()
            answer = asked.function(**values)
    except (KeyboardInterrupt, BadInput) as error:
        report = getattr(error, "report", None)  # of `RunInterrupted` and `UnwrittenResults`
        # whoever ended the process may not wait for more than one line
        own = type(error) is not KeyboardInterrupt  # such as `RunInterrupted`, with words of its own
        if isinstance(error, KeyboardInterrupt) and (own or asked.stopped):
            print_stderr(str(error) if own else asked.stopped)
        if report is not None:
            tell(report, None, values.get("details", False)).print(as_json)
        raise
    if answer is not None:
        answer.print(as_json)
        raise typer.Exit(answer.code)


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
