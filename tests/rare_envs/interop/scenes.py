"""HighwayEnv's environments in small, for the tests of their parameters."""

from typing import Any

import highway_env  # noqa: F401  (registers the ids)

from rare_envs import HighwayEnvScenario
from rare_envs.interop.problem import make_highway_env

SMALL = {"vehicles_count": 6, "duration": 5}
CONFIGS: dict[str, dict[str, Any] | None] = {
    "highway-v0": SMALL,
    "highway-fast-v0": SMALL,
    "merge-v1": None,
    "intersection-v2": {"initial_vehicle_count": 4, "duration": 4},
    "roundabout-v1": None,
}


def scenario(env_id: str, **kwargs: Any) -> Any:
    return HighwayEnvScenario(make_highway_env(env_id, CONFIGS[env_id]), **kwargs)


def others(env: Any) -> list[Any]:
    return [v for v in env.unwrapped.road.vehicles if v is not env.unwrapped.vehicle]
