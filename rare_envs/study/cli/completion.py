"""Completion in a shell: the words that arguments and options take.

Names whose modules need seconds to import are written out here, and compared with the catalogue by a test.
"""

from __future__ import annotations

from collections.abc import Callable

import typer

from rare_envs.startup import find_missing_libraries

EGO_WORDS = ("idm", "human", "imitation", "mgail", "mgail2", "mgail3", "mgail4", "mgail5", "gail", "bc", "vision")
DRIVER_WORDS = ("mgail", "mgail2", "mgail3", "mgail4", "mgail5", "gail", "bc", "idm", "idm+mobil")
MEASURE_WORDS = (
    *("ttc", "lidar_ttc", "ttc_2d", "mttc", "thw", "drac", "required_deceleration", "btn", "near_crash", "ttb", "pet"),
    *("rss_longitudinal", "rss_lateral", "rss_margin", "clearance", "tet", "tit", "margin"),
)
OBSERVATION_WORDS = ("features", "lidar", "kinematics", "camera", "speed", "camera+lidar")
ACTION_WORDS = ("continuous", "discrete", "meta")
LIST_WORDS = ("environments", "methods", "egos", "drivers", "measures", "weather", "all")
"""What `list` shows in detail, beside environments."""


def complete_words(*words: str) -> Callable[[str], list[str]]:
    """Return the completion of an argument that takes one of some words.

    Example:
        >>> complete_words("torch", "numba")("t")
        ['torch']
    """

    def complete(incomplete: str) -> list[str]:
        return [word for word in words if word.startswith(incomplete)]

    return complete


def complete_environment(incomplete: str) -> list[str]:
    """Return the ids, with and without their namespace, that begin so.

    Example:
        >>> complete_environment("rare_envs/Car"), complete_environment("Car")
        (['rare_envs/CarFollowing-v0'], ['CarFollowing-v0'])
    """
    from rare_envs.scenarios.registry import SCENARIOS

    short = [env_id.rpartition("/")[2] for env_id in SCENARIOS]
    return [each for names in (SCENARIOS, short) for each in names if each.startswith(incomplete)]


def complete_kind(incomplete: str) -> list[str]:
    """Return the kinds and the environments that `list` takes.

    Example:
        >>> complete_kind("me"), complete_kind("Car")
        (['methods', 'measures'], ['CarFollowing-v0'])
    """
    return [*complete_words(*LIST_WORDS)(incomplete), *complete_environment(incomplete)]


def complete_method(incomplete: str) -> list[str]:
    """Return the estimation methods whose names begin so.

    Example:
        >>> complete_method("a")
        ['adss', 'auto']
    """
    import samplers

    return sorted(name for name in samplers.METHODS if name.startswith(incomplete))


def complete_methods(incomplete: str) -> list[str]:
    """Return lists of methods, joined by commas, whose last name is completed.

    Example:
        >>> complete_methods("mc,a")
        ['mc,adss', 'mc,auto']
    """
    before, comma, last = incomplete.rpartition(",")
    return [f"{before}{comma}{name}" for name in complete_method(last)]


def complete_scenario(incomplete: str) -> list[str]:
    """Return the environments and the short names of their scenarios, such as cut_in.

    Example:
        >>> complete_scenario("cut")
        ['cut_in']
    """
    return [
        *complete_words("car_following", "cut_in", "hard_brake", "highway")(incomplete),
        *complete_environment(incomplete),
    ]


def complete_base(context: typer.Context, incomplete: str) -> list[str]:
    """Return the base distributions, that begin so, of the environment which stands in the line already."""
    if find_missing_libraries():  # bases need torch
        return []
    from rare_envs.scenarios.registry import SCENARIOS, complete_id

    words = [context.params.get("env"), *context.args]  # among the latter while the line does not parse yet
    named = (complete_id(str(word)) for word in words if word)
    scenario = next((SCENARIOS[env_id] for env_id in named if env_id in SCENARIOS), None)
    return [] if scenario is None else [name for name in scenario.bases if name.startswith(incomplete)]
