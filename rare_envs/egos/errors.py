"""Errors of egos; policies are known by their `predict`, and what is no ego is refused in the same words."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any, ClassVar, NoReturn


class EgoGone(BaseException):
    """The ego cannot be queried any more, whatever the scenario.

    Like KeyboardInterrupt it is no `Exception`: code that survives failing scenarios must not take it for one.
    """


class NoAnswer(RuntimeError):
    """The ego has not answered in time, or has died: perhaps because of one of the rows of the query."""

    waits: ClassVar[bool] = True
    """Each costs its time, or a process that starts again; `samplers` reads this attribute."""


def reason_of(error: BaseException) -> str:
    """Return what went wrong, in one line."""
    words = " ".join(str(error).split())
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
