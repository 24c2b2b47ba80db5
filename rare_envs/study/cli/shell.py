"""Behaviour that all commands share: errors in one line and answers as JSON."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import re
import shlex
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple, NoReturn

import typer
from typer.core import TyperGroup

from rare_envs.plugins import EgoGone
from rare_envs.startup import find_missing_libraries, restore_signals, use_one_thread
from rare_envs.study.arguments import BadInput

DOUBTFUL = 3
"""Exit code of a command that is done, with warnings that make its number doubtful."""

GATE_CODES = {"passes": 0, "fails": 4, "undecided": 5}
"""Exit codes of a comparison of p with a limit."""
WHOLE = 1_000
"""Characters of a summary in a list of commands: more than any has."""

_SIGPIPE = int(getattr(signal, "SIGPIPE", 13))
"""Signal of a reader that is gone; Windows has none of this number."""
_UsageError: type[Exception] = typer.BadParameter.__bases__[0]
"""Error that Typer raises for a wrong option or a missing word; older versions of Typer take it from click."""


class Terminated(KeyboardInterrupt):
    """The process was asked to end, by a signal other than that of Ctrl-C."""

    def __init__(self, number: int) -> None:
        super().__init__(f"ended by {signal.Signals(number).name}")
        self.number = number


class AnswerCut(KeyboardInterrupt):
    """The printing of an answer was interrupted."""

    report = None
    """As of `RunInterrupted`: what could be said has been said."""


class SummarisedCommands(TyperGroup):
    """Commands whose summaries are not cut in the list of them."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands, each with the whole first sentence of its help, in several lines where it is long."""
        commands = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        rows = [(name, found.get_short_help_str(limit=WHOLE)) for name, found in commands if found is not None]
        with formatter.section("Commands"):
            formatter.write_dl(rows)


class OneLineErrors(SummarisedCommands):
    """Commands whose errors are one line on standard error and exit code 2.

    SIGTERM and SIGHUP end a command as Ctrl-C does; the exit code is 128 and the number of the signal.
    """

    def invoke(self, ctx: Any) -> Any:
        """Run a command; where an error names an argument of Python, name the option that stands for it."""
        try:
            return super().invoke(ctx)
        except BadInput as error:
            error.args = (name_options(str(error), find_options(self.get_command(ctx, ctx.invoked_subcommand))),)
            raise

    def main(self, *args: Any, **extra: Any) -> NoReturn:
        """Run a command and exit."""
        words = list((args[0] if args else extra.get("args")) or sys.argv[1:])
        received: list[int] = []
        code: Any = None
        ended = False
        try:
            restore_signals()
            with signals_as_exceptions(received), one_line_warnings():
                code = super().main(*args, **{**extra, "standalone_mode": False})
                ended = code != 128 + signal.SIGINT
        except _UsageError as error:
            said = _in_plain_words(getattr(error, "format_message")())  # noqa: B009  (differs by version)
            path = getattr(getattr(error, "ctx", None), "command_path", "") or self._find_path(words)
            help_command = " ".join(["rare-envs", *path.split()[1:]])
            _fail(f"{said.rstrip('.')}{'' if said.endswith('?') else '.'} See {help_command} --help.")
        except (BadInput, EgoGone) as error:
            _fail(str(error))
        except ImportError:
            missing = ", ".join(find_missing_libraries())
            if not missing:
                raise
            _fail(f"{self._find_path(words)} needs {missing}, not installed: pip install 'rare-envs[driving]'.")
        except BrokenPipeError:  # whoever read the answer has enough of it
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # nothing more to say when Python flushes
            sys.exit(128 + _SIGPIPE)
        except (KeyboardInterrupt, typer.Abort):
            pass
        if not ended:
            number = signal.Signals(received[0] if received else signal.SIGINT)
            _print_stderr(f"rare-envs: stopped by {number.name}")
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


def _in_plain_words(message: str) -> str:
    """Return what Typer says of a wrong value without the words of the library that it checks values with."""
    message = message.replace("Value error, ", "")
    message = message.replace("Input should be a valid number, unable to parse string as a number", "expected a number")
    return re.sub(
        r"Input should be a valid integer, unable to parse string as an \w+", "expected a whole number", message
    )


def find_options(command: Any) -> dict[str, str]:
    """Return the options of a command, and of the commands below it, by the names that they have in Python."""
    found: dict[str, str] = {}
    for each in (command, *getattr(command, "commands", {}).values()):  # of a group
        for parameter in getattr(each, "params", ()):
            for option in [word for word in getattr(parameter, "opts", ()) if word.startswith("--")][:1]:
                found[parameter.name] = found[option[2:].replace("-", "_")] = option
    return found


