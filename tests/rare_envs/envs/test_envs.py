"""Env, VectorEnv and rollout: conformance with Gymnasium and Stable-Baselines3, and agreement with each other."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import rare_envs
from rare_envs.control.actions import DISCRETE_ACTIONS, to_physical
from rare_envs.control.idm import IDM
from rare_envs.envs.vector import DrivingVectorEnv
from rare_envs.scenarios.registry import SCENARIOS
from rare_envs.simulation.observation import CLIP, observation_space

ENV_IDS = rare_envs.ENV_IDS
ids = pytest.mark.parametrize("env_id", ENV_IDS)
SCRIPTED_IDS = [env_id for env_id, scenario in SCENARIOS.items() if scenario.drivers is None]
scripted = pytest.mark.parametrize("env_id", SCRIPTED_IDS)  # no network, so batch sizes change no bit


class Scripted:
    """An ego with SB3's `predict`: a fixed sequence of actions, then the last one for ever."""

    def __init__(self, actions: NDArray[np.float64]) -> None:
        self.actions = actions

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> Any:
        tick = 0 if state is None else state[0]
        action = self.actions[min(tick, len(self.actions) - 1)]
        return np.repeat(action[None], len(observation), axis=0), (tick + 1,)


def scripted_actions(seed: int = 0) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    return np.stack([rng.uniform(-0.7, 1.0, 100), rng.uniform(-0.05, 0.05, 100)], axis=1)


@ids
def test_gymnasium_checker(env_id: str) -> None:
    check_env(gym.make(env_id).unwrapped, skip_render_check=True)


@ids
def test_stable_baselines3_checker(env_id: str) -> None:
    sb3_check_env(gym.make(env_id))


@scripted
def test_env_and_rollout_agree_bit_for_bit_with_a_rule_based_ego(env_id: str) -> None:
    problem = rare_envs.DrivingProblem(env_id)
    x = problem.base.sample(2_000, np.random.default_rng(5))
    f = problem.evaluate(x)
    env = gym.make(env_id)
    low = np.argsort(f)[[0, 1, 2, 5, 20, 100]]
    for row in [*low, 0]:
        env.reset(options={"x": x[row]})
        done = False
        while not done:
            # the physical action, not its float32 image in [-1, 1], which rounds
            episode = env.unwrapped._episode  # type: ignore[attr-defined]
            action = IDM().act(episode, None)[0]
            env.unwrapped._episode = env.unwrapped.world.step(episode, action)  # type: ignore[attr-defined]
            env.unwrapped._tick += 1  # type: ignore[attr-defined]
            done = bool(env.unwrapped._episode.collided) or env.unwrapped._tick == env.unwrapped.world.clock.ticks  # type: ignore[attr-defined]
        assert float(env.unwrapped._episode.f) == f[row]  # type: ignore[attr-defined]


@scripted
def test_env_vector_env_and_rollout_agree_on_the_same_x_and_actions(env_id: str) -> None:
    actions = scripted_actions()
    problem = rare_envs.DrivingProblem(env_id, ego=Scripted(actions), horizon=5.0)
    x = problem.base.sample(64, np.random.default_rng(1))
    f = problem.evaluate(x)
    assert (f == -1.0).any()
    assert (f > 0.0).any()

    batch = rare_envs.make_batch(env_id, len(x), horizon=5.0)
    batch.reset(options={"x": x})
    measured = np.full(len(x), np.nan)
    observations = []
    for action in actions:
        observation, reward, terminated, truncated, infos = batch.step(np.repeat(action[None], len(x), axis=0))
        observations.append((observation, reward, infos))
        first = (terminated | truncated) & np.isnan(measured)
        measured[first] = infos["final_info"]["measure"][first] if first.any() else np.nan
    np.testing.assert_array_equal(measured, f)

    env = gym.make(env_id, horizon=5.0)
    for row in range(8):
        env.reset(options={"x": x[row]})
        for tick, action in enumerate(actions):
            observation, reward, terminated, truncated, info = env.step(action)
            if terminated or truncated:
                assert info["measure"] == f[row]
                assert info["collision"] == (f[row] == -1.0) == terminated
                np.testing.assert_array_equal(observation, observations[tick][2]["final_obs"][row])
                break
            np.testing.assert_array_equal(observation, observations[tick][0][row])
            assert reward == pytest.approx(observations[tick][1][row], rel=1e-6)
            assert info["min_ttc"] == observations[tick][2]["min_ttc"][row]


@scripted
def test_a_row_does_not_depend_on_its_batch(env_id: str) -> None:
    problem = rare_envs.DrivingProblem(env_id)
    x = problem.base.sample(300, np.random.default_rng(2))
    f = problem.evaluate(x)
    for n in (1, 7, 33):
        np.testing.assert_array_equal(problem.evaluate(x[:n]), f[:n])
    np.testing.assert_array_equal(problem.evaluate(x[::-1])[::-1], f)


