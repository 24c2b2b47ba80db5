"""Egos from a function of the user's own, `module:function`."""

from __future__ import annotations

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
    try:
        ego = wrap_callable(function())
    except (Exception, SystemExit) as error:  # the function is the user's: anything may happen in it
        raise ValueError(f"{spec!r} failed to make an ego: {one_line(error)}.") from error
    rule_based = isinstance(ego, str) and ego == RULE_BASED  # an array, say, compares element by element
    if not rule_based and not is_policy(ego):
        refuse_ego(ego, f"from {spec!r}")
    return ego
