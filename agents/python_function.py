"""Egos made by a function of the user's own: `module:function`."""

from __future__ import annotations

import importlib
from typing import Any

from agents.names import RULE_BASED
from rare_envs.plugins import did_you_mean, working_directory_first


def call_factory(spec: str) -> Any:
    """Import `module:function` and call it.

    Returns:
        "idm" or an object with `predict`.

    Raises:
        ValueError: The function is missing, fails, or returns something else.
    """
    module_name, _, function_name = spec.partition(":")
    if not module_name or not function_name:
        raise ValueError(f"Expected module:function, got {spec!r}.")
    try:
        with working_directory_first():
            module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # the module is the user's: anything may happen in it
        raise ValueError(f"Cannot import {module_name!r} for the ego {spec!r}: {one_line(error)}.") from error
    function = getattr(module, function_name, None)
    if not callable(function):
        names = [name for name in vars(module) if callable(getattr(module, name))]
        raise ValueError(f"{module_name!r} has no function {function_name!r}{did_you_mean(function_name, names)}.")
    try:
        ego = function()
    except (Exception, SystemExit) as error:  # likewise
        raise ValueError(f"{spec!r} failed to make an ego: {one_line(error)}.") from error
    rule_based = isinstance(ego, str) and ego == RULE_BASED  # an array, say, compares element by element
    if not rule_based and not callable(getattr(ego, "predict", None)):
        raise ValueError(f"Expected {spec!r} to return 'idm' or an object with predict, got {type(ego).__name__}.")
    return ego


def one_line(error: BaseException) -> str:
    """An exception as one line without a full stop."""
    words = " ".join(str(error).split()).rstrip(".")
    kind = type(error).__name__
    return f"{kind}: {words[:200]}" if words else kind
