"""The registry of scenarios: by environment id or short name, and an id of your own by the module that registers it."""

from __future__ import annotations

import re
from collections import UserDict
from typing import TYPE_CHECKING, Any, cast

from rare_envs.plugins import did_you_mean, import_module, import_object

if TYPE_CHECKING:
    from rare_envs.scenarios.base import Scenario


class Registry(UserDict[str, Any]):
    """Environment ids to scenarios, or to their places, "module:name", which are imported when first asked for."""

    def __getitem__(self, env_id: str) -> Scenario:
        """Return the scenario of an id."""
        entry = self.data[env_id]
        if isinstance(entry, str):
            entry = self.data[env_id] = import_object(entry, f"the environment {env_id!r}")
        return cast("Scenario", entry)


SCENARIOS = Registry(
    {
        "rare_envs/CarFollowing-v0": "rare_envs.scenarios.car_following:CAR_FOLLOWING",
        "rare_envs/CutIn-v0": "rare_envs.scenarios.cut_in:CUT_IN",
        "rare_envs/CutIn-v1": "rare_envs.scenarios.cut_in:CUT_IN_V1",
        "rare_envs/Highway-v0": "rare_envs.scenarios.highway:HIGHWAY",
        "rare_envs/HardBrake-v0": "rare_envs.scenarios.hard_brake:HARD_BRAKE",
    }
)


def find_scenario(name: str) -> Scenario:
    """Return the scenario of a name, in any spelling of `env_id_of`, with HighwayEnv's layout or without.

    Raises:
        ValueError: If there is none; the message suggests the nearest id and lists all.

    Example:
        >>> find_scenario("cut_in").vehicle_names
        ('ego', 'cutter', 'lead')
    """
    return SCENARIOS[split_layout(env_id_of(name))[0].rpartition(":")[2]]


def env_id_of(name: str) -> str:
    """Return the environment id that a name means, see `complete_id`.

    Args:
        name: For example "cut_in", "CutIn-v0" or "rare_envs/CutIn-v0"; "module:my_namespace/Overtaking-v0", as for
            `gym.make`, imports first the module that registers it.

    Raises:
        ValueError: If there is none; the message suggests the nearest id and lists all.

    Example:
        >>> env_id_of("cut_in"), env_id_of("hard-brake")
        ('rare_envs/CutIn-v1', 'rare_envs/HardBrake-v0')
    """
    module = name.rpartition(":")[0] if isinstance(name, str) else ""
    if module:
        import_module(module, f"the environment {name!r}")
    env_id: str = complete_id(name)
    own = str(env_id).rpartition(":")[2]
    if own in SCENARIOS or own in map(kinematics_id, SCENARIOS):
        return env_id
    if is_highway_env_id(name):
        raise ValueError(
            f"{name!r} is an environment of HighwayEnv, not of the batched simulation: its drives become a problem by "
            f"rare_envs.highway_env_problem({name!r}, ego=...). The environments here are {', '.join(SCENARIOS)}."
        )
    hint = did_you_mean(own, SCENARIOS)
    raise ValueError(f"Unknown environment {name!r}{hint}; the environments are {', '.join(SCENARIOS)}.")


HIGHWAY_ENV_IDS = (
    *("highway-v0", "highway-fast-v0", "merge-v0", "merge-v1", "roundabout-v0", "roundabout-v1"),
    *("intersection-v0", "intersection-v1", "intersection-v2"),
)
"""Environments of HighwayEnv that `rare_envs.highway_env_problem` takes."""


def is_highway_env_id(env_id: object) -> bool:
    """Return whether an id is that of such an environment of HighwayEnv, in any version."""
    return re.match(r"(highway(-fast)?|merge|intersection|roundabout)-v\d", str(env_id)) is not None


def complete_id(name: Any) -> Any:
    """Return the registered id that a name means; else what is given, without "rare_envs:".

    Namespace and version may be left out, and words be joined in any way: "cut_in", "CutIn" and "cut-in-v1" are
    "rare_envs/CutIn-v1". Without a version it is the newest, without a namespace "rare_envs/", or the only one.
    """
    if not isinstance(name, str):  # what is no name is refused where the scenario is looked for
        return name
    module, colon, env_id = name.removeprefix("rare_envs:").rpartition(":")
    known = [each for own in SCENARIOS for each in (own, kinematics_id(own))]
    if is_highway_env_id(env_id) or env_id in known:
        return f"{module}{colon}{env_id}"
    namespace, letters, version = _spell(env_id)
    newest: dict[str, tuple[int, str]] = {}  # by namespace
    for each in known:
        own, its_letters, its_version = _spell(each)
        if its_letters == letters and namespace in ("", own) and version in (None, its_version):
            newest[own] = max(newest.get(own, (-1, "")), (its_version or 0, each))
    own = _OWN if _OWN in newest else next(iter(newest), "")
    return f"{module}{colon}{newest[own][1] if own == _OWN or len(newest) == 1 else env_id}"


def _spell(env_id: str) -> tuple[str, str, int | None]:
    """Return the bare letters of an id's namespace and name, and its version; None if it has none."""
    found = re.fullmatch(r"(.*)[-_][vV](\d+)", env_id)
    family, version = (found[1], int(found[2])) if found else (env_id, None)
    namespace, _, name = (re.sub(r"[^\w/]|_", "", family).lower()).rpartition("/")
    return namespace, name, version


_OWN = "rareenvs"
"""Bare letters of our namespace."""


HIGHWAY_ENV_LAYOUT = {"observation": "kinematics", "action": "meta"}
"""Keyword arguments that give an environment the interface of HighwayEnv's."""


def kinematics_id(env_id: str) -> str:
    """Return the id under which an environment has HighwayEnv's layout, for `gym.make` and scripts of HighwayEnv."""
    name, _, version = env_id.rpartition("-v")
    return f"{name}-kinematics-v{version}"


def split_layout(name: str) -> tuple[str, dict[str, str]]:
    """Return the id of the scenario itself for a name with HighwayEnv's layout, and the keyword arguments it means."""
    env_id = complete_id(name)
    module, colon, own = str(env_id).rpartition(":")
    scenario = {kinematics_id(each): each for each in SCENARIOS}.get(own)
    return (env_id, {}) if scenario is None else (f"{module}{colon}{scenario}", dict(HIGHWAY_ENV_LAYOUT))
