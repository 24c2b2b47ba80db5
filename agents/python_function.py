"""Egos from a function of the user's own, `module:function`."""

from __future__ import annotations

import inspect
from typing import Any

from agents.names import RULE_BASED
from rare_envs.egos.plain_callables import wrap_callable
from rare_envs.egos.validation import is_policy, refuse_ego
from rare_envs.plugins import import_object, one_line


def call_factory(spec: str) -> Any:
    """Import `module:function` and call it.

    Returns:
        "idm" or an object with `predict`; for a plain function or a torch module one that calls it.

    Raises:
        ValueError: The function is missing, fails, or returns something else.
    """
    function = import_object(spec, f"the ego {spec!r}")
    if not callable(function):
        raise ValueError(f"Expected {spec!r} to be a function that returns an ego, got {type(function).__name__}.")
    needed = _list_needed_arguments(function)
    if needed:
        raise ValueError(
            f"Expected {spec!r} to be a function without arguments that returns the ego, got one that needs "
            f"{', '.join(needed)}; for an ego that is a function, name another one that returns it."
        )
    try:
        ego = wrap_callable(function())
    except (Exception, SystemExit) as error:  # the function is the user's: anything may happen in it
        raise ValueError(f"{spec!r} failed to make an ego: {one_line(error)}.") from error
    rule_based = isinstance(ego, str) and ego == RULE_BASED  # an array, say, compares element by element
    if not rule_based and not is_policy(ego):
        refuse_ego(ego, f"from {spec!r}")
    return ego


def _list_needed_arguments(function: Any) -> list[str]:
    """Return the arguments without which a function cannot be called; empty where that cannot be told."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # of a function in C
        return []
    open_ended = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return [p.name for p in parameters if p.default is p.empty and p.kind not in open_ended]