def name_options(message: str, options: Mapping[str, str]) -> str:
    """Return a message with options in place of the names that they have in Python.

    A name of one word is an ordinary word too: it is replaced behind "Expected" at the beginning alone. What is said
    of a file of --config stays as it is: its keys are these names.
    """
    if message.startswith("'"):
        return message
    for name, option in options.items():
        before = r"(?<![-\w'\"/.])" if "_" in name else "^Expected "
        after = r"(?![-\w'\"/(=]|\.\w)"
        message = re.sub(f"{before}{name}{after}", option if "_" in name else f"Expected {option}", message)
    return message


@contextlib.contextmanager
def signals_as_exceptions(received: list[int]) -> Iterator[None]:
    """Raise `Terminated` on SIGTERM and SIGHUP, where they would end the process without a word."""

    def end(number: int, frame: FrameType | None) -> None:
        received.append(number)
        raise Terminated(number)

    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)):
            if signal.getsignal(number) is signal.SIG_DFL:  # nohup has SIGHUP ignored
                before[number] = signal.signal(number, end)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def ignore_signals() -> None:
    """Ignore signals to end, for a process that has given its answer and is about to end by itself."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)


@contextlib.contextmanager
def one_line_warnings() -> Iterator[None]:
    """Print warnings in one line."""

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        _print_stderr("rare-envs: " + " ".join(str(message).split()))

    before = warnings.showwarning
    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = before


def _print_stderr(line: str) -> None:
    """Print a line on standard error, if there still is anybody to read it."""
    with contextlib.suppress(OSError, ValueError):
        print(line, file=sys.stderr, flush=True)


def _fail(message: str) -> NoReturn:
    """Print an error in one line, and exit."""
    _print_stderr("rare-envs: " + " ".join(message.split()))
    sys.exit(2)


class Answer(NamedTuple):
    """What a command says at its end."""

    data: Mapping[str, Any]
    """For --json."""
    text: str | Callable[[], None]
    """For people, or what prints it."""
    code: int = 0
    """Exit code."""


def describe_report(report: Any, out: Path | None, details: bool) -> Answer:
    """Return the answer of a `Report`, of a run in a folder `out` or of none."""
    from rare_envs.study.text import print_report

    def show() -> None:
        print_report(report, out, details)
        if not details:
            where = "--details" if out is None else f"rare-envs report {shlex.quote(str(out))}"
            print(f"all intervals and parameters: {where}")

    doubtful = DOUBTFUL if report.doubtful else 0
    return Answer(report.to_dict(), show, doubtful if report.verdict is None else GATE_CODES[report.verdict.decision])


def answering(work: Callable[[], Answer | None], as_json: bool, stopped: str, details: bool) -> None:
    """Do the work of a command, print its answer, if any, and exit.

    If it is interrupted, or its results cannot be written, what is known is printed: the message of the interruption,
    one line, comes first, because whoever ended the process may not wait for the rest. `stopped` is what is known of a
    run that has not begun.
    """
    try:
        with use_one_thread(), keep_stdout_for_the_answer():
            answer = work()
    except (KeyboardInterrupt, BadInput) as error:
        report = getattr(error, "report", None)  # of `RunInterrupted` and `UnwrittenResults`, slow to import
        if isinstance(error, KeyboardInterrupt) and (hasattr(error, "report") or stopped):
            _print_stderr(str(error) if hasattr(error, "report") else stopped)
        if report is not None:
            known = report if isinstance(report, Answer) else describe_report(report, None, details)
            print_whole(lambda: _print_answer(known, as_json))
        raise
    if answer is not None:
        print_whole(lambda: _print_answer(answer, as_json))
        raise typer.Exit(answer.code)


def _print_answer(answer: Answer, as_json: bool) -> None:
    if as_json:
        print(json.dumps(answer.data, indent=2, allow_nan=False))
    elif isinstance(answer.text, str):
        print(answer.text)
    else:
        answer.text()


def print_whole(show: Callable[[], None]) -> None:
    """Print an answer to its end: the first signal meanwhile changes nothing, as the command is about to end."""
    from samplers.estimation import defer_signals  # slow to import, and known by now

    whole = False
    try:
        with defer_signals():
            show()
            whole = True
    except KeyboardInterrupt:
        if not whole:
            raise AnswerCut from None


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