@scripted
def test_info_at_start_and_end(env_id: str) -> None:
    env = gym.make(env_id)
    _, info = env.reset(seed=3)
    space = env.unwrapped.space  # type: ignore[attr-defined]
    assert info["scenario"] == dict(zip(space.names, info["x"].tolist(), strict=True))
    assert not {"measure", "collision_type"} & info.keys()
    done = False
    while not done:
        _, reward, terminated, truncated, info = env.step(np.array([1.0, 0.0], np.float32))
        assert reward == pytest.approx(sum(info["reward_terms"].values()), rel=1e-5)
        done = terminated or truncated
    assert {"scenario", "x", "min_ttc", "collision", "measure", "collision_type"} <= info.keys()
    assert terminated  # full throttle runs into the lead
    assert (info["measure"], info["min_ttc"]) == (-1.0, 0.0)
    assert info["collision_type"] in ("rear_end", "side")


@scripted
def test_reset_options(env_id: str) -> None:
    env = gym.make(env_id)
    name = env.unwrapped.space.names[0]  # type: ignore[attr-defined]
    _, free = env.reset(seed=11)
    _, given = env.reset(seed=11, options={name: 12.5})
    assert given["scenario"][name] == 12.5
    assert np.array_equal(given["x"][1:], free["x"][1:])  # the others are drawn as without the option
    _, again = env.reset(options={"x": free["x"]})
    np.testing.assert_array_equal(again["x"], free["x"])
    with pytest.raises(ValueError, match=rf"{name}.*range.*m/s"):
        env.reset(options={name: -1.0})
    with pytest.raises(ValueError, match=rf"did you mean '{name}'"):
        env.reset(options={f"{name}_": 12.5})
    with pytest.raises(ValueError, match=name):
        env.reset(options={name: float("nan")})
    with pytest.raises(ValueError, match="shape"):
        env.reset(options={"x": [1.0, 2.0]})


@ids
def test_same_seed_same_episodes(env_id: str) -> None:
    runs = []
    for _ in range(2):
        batch = rare_envs.make_batch(env_id, 16, horizon=3.0)
        observation, _ = batch.reset(seed=4)
        rows = [observation]
        batch.action_space.seed(0)
        for _ in range(50):
            rows.append(batch.step(batch.action_space.sample())[0])
        runs.append(np.array(rows))
    np.testing.assert_array_equal(*runs)


@ids
def test_vector_env_replaces_ended_episodes_in_the_same_step(env_id: str) -> None:
    batch = gym.make_vec(env_id, num_envs=32)  # the batched entry point is the default
    assert isinstance(batch.unwrapped, DrivingVectorEnv)
    assert batch.metadata["autoreset_mode"] == gym.vector.AutoresetMode.SAME_STEP
    batch.reset(seed=0)
    ended = 0
    for _ in range(120):
        x = batch.unwrapped._x.copy()
        observation, _, terminated, truncated, infos = batch.step(np.tile(np.array([0.4, 0.0], np.float32), (32, 1)))
        done = terminated | truncated
        assert observation in batch.observation_space
        np.testing.assert_array_equal((batch.unwrapped._x != x).any(axis=1), done)
        if done.any():
            np.testing.assert_array_equal(infos["_final_info"], done)
            assert [row is not None for row in infos["final_obs"]] == done.tolist()
            np.testing.assert_array_equal(infos["final_info"]["collision"][done], terminated[done])
            np.testing.assert_array_equal(infos["final_info"]["x"][done], x[done])
            ended += int(done.sum())
    assert ended >= 32


def test_observation_by_hand() -> None:
    env = gym.make("rare_envs/CutIn-v0")
    x = [20.0, 15.0, 18.0, 10.0, 30.0, 3.6]
    observation, _ = env.reset(options={"x": x})
    cutter, lead = [10 / 50, -5 / 10, 3.6 / 4, 0.0], [45 / 50, -2 / 10, 0.0, 0.0]
    np.testing.assert_allclose(observation, [20 / 30, 0.0, 0.0, *cutter, *lead], rtol=1e-6)
    assert np.abs(observation).max() < CLIP
    assert observation_space(3).shape == (11,)


def test_actions() -> None:
    physical = to_physical(torch.tensor([[0.5, -1.0], [-3.0, 0.0]]), 2)
    torch.testing.assert_close(physical, torch.tensor([[2.5, -0.1], [-5.0, 0.0]]))
    torch.testing.assert_close(to_physical(torch.tensor([0, 4]), 2), torch.tensor([[-5.0, 0.0], [2.0, 0.0]]))
    assert len(DISCRETE_ACTIONS) == 5
    for wrong in (torch.tensor([5]), torch.tensor([[1, 0, 0]]), torch.tensor([[float("nan"), 0.0]])):
        with pytest.raises(ValueError, match=r"action"):
            to_physical(wrong, 1)


