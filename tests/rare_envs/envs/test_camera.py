"""The camera in environments and problems: conformance, one picture whatever asks for it, egos that see."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.vec_env import VecFrameStack

import rare_envs
from rare_envs.devices.batch_sizes import CAMERA_TILE
from rare_envs.sensors.camera import Camera
from rare_envs.sensors.kinds import map_kinds, read_kinds
from training import sb3_vec_env

CUT_IN = "rare_envs/CutIn-v0"
SMALL = (36, 60)
ids = pytest.mark.parametrize("env_id", rare_envs.ENV_IDS)


class Daredevil:
    """Accelerates by the brightness in the middle of the picture, steers by the sides; sees pictures alone."""

    observation_space = spaces.Box(0, 255, (66, 200, 3), np.uint8)

    def __init__(self) -> None:
        self.batches: list[int] = []

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[np.float64], Any]:
        assert observation.dtype == np.uint8
        self.batches.append(len(observation))
        brightness = observation[:, 22:30, 92:108].mean(axis=(1, 2, 3)) / 255.0  # exact: a sum of integers
        sides = observation[:, 40:].mean(axis=(1, 3)) @ np.sign(np.arange(200) - 99.5) / 25_500.0
        return np.stack((2.0 * brightness, -0.1 * sides), axis=1).clip(-1.0, 1.0), state


@ids
@pytest.mark.parametrize("observation", ["camera", "camera+lidar"])
def test_checkers(env_id: str, observation: str) -> None:
    check_env(gym.make(env_id, observation=observation, weather=True).unwrapped, skip_render_check=True)
    sb3_check_env(gym.make(env_id, observation=observation))


@ids
def test_env_and_batch_see_the_same(env_id: str) -> None:
    settings: dict[str, Any] = {"observation": ("lidar", "camera"), "weather": True, "camera": SMALL}
    env, batch = gym.make(env_id, **settings), rare_envs.make_batch(env_id, 3, **settings)
    _, infos = batch.reset(seed=4)
    seen, _ = batch.reset(options={"x": infos["x"]})
    rows = [env.reset(options={"x": x})[0] for x in infos["x"]]
    for row in range(3):
        map_kinds(np.testing.assert_array_equal, rows[row], map_kinds(lambda part, row=row: part[row], seen))
    env.reset(options={"x": infos["x"][1]})
    for _ in range(4):
        action = np.array([0.3, 0.05])
        one, *_ = env.step(action)
        many, *_ = batch.step(np.repeat(action[None], 3, axis=0))
        np.testing.assert_array_equal(one["camera"], many["camera"][1])


def test_the_last_picture_of_an_episode_and_the_first_of_the_next() -> None:
    batch = rare_envs.make_batch(CUT_IN, 2, observation="camera+features", camera=SMALL, horizon=0.2)
    batch.reset(seed=0)
    batch.step(np.zeros((2, 2)))
    observation, _, _, truncated, infos = batch.step(np.zeros((2, 2)))
    assert truncated.all()
    assert set(infos["final_obs"][0]) == set(observation) == {"camera", "features"}
    assert infos["final_obs"][0]["camera"].shape == (*SMALL, 3)
    env = gym.make(CUT_IN, observation="camera", camera=SMALL)
    for row in range(2):
        first, _ = env.reset(options={"x": infos["x"][row]})
        np.testing.assert_array_equal(first, observation["camera"][row])


def test_a_problem_and_an_environment_lead_to_the_same_end() -> None:
    """An ego that drives by pictures, noise and weather included, in batches and alone."""
    settings: dict[str, Any] = {"observation": "camera", "weather": True, "horizon": 3.0}
    ego = Daredevil()
    problem = rare_envs.DrivingProblem(CUT_IN, ego=ego, **settings)
    x = problem.base.sample(12, np.random.default_rng(2))
    f = problem.evaluate(x)
    assert ego.batches == [12] * 30
    assert len(np.unique(f)) > 6
    np.testing.assert_array_equal(problem.evaluate(x[3:5]), f[3:5])
    env = gym.make(CUT_IN, **settings)
    for row in range(3):
        observation, _ = env.reset(options={"x": x[row]})
        over = False
        while not over:
            action, _ = ego.predict(observation[None])
            observation, _, terminated, truncated, info = env.step(action[0])
            over = terminated or truncated
        assert info["measure"] == f[row]


def test_pictures_are_taken_only_where_they_are_observed(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise AssertionError

    monkeypatch.setattr("rare_envs.simulation.observation.take_picture", fail)
    problem = rare_envs.DrivingProblem(CUT_IN, observation="camera", weather=True)  # driven by IDM
    problem.evaluate(problem.base.sample(8, np.random.default_rng(0)))


def test_batches_of_pictures_are_small() -> None:
    ego = Daredevil()
    problem = rare_envs.DrivingProblem(CUT_IN, ego=ego, observation="camera", horizon=0.1)
    problem.evaluate(problem.base.sample(CAMERA_TILE + 2, np.random.default_rng(0)))
    assert ego.batches == [CAMERA_TILE, 2]


@pytest.mark.parametrize(("observation", "policy"), [("camera", "CnnPolicy"), ("camera+lidar", "MultiInputPolicy")])
def test_stable_baselines3_learns_and_drives(observation: str, policy: str) -> None:
    settings: dict[str, Any] = {"observation": observation, "camera": SMALL, "horizon": 1.0}
    env = sb3_vec_env(CUT_IN, num_envs=2, seed=0, **settings)
    model = PPO(policy, env, n_steps=8, batch_size=8, n_epochs=1, seed=0, device="cpu").learn(32)
    problem = rare_envs.DrivingProblem(CUT_IN, ego=model, **settings)
    f = problem.evaluate(problem.base.sample(4, np.random.default_rng(0)))
    assert np.isfinite(f).all()


def test_stacked_frames_of_a_camera() -> None:
    settings: dict[str, Any] = {"observation": "camera", "camera": SMALL, "horizon": 0.5}
    stacked = VecFrameStack(sb3_vec_env(CUT_IN, num_envs=1, seed=0, **settings), n_stack=3)
    model = PPO("CnnPolicy", stacked, n_steps=4, batch_size=4, device="cpu", seed=0)
    assert model.observation_space.shape == (9, *SMALL)
    problem = rare_envs.DrivingProblem(CUT_IN, ego=model, **settings)
    x = problem.base.sample(1, np.random.default_rng(0))
    f = problem.evaluate(x)

    stacked.set_options({"x": x[0]})
    shown, done = stacked.reset(), [False]
    while not done[0]:
        action, _ = model.predict(shown, deterministic=True)
        shown, _, done, infos = stacked.step(action)
    assert infos[0]["measure"] == pytest.approx(f[0], abs=1e-5)


def test_a_camera_on_every_agent() -> None:
    env = rare_envs.parallel_env(CUT_IN, observation="camera", weather=True)
    pictures, infos = env.reset(seed=1, options={"sensor_noise": 0.0, "fog": 1e-4})
    assert all(env.observation_space(agent).contains(picture) for agent, picture in pictures.items())
    alone, _ = gym.make(CUT_IN, observation="camera", weather=True).reset(options={"x": infos["ego"]["x"]})
    np.testing.assert_array_equal(pictures["ego"], alone)
    red = {agent: (p[:, :, 0] > 2.5 * p[:, :, 1].astype(float)).sum() for agent, p in pictures.items()}
    assert red["ego"] > 20  # the cutter, vehicle 1, is red for everybody else
    assert red["cutter"] == red["lead"] == 0


def test_an_ego_for_other_pictures_is_refused() -> None:
    with pytest.raises(ValueError, match="66, 200, 3"):
        rare_envs.DrivingProblem(CUT_IN, ego=Daredevil(), observation="camera", camera=(32, 64))
    with pytest.raises(ValueError, match="66, 200, 3"):
        rare_envs.DrivingProblem(CUT_IN, ego=Daredevil(), observation="camera+lidar")


@pytest.mark.parametrize("wrong", ["radar", "camera+radar", [], ("camera", "camera"), 3, "camera+", ("camera", 4)])
def test_unknown_observations_are_refused(wrong: Any) -> None:
    with pytest.raises(ValueError, match="observation"):
        gym.make(CUT_IN, observation=wrong)


def test_names_of_several_observations_in_any_order() -> None:
    assert read_kinds("lidar+camera") == read_kinds(("camera", "lidar")) == read_kinds(["lidar", "camera"])


def test_meta_actions_and_a_camera() -> None:
    settings: dict[str, Any] = {"observation": "camera", "action": "meta", "weather": True, "camera": SMALL}
    env, batch = gym.make(CUT_IN, **settings), rare_envs.make_batch(CUT_IN, 2, **settings)
    _, infos = batch.reset(seed=0)
    env.reset(options={"x": infos["x"][1]})
    for action in (1, 4, 0):
        one, _, terminated, truncated, _ = env.step(action)
        many, _, _, _, infos = batch.step(np.array([action, action]))
        over = terminated or truncated
        np.testing.assert_array_equal(one, infos["final_obs"][1] if over else many[1])
        if over:
            break


@pytest.mark.gpu
def test_pictures_of_a_gpu_are_those_of_the_cpu() -> None:
    from rare_envs.sensors.camera import CameraContext, Weather, clear_day, take_picture
    from rare_envs.traffic.road import i80
    from rare_envs.traffic.state import State

    x = torch.rand(32, 6) * 60
    y, heading = torch.rand(32, 6) * 15, torch.randn(32, 6) * 0.05
    state, sky = (
        State(x, y, heading, torch.zeros_like(x), x[:, :0]),
        clear_day(x)._replace(noise=torch.full((32,), 4.0)),
    )
    here = take_picture(state, i80(), CameraContext.at_start(Camera(), sky)).int()
    there = take_picture(
        State(*(field.cuda() for field in state)),
        i80(),
        CameraContext.at_start(Camera(), Weather(*(field.cuda() for field in sky))),
    )
    difference = (there.cpu().int() - here).abs()
    assert (difference > 1).float().mean() < 1e-3  # silhouettes
