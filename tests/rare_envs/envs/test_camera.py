"""The camera in environments and problems: conformance, one picture whatever asks for it, egos that see."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import rare_envs
from rare_envs.simulation.observation import map_kinds

CUT_IN = "rare_envs/CutIn-v0"
SMALL = (36, 60)
ids = pytest.mark.parametrize("env_id", rare_envs.ENV_IDS)


class Daredevil:
    """Accelerates by the brightness in the middle of the picture, steers by the sides; sees pictures alone."""

    observation_space = spaces.Box(0, 255, (66, 200, 3), np.uint8)

    def __init__(self) -> None:
        self.batches: list[int] = []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert observation.dtype == np.uint8
        self.batches.append(len(observation))
        brightness = observation[:, 22:30, 92:108].mean(axis=(1, 2, 3)) / 255.0  # exact: a sum of integers
        sides = observation[:, 40:].mean(axis=(1, 3)) @ np.sign(np.arange(200) - 99.5) / 25_500.0
        return np.stack((2.0 * brightness, -0.1 * sides), axis=1).clip(-1.0, 1.0), state


@ids
def test_env_and_batch_see_the_same(env_id: str) -> None:
    settings: dict[str, Any] = {"observation": ("lidar", "camera"), "weather": True, "camera": SMALL}
    env, batch = gym.make(env_id, **settings), gym.make_vec(env_id, 3, **settings)
    _, infos = batch.reset(seed=4)
    seen, _ = batch.reset(options={"x": infos["x"]})
    rows = [env.reset(options={"x": x})[0] for x in infos["x"]]
    for row in range(2):
        map_kinds(np.testing.assert_array_equal, rows[row], map_kinds(lambda part, row=row: part[row], seen))
    env.reset(options={"x": infos["x"][1]})
    for _ in range(4):
        action = np.array([0.3, 0.05])
        one, *_ = env.step(action)
        many, *_ = batch.step(np.repeat(action[None], 3, axis=0))
        np.testing.assert_array_equal(one["camera"], many["camera"][1])


def test_a_problem_and_an_environment_lead_to_the_same_end() -> None:
    """An ego that drives by pictures, noise and weather included, in batches and alone."""
    settings: dict[str, Any] = {"observation": "camera", "weather": True, "horizon": 2.0}
    ego = Daredevil()
    problem = rare_envs.DrivingProblem(CUT_IN, ego=ego, **settings)
    x = problem.base.sample(12, np.random.default_rng(2))
    f = problem.evaluate(x)
    assert ego.batches == [12] * 20
    assert len(np.unique(f)) > 6
    np.testing.assert_array_equal(problem.evaluate(x[3:5]), f[3:5])
    env = gym.make(CUT_IN, **settings)
    for row in range(2):
        observation, _ = env.reset(options={"x": x[row]})
        over = False
        while not over:
            action, _ = ego.predict(observation[None])
            observation, _, terminated, truncated, info = env.step(action[0])
            over = terminated or truncated
        assert info["measure"] == f[row]


def test_an_ego_for_other_pictures_is_refused() -> None:
    for settings in ({"observation": "camera", "camera": (32, 64)}, {"observation": "camera+lidar"}):
        with pytest.raises(ValueError, match="66, 200, 3"):
            rare_envs.DrivingProblem(CUT_IN, ego=Daredevil(), **settings)
