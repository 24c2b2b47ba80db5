"""Imports by name: objects of a user, names imported on first use, the nearest valid name; and errors of egos."""

from __future__ import annotations

import difflib
import dis
import importlib
import inspect
import os
import re
import signal
import sys
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.machinery import PathFinder
from types import ModuleType, TracebackType
from typing import Any, ClassVar, NoReturn

_ODD, _JOINERS = re.compile(r"[^\n -~]"), "\u200c\u200d"
"""Letters to look at, and those without a width that words of some languages need."""
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_MAX_WORDS = 200
"""Characters of an exception's message that `one_line` keeps: a line of a terminal or two."""


def import_module(name: str, purpose: str) -> ModuleType:
    """Return a module that a user names, for a purpose that errors name; the working directory is searched first.

    Its own imports are found there too where it lies there itself; a module from elsewhere gets nothing from there.
    """
    here, top = os.getcwd(), name.partition(".")[0]
    importlib.invalidate_caches()
    own, found = (PathFinder.find_spec(top, places) for places in ([here], [here, *sys.path]))
    lies_here = own is not None and found is not None and own.origin == found.origin
    sys.path[:0] = [here] * lies_here  # as `python -m` does, and console scripts do not
    try:
        with as_errors():
            return importlib.import_module(name)
    except Exception as error:  # the module is the user's: anything may happen in it
        raise ValueError(f"Cannot import {name!r} for {purpose}: {one_line(error)}.") from error
    finally:
        if lies_here and here in sys.path:
            sys.path.remove(here)


def import_object(spec: str, purpose: str) -> Any:
    """Return what "module:name" stands for: a function, class or other object of a user's module."""
    module_name, _, name = spec.partition(":")
    if not module_name or not name:
        raise ValueError(f"Expected module:name for {purpose}, got {spec!r}.")
    module = import_module(module_name, purpose)
    try:
        return getattr(module, name)  # of a module of the user's
    except AttributeError:
        hint = did_you_mean(name, [word for word in vars(module) if not word.startswith("__")])
        raise ValueError(f"{module_name!r} has nothing called {name!r}{hint}.") from None


def names_object(spec: str) -> bool:
    """Return whether a name has the form of "module:name", with settings behind it or not; a file may have it too."""
    name = spec.partition("?")[0]
    return ":" in name and not {"/", "\\"} & {*name}


def split_settings(spec: str) -> tuple[str, dict[str, str]]:
    """Return the name and the settings in "module:name?file=policy.pt&layers=2", texts as they stand."""
    (name, _, query), settings = spec.partition("?"), dict[str, str]()
    for key, _, value in (each.partition("=") for each in query.split("&") if each):
        if not key or not value or key in settings:
            raise ValueError(f"Expected settings as name=value, each name once, got {key!r} {value!r} in {spec!r}.")
        settings[key] = value
    return name, settings


def make_object(spec: str, kind: str, call: bool = True) -> Any:
    """Return the object of a kind, for messages, that "module:name" stands for.

    A class is called, and so is a function if it makes the object (`call`) and is not itself it: with the settings
    behind its name as keyword arguments, see `split_settings`.
    """
    name, settings = split_settings(spec) if call else (spec, {})
    found = import_object(name, f"the {kind} {name!r}")
    if not settings and not isinstance(found, type) and not (call and inspect.isroutine(found)):
        return found
    given = ", ".join(f"{key}={value!r}" for key, value in settings.items())
    try:
        with as_errors():
            return found(**settings)
    except Exception as error:  # it is the user's: anything may happen in it
        raise ValueError(
            f"{name!r}, called with{f' {given}' if given else 'out arguments'}, failed to make the {kind}: "
            f"{one_line(error)}."
        ) from error