def test_bad_arguments_are_refused_at_the_door() -> None:
    for kwargs in (
        {"observation": "features2"},
        {"action": "mega"},
        {"measure": "tcc"},
        {"base": "us102"},
        {"horizon": -1.0},
        {"render_mode": "ansi"},
    ):
        with pytest.raises(ValueError, match=r"[Ee]xpected|Unknown|No base"):
            rare_envs.envs.single.DrivingEnv("rare_envs/CutIn-v0", **kwargs)  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="did you mean 'rare_envs/CutIn-v0'"):
        rare_envs.make_batch("rare_envs/CutInn-v0", 4)
    with pytest.raises(ValueError, match="num_envs"):
        rare_envs.make_batch("rare_envs/CutIn-v0", 0)


@scripted
def test_episodes_after_a_replacement_are_those_of_the_single_env(env_id: str) -> None:
    """Nothing of an ended episode, not its clock and not its least time to collision, is left in the next."""
    batch, env = rare_envs.make_batch(env_id, 6, horizon=3.0), gym.make(env_id, horizon=3.0)
    observation, infos = batch.reset(seed=5)
    rng = np.random.default_rng(0)
    x, given = infos["x"].copy(), [[] for _ in range(6)]  # type: ignore[var-annotated]
    lives = np.zeros(6, dtype=int)
    for _ in range(120):
        actions = np.stack([rng.uniform(-0.2, 1.0, 6), rng.uniform(-0.2, 0.2, 6)], axis=1)
        for row in range(6):
            given[row].append(actions[row])
        observation, reward, terminated, truncated, infos = batch.step(actions)
        for row in np.flatnonzero(terminated | truncated):
            env.reset(options={"x": x[row]})
            for action in given[row]:
                last = env.step(action)
            final = infos["final_info"]
            np.testing.assert_array_equal(last[0], infos["final_obs"][row])
            assert last[1] == pytest.approx(reward[row], rel=1e-6)
            assert last[2:4] == (terminated[row], truncated[row])
            assert last[4]["measure"] == final["measure"][row]
            assert last[4]["min_ttc"] == final["min_ttc"][row]
            assert last[4]["collision_type"] == final["collision_type"][row]
            x[row], given[row], lives[row] = infos["x"][row], [], lives[row] + 1
            np.testing.assert_array_equal(env.reset(options={"x": x[row]})[0], observation[row])
    assert lives.min() >= 3


def test_reward_by_hand() -> None:
    env = gym.make("rare_envs/CarFollowing-v0")
    env.reset(options={"x": [20.0, 15.0, 14.5]})
    _, reward, _, _, info = env.step(np.array([0.5, 0.0]))
    # after the tick: speed 20.25, gap 14.5 - 0.5 = 14, closing at 5.25
    terms = {
        "progress": 20.25 / 21.72,
        "comfort": -0.1 * 0.5**2,
        "lane": 0.0,
        "risk": -(1.0 - (14.0 / 5.25) / 4.0),
        "headway": -0.5 * (1.0 - 14.0 / 22.25),
        "collision": 0.0,
    }
    assert info["reward_terms"] == pytest.approx(terms, abs=1e-6)
    assert reward == pytest.approx(sum(terms.values()), abs=1e-6)
    env.reset(options={"x": [20.0, 15.0, 1.0]})
    for _ in range(3):
        _, _, terminated, _, info = env.step(np.array([1.0, 0.0]))
    assert terminated
    assert info["reward_terms"]["collision"] == -30.0


def test_wrong_actions_are_refused_and_the_episode_goes_on() -> None:
    env = gym.make("rare_envs/CarFollowing-v0").unwrapped
    env.reset(seed=0)
    for action in (1, np.zeros(3), np.zeros((1, 2)), [np.nan, 0.0]):
        with pytest.raises(ValueError, match=r"shape \(2,\)|NaN"):
            env.step(action)
    assert env.step([0.0, 0.0])[4]["x"].shape == (3,)


def test_registered_ids_are_the_scenarios() -> None:
    assert tuple(SCENARIOS) == ENV_IDS
    assert len({scenario.name for scenario in SCENARIOS.values()}) == len(SCENARIOS)
    assert set(SCENARIOS) <= set(gym.registry)


def test_wrong_types_are_value_errors() -> None:
    for kwargs in (
        {"dt": "0.1"},
        {"dt": True},
        {"dt": None},
        {"horizon": "10"},
        {"horizon": 0.25},
        {"measure": ["ttc"]},
    ):
        with pytest.raises(ValueError, match=r"Expected|measure"):
            gym.make("rare_envs/CutIn-v0", **kwargs)
    env = gym.make("rare_envs/CutIn-v0").unwrapped
    for options in ([], "abc", 3):
        with pytest.raises(ValueError, match="mapping"):
            env.reset(options=options)  # type: ignore[arg-type]
    for num_envs in (2.5, "3", 0):
        with pytest.raises(ValueError, match="num_envs"):
            rare_envs.make_batch("rare_envs/CutIn-v0", num_envs)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="Unknown environment None"):
        rare_envs.DrivingProblem(None)  # type: ignore[arg-type]
