"""Imports by name: modules and objects of a user, names imported on first use, and the nearest valid name."""

from __future__ import annotations

import contextlib
import difflib
import importlib
import importlib.util
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_MAX_WORDS = 200
"""Characters of an exception's message that `one_line` keeps: a line of a terminal or two."""
SIBLINGS = {"agents": "agents.loading", "samplers": "samplers.estimation", "training": "training.ego_training"}
"""Packages that are installed with this one, and a module that the `__init__` of each imports."""


def warn_of_namesakes() -> None:
    """Warn, in one line each, of packages named as one of SIBLINGS that Python finds in place of ours.

    Nothing is imported: the file that Python would import is read.
    """
    for name, part in SIBLINGS.items():
        with contextlib.suppress(ImportError, ValueError, OSError):  # not there, or made by hand
            found = importlib.util.find_spec(name)
            origin = found.origin if found else None
            if origin and part not in Path(origin).read_text(encoding="utf-8", errors="replace"):
                warnings.warn(
                    f"Expected {name!r} of Rare Envs, found another package of that name, {origin}; rename or "
                    "uninstall it, or use an environment of its own (docs/index.md).",
                    RuntimeWarning,
                    stacklevel=3,
                )


def import_module(name: str, purpose: str) -> ModuleType:
    """Return a module that a user names, for a purpose that errors name; the working directory is searched first."""
    try:
        with working_directory_first():
            return importlib.import_module(name)
    except (Exception, SystemExit) as error:  # the module is the user's: anything may happen in it
        raise ValueError(f"Cannot import {name!r} for {purpose}: {one_line(error)}.") from error


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


def make_lazy_getattr(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package that imports its names on first use, each from the module that has it."""

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(modules[name]), name)  # of a module of ours

    return get


def did_you_mean(name: str, valid: Iterable[str]) -> str:
    """Return `" (did you mean 'x'?)"` for the nearest valid name, or "" if none is near; whatever the capitals."""
    names = {v.lower(): v for v in valid}
    names |= {short.split("/")[-1]: v for short, v in names.items()}  # an id without its namespace
    near = difflib.get_close_matches(name.lower(), list(names), n=1)
    return f" (did you mean {names[near[0]]!r}?)" if near else ""


def one_line(error: BaseException) -> str:
    """Return an exception as one line without a full stop: its class, and up to 200 characters of its message.

    Colours of a terminal, which numba's messages have where colorama is installed, are left out.
    """
    words = " ".join(_COLOUR.sub("", str(error)).split()).rstrip(".")
    kind = type(error).__name__
    return f"{kind}: {words[:_MAX_WORDS]}" if words else kind


@contextlib.contextmanager
def working_directory_first() -> Iterator[None]:
    """Search modules in the working directory first, as `python -m` does and console scripts do not."""
    here = os.getcwd()
    sys.path.insert(0, here)
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):
            sys.path.remove(here)
