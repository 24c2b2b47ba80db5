"""The distribution of gaps on HighwayEnv's highway."""

from typing import Any

import highway_env  # noqa: F401  (registers the ids)
import numpy as np
import pytest
from scipy import stats

from rare_envs import HighwayEnvScenario
from rare_envs.interop.simulation import make_highway_env

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


def test_density_of_the_spacing_is_the_jacobian_of_its_map() -> None:
    law = scenario("highway-fast-v0", vehicles=2).space.base.blocks[2]
    x = law.sample(5, np.random.default_rng(1))
    u = law.to_standard_normal(x)
    steps = 1e-6 * np.eye(law.dim)
    for row, point in enumerate(u):
        jacobian = np.stack(
            [
                (law.from_standard_normal((point + h)[None]) - law.from_standard_normal((point - h)[None]))[0] / 2e-6
                for h in steps
            ]
        )
        expected = stats.norm.logpdf(point).sum() - np.log(abs(np.linalg.det(jacobian)))
        assert law.log_prob(x[row : row + 1])[0] == pytest.approx(expected, abs=1e-5)
