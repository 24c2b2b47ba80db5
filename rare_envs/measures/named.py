"""Measures by what a user would type: a name, `module:measure`, or `stl:FORMULA`."""

from __future__ import annotations

import importlib
from typing import Any

from rare_envs.measures.temporal import stl
from rare_envs.modules import working_directory_first
from rare_envs.space import did_you_mean

FORMULA = "stl:"


def named_measure(measure: Any) -> Any:
    """What a keyword argument `measure` means, for `rare_envs.measures.find_measure`.

    Args:
        measure: "stl:always (gap > 2)", a formula of signal temporal logic; "module:name", a function of a `Moment` or
            a measure in a module of the user's (those in the working directory are found); all else stays as it is.

    Raises:
        ValueError: The formula cannot be used, or the module has nothing of that name.
    """
    if not isinstance(measure, str) or ":" not in measure:
        return measure
    if measure.startswith(FORMULA):
        try:
            return stl(measure.removeprefix(FORMULA).strip())
        except ImportError as error:
            raise ValueError(str(error)) from error
    module_name, _, name = measure.partition(":")
    try:
        with working_directory_first():
            module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # the module is the user's: anything may happen in it
        words = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(f"Cannot import {module_name!r} for the measure {measure!r}: {words}") from error
    found = getattr(module, name, None)
    if found is None:
        raise ValueError(f"{module_name!r} has nothing called {name!r}{did_you_mean(name, list(vars(module)))}.")
    return found