def make_lazy_getattr(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package that imports its names, from the module that has each, and its modules."""

    def get(name: str) -> Any:
        if name in modules:
            return getattr(importlib.import_module(modules[name]), name)  # of a module of ours
        if name.startswith("_") or PathFinder.find_spec(f"{package}.{name}", sys.modules[package].__path__) is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return importlib.import_module(f"{package}.{name}")

    return get


def did_you_mean(name: str, valid: Iterable[str]) -> str:
    """Return `" (did you mean 'x'?)"` for the nearest valid name, or "" if none is near; whatever the capitals."""
    names = {v.lower(): v for v in valid}
    names |= {short.split("/")[-1]: v for short, v in names.items()}  # an id without its namespace
    near = difflib.get_close_matches(name.lower(), list(names), n=1)
    return f" (did you mean {names[near[0]]!r}?)" if near else ""


def check_name(kind: str, name: object, valid: Iterable[str]) -> None:
    """Raise a ValueError that lists the valid names of a kind, with the nearest, unless a name is one of them."""
    names = list(valid)
    if not isinstance(name, str) or name not in names:
        hint = did_you_mean(str(name), names)
        raise ValueError(f"Unknown {kind} {name!r}{hint}; expected one of {', '.join(map(repr, names))}.")


def clean_text(text: str) -> str:
    r"""Return a text of somebody else's with the letters that steer a terminal, hide others or are no XML as escapes.

    Example:
        >>> print(clean_text("\x1b[2Jgap\u202e"))
        \x1b[2Jgap\u202e
    """

    def show(found: re.Match[str]) -> str:
        harmless = found[0].isprintable() or found[0] in _JOINERS or unicodedata.category(found[0]) == "Zs"
        return found[0] if harmless else found[0].encode("unicode_escape").decode()

    return _ODD.sub(show, text)


def one_line(error: BaseException) -> str:
    """Return an exception as a line without colours and full stop: class, up to 200 characters of its message."""
    error = error.__cause__ if isinstance(error, CodeEnded) and error.__cause__ else error
    words = clean_text(" ".join(_COLOUR.sub("", str(error)).split())).rstrip(".")
    kind = type(error).__name__
    return f"{kind}: {words[:_MAX_WORDS]}" if words else kind


class CodeEnded(ValueError):
    """Somebody's code raised what is meant to end the program; it is the cause."""


@contextmanager
def as_errors() -> Iterator[None]:
    """Let whatever somebody's code raises in a block be an `Exception`, SystemExit and KeyboardInterrupt included.

    Not `EgoGone`, and not the KeyboardInterrupt of a signal, by which the user ends the run.
    """
    try:
        yield
    except (Exception, EgoGone):
        raise
    except BaseException as error:
        if not any(map(_is_of_signal, _list_causes(error))):
            raise CodeEnded(repr(error)) from error
        if isinstance(error, KeyboardInterrupt):
            raise
        raise KeyboardInterrupt from error


def _list_causes(error: BaseException) -> list[BaseException]:
    """Return an exception and those in whose handling it was raised."""
    found = [error]
    for each in found:  # which grows
        found += [one for one in (each.__cause__, each.__context__) if one is not None and one not in found]
    return found


def _is_of_signal(error: BaseException) -> bool:
    """Return whether it is a KeyboardInterrupt that no statement raised, but for one in a signal's handler."""
    if not isinstance(error, KeyboardInterrupt) or error.__traceback__ is None:
        return False
    handlers = [getattr(signal.getsignal(number), "__code__", None) for number in signal.valid_signals()]
    last, *others = [(trace.tb_frame.f_code, trace.tb_lasti) for trace in _walk(error.__traceback__)][::-1]
    in_handler = any(code in handlers for code, _ in (last, *others))
    return in_handler or last[0].co_code[last[1]] != dis.opmap["RAISE_VARARGS"]


def _walk(trace: TracebackType | None) -> Iterator[TracebackType]:
    """Yield the parts of a traceback, the innermost last."""
    while trace is not None:
        yield trace
        trace = trace.tb_next


class EgoGone(BaseException):
    """The ego cannot be queried any more; no `Exception`, which code that survives failing scenarios catches."""


class NoAnswer(RuntimeError):
    """The ego has not answered in time, or has died: perhaps because of one of the rows of the query."""

    waits: ClassVar[bool] = True
    """Each costs its time, or a process that starts again; `samplers` reads this attribute."""


def reason_of(error: BaseException) -> str:
    """Return what went wrong, in one line."""
    words = clean_text(" ".join(str(error).split()))
    if isinstance(error, ValueError) and words:  # ours say what is wrong by themselves
        return words
    return f"{type(error).__name__}: {words}" if words and not isinstance(error, SystemExit) else repr(error)


def is_policy(ego: object) -> bool:
    """Return whether an object, and not a class, has Stable-Baselines3's `predict`."""
    # not isinstance of a Protocol, which takes a predict that is no function, and misses one that is passed on
    return not isinstance(ego, type) and callable(getattr(ego, "predict", None))


def check_predict(ego: Any) -> None:
    """Refuse a policy whose `predict` does not take the arguments that Stable-Baselines3's takes."""
    try:
        signature = inspect.signature(ego.predict)
    except (TypeError, ValueError):  # of a built-in function it is not known
        return
    try:
        signature.bind(None, state=None, episode_start=None, deterministic=True)
    except TypeError as error:
        raise ValueError(
            "Expected predict(observation, state, episode_start, deterministic), as Stable-Baselines3 has it, got "
            f"predict{signature} of {type(ego).__name__}."
        ) from error


def refuse_ego(ego: object, origin: str = "", known: Sequence[str] = ("idm",)) -> NoReturn:
    """Refuse what is no ego, from somewhere such as "from make_ego()", where these names would have been taken."""
    origin, names = f" {origin}" if origin else "", ", ".join(map(repr, known))
    if isinstance(ego, str):
        raise ValueError(
            f"Unknown ego {ego!r}{origin}; expected {names} or an object. Names and files become objects by "
            f"agents.load_ego({ego!r})."
        )
    if isinstance(ego, type):
        raise ValueError(f"Expected an ego, got the class {ego.__name__}{origin}; make or train one of it first.")
    raise ValueError(
        f"Expected {names} or an object with a method predict(observation, ...), got {type(ego).__name__}{origin}."
    )
