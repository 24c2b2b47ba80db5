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


def scenario_named(name: str) -> Scenario:
    """Return the scenario of a short name, such as "cut_in", in its newest version, or of an id.

    Raises:
        ValueError: If there is none; the message suggests the nearest name and lists all.

    Example:
        >>> scenario_named("cut_in").vehicle_names
        ('ego', 'cutter', 'lead')
    """
    return SCENARIOS[env_id_of(name)]


def env_id_of(name: str) -> str:
    """Return the environment id of a scenario's short name, first registered, in its newest version, or of an id."""
    name = complete_id(name)
    if name in SCENARIOS:
        return name
    ids: dict[str, str] = {}
    for env_id, scenario in SCENARIOS.items():
        family, version = split_version(env_id)
        known, earlier = split_version(ids.setdefault(scenario.name, env_id))
        if known == family and (earlier or 0) < (version or 0):
            ids[scenario.name] = env_id
    if name not in ids:
        hint = did_you_mean(name.rpartition("/")[2].lower(), ids)
        raise ValueError(f"Unknown scenario {name!r}{hint}; there are {', '.join(ids)}.")
    return ids[name]


def split_version(env_id: str) -> tuple[str, int | None]:
    """Return an id without its version, and the version; None where it has none."""
    found = re.fullmatch(r"(.*)[-_]v(\d+)", env_id)
    return (found[1], int(found[2])) if found else (env_id, None)


def find_scenario(env_id: str) -> Scenario:
    """Return the scenario of an environment id.

    Args:
        env_id: For example "rare_envs/CutIn-v0", or "CutIn-v0"; "module:my_namespace/Overtaking-v0", as for `gym.make`,
            imports first the module that registers it.

    Raises:
        ValueError: If there is none; the message suggests the nearest id and lists all.

    Example:
        >>> find_scenario("rare_envs/HardBrake-v0").name
        'hard_brake'
    """
    module, _, name = env_id.rpartition(":") if isinstance(env_id, str) else ("", "", env_id)
    if module:
        import_module(module, f"the environment {env_id!r}")
    name = complete_id(name)
    if isinstance(name, str) and name in SCENARIOS:
        return SCENARIOS[name]
    layouts = {kinematics_id(each): each for each in SCENARIOS}
    if isinstance(name, str) and name in layouts:
        raise ValueError(
            f"{name!r} is for gym.make and gym.make_vec; here take {layouts[name]!r} with "
            f"observation 'kinematics' and action 'meta'."
        )
    if is_highway_env_id(name):
        raise ValueError(
            f"{name!r} is an environment of HighwayEnv, not of the batched simulation: its drives become a problem by "
            f"rare_envs.highway_env_problem({name!r}, ego=...). The environments here are {', '.join(SCENARIOS)}."
        )
    hint = did_you_mean(str(name), SCENARIOS)
    raise ValueError(f"Unknown environment {env_id!r}{hint}; the environments are {', '.join(SCENARIOS)}.")


HIGHWAY_ENV_IDS = (
    *("highway-v0", "highway-fast-v0", "merge-v0", "merge-v1", "roundabout-v0", "roundabout-v1"),
    *("intersection-v0", "intersection-v1", "intersection-v2"),
)
"""Environments of HighwayEnv that `rare_envs.highway_env_problem` takes."""


def is_highway_env_id(env_id: object) -> bool:
    """Return whether an id is that of such an environment of HighwayEnv, in any version."""
    return re.match(r"(highway(-fast)?|merge|intersection|roundabout)-v\d", str(env_id)) is not None


def complete_id(env_id: str) -> str:
    """Return the registered id for a spelling of it; else what is given, without "rare_envs:".

    Namespace and version may be left out, and words be joined in any way: "cut_in", "CutIn" and "cut-in-v1" are
    "rare_envs/CutIn-v1". Without a version it is the newest; names in several namespaces need theirs.
    """
    if isinstance(env_id, str):  # what is no id is refused where the scenario is looked for
        env_id = env_id.removeprefix("rare_envs:")
    if str(env_id) in SCENARIOS or is_highway_env_id(env_id):
        return env_id
    namespace, name, version = _spell(str(env_id))
    found: dict[str, tuple[int, str]] = {}  # the newest by namespace
    for each in (each for known in SCENARIOS for each in (known, kinematics_id(known))):
        own, its_name, its_version = _spell(each)
        if its_name == name and namespace in ("", own) and version in (None, its_version):
            found[own] = max(found.get(own, (-1, "")), (its_version or 0, each))
    return next(iter(found.values()))[1] if len(found) == 1 else env_id


def _spell(env_id: str) -> tuple[str, str, int | None]:
    """Return namespace, bare letters and version of an id."""
    family, version = split_version(env_id)
    namespace, _, name = family.rpartition("/")
    return namespace, re.sub(r"[\W_]", "", name).lower(), version


HIGHWAY_ENV_LAYOUT = {"observation": "kinematics", "action": "meta"}
"""Keyword arguments that give an environment the interface of HighwayEnv's."""


def kinematics_id(env_id: str) -> str:
    """Return the id under which an environment has HighwayEnv's layout, for `gym.make` and scripts of HighwayEnv."""
    name, _, version = env_id.rpartition("-v")
    return f"{name}-kinematics-v{version}"


def split_layout(env_id: str) -> tuple[str, dict[str, str]]:
    """Return the id of the scenario itself for one with HighwayEnv's layout, and the keyword arguments it means."""
    layouts, env_id = {kinematics_id(each): each for each in SCENARIOS}, complete_id(env_id)
    known = isinstance(env_id, str) and env_id in layouts
    return (layouts[env_id], dict(HIGHWAY_ENV_LAYOUT)) if known else (env_id, {})
