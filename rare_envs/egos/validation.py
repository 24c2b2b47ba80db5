"""Validation of egos: policies are known by their `predict`, and what is no ego is refused in the same words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NoReturn


def is_policy(ego: object) -> bool:
    """Return whether an object, and not a class, has Stable-Baselines3's `predict`.

    Example:
        >>> class Coasting:
        ...     def predict(self, observation, state=None, episode_start=None, deterministic=True): ...
        >>> is_policy(Coasting()), is_policy(Coasting), is_policy("idm")
        (True, False, False)
    """
    # not isinstance of a Protocol, which takes a predict that is no function, and misses one that is passed on
    return not isinstance(ego, type) and callable(getattr(ego, "predict", None))


def refuse_ego(ego: object, origin: str = "", known: Sequence[str] = ("idm",)) -> NoReturn:
    """Refuse what is no ego.

    Args:
        ego: A name, a class, or an object that is no ego.
        origin: Where it came from, if not from the caller, such as "from make_ego()".
        known: Names of egos that would have been taken.

    Raises:
        ValueError: Always; it says what was expected.

    Example:
        >>> refuse_ego(3, "from make_ego()")
        Traceback (most recent call last):
        ValueError: Expected 'idm' or an object with a method predict(observation, ...), got int from make_ego().
    """
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
