"""The batch of agents that share a policy: rows, and the end of a scenario."""

from typing import Any

import numpy as np
import pytest

import rare_envs
from rare_envs.envs.multi_agent_vector import AgentsVectorEnv
from rare_envs.sensors.kinds import map_kinds

CUT_IN = "rare_envs/CutIn-v0"
SMALL = (36, 60)


def test_a_batch_of_agents_that_see() -> None:
    """Rows of agents that share a policy: what each sees in its place, also at the end of an episode."""
    settings: dict[str, Any] = {"observation": "camera+features", "camera": SMALL, "horizon": 0.2}
    batch, env = AgentsVectorEnv(CUT_IN, 2, **settings), rare_envs.parallel_env(CUT_IN, **settings)
    x = batch.space.sample(2, np.random.default_rng(0))
    seen, _ = batch.reset(options={"x": x})
    assert batch.observation_space.contains(seen)
    alone, _ = env.reset(options={"x": x[1]})
    for number, agent in enumerate(env.agents):
        map_kinds(np.testing.assert_array_equal, map_kinds(lambda part, row=3 + number: part[row], seen), alone[agent])
    for _ in range(2):
        seen, _, _, truncated, infos = batch.step(np.zeros((batch.num_envs, 2)))
        alone, *_ = env.step(dict.fromkeys(env.agents, np.zeros(2)))
    assert truncated.all()
    for number, agent in enumerate(env.possible_agents):
        map_kinds(np.testing.assert_array_equal, infos["final_obs"][3 + number], alone[agent])


def test_a_collision_of_the_ego_ends_all_rows_of_its_scenario() -> None:
    batch = AgentsVectorEnv("rare_envs/CarFollowing-v0", 2, agents=["ego", "lead"])
    batch.reset(options={"x": [[20.0, 10.0, 1.0], [20.0, 20.0, 100.0]]})
    for _ in range(3):
        _, _, terminated, truncated, infos = batch.step(np.tile([1.0, 0.0], (4, 1)))
        if terminated.any():
            break
    assert terminated.tolist() == [True, True, False, False]
    assert not truncated.any()
    assert infos["final_info"]["ego_collision"].tolist() == [True, True, False, False]
    assert infos["final_info"]["measure"][0] == -1.0


def test_wrong_numbers_of_scenarios_are_refused() -> None:
    for wrong in (0, 2.5, True, "3"):
        with pytest.raises(ValueError, match="one or more scenarios"):
            AgentsVectorEnv(CUT_IN, wrong)  # type: ignore[arg-type]
