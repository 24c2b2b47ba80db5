"""The batched simulation behind Stable-Baselines3's `VecEnv`, with an ego, several agents or an adversary."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

import rare_envs
import training
from examples import adversary, shared_policy
from rare_envs.distributions.beta import BetaDistribution
from rare_envs.envs.parallel import AgentsVectorEnv
from rare_envs.multi_agent import adversary_reward
from rare_envs.startup import use_one_thread
from training import sb3_vec_env
from training.vec_env import BatchedVecEnv

FOLLOWING, CUT_IN = "rare_envs/CarFollowing-v0", "rare_envs/CutIn-v0"


class Countdown(gym.Env[np.ndarray, np.ndarray]):
    """Ends after `length` steps (truncated at `limit`); shows start, steps and action."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012 (Gymnasium's convention)
    render_mode = "rgb_array"
    observation_space = spaces.Box(-100.0, 100.0, (3,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    speed_limit = 30.0

    def __init__(self, length: int, limit: int = 1000) -> None:
        self.length, self.limit = length, limit

    def _observe(self, action: Any = (0.0, 0.0)) -> np.ndarray:
        return np.array([self.start, self.count, np.sum(action)], np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.start = float(self.np_random.uniform(0.0, 10.0))
        self.start = float((options or {}).get("start", self.start))
        self.count = 0
        return self._observe(), {"x": np.array([self.start]), "scenario": {"start": self.start}}

    def step(self, action: Any) -> Any:
        self.count += 1
        terminated, truncated = self.count >= self.length, self.count >= self.limit
        info = {"measure": self.start, "scenario": {"start": self.start}}
        return self._observe(action), float(self.count), terminated, truncated, info

    def render(self) -> np.ndarray:  # type: ignore[override]
        return np.full((4, 4, 3), self.count, np.uint8)


def batch(*lengths: int, limit: int = 1000, mode: Any = AutoresetMode.SAME_STEP) -> Any:
    """A batch of countdowns, run by Gymnasium's own vectorisation."""
    makers = [lambda length=length: Countdown(length, limit) for length in lengths]
    return SyncVectorEnv(makers, autoreset_mode=mode)


# --- the adapter, against a batch whose answers are known --------------------------------------


@pytest.mark.parametrize("batches", [((2, 3, 7),), ((2, 3), (7,))])
def test_it_agrees_with_the_vec_env_of_stable_baselines(batches: tuple[tuple[int, ...], ...]) -> None:
    rng = np.random.default_rng(0)
    makers = [lambda length=length: Countdown(length, limit=5) for part in batches for length in part]
    ours, theirs = BatchedVecEnv(*(batch(*part, limit=5) for part in batches)), DummyVecEnv(makers)
    ours.seed(4)
    theirs.seed(4)
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    for _ in range(20):
        actions = rng.uniform(-1.0, 1.0, (3, 2)).astype(np.float32)
        mine, reference = ours.step(actions), theirs.step(actions)
        for ours_part, their_part in zip(mine[:3], reference[:3], strict=True):
            np.testing.assert_array_equal(ours_part, their_part)
            assert ours_part.dtype == their_part.dtype  # type: ignore[union-attr]
        for row in np.flatnonzero(mine[2]):
            assert mine[3][row].keys() == reference[3][row].keys()
            np.testing.assert_array_equal(
                mine[3][row]["terminal_observation"], reference[3][row]["terminal_observation"]
            )
            truncated = "TimeLimit.truncated"
            assert mine[3][row][truncated] == reference[3][row][truncated]
            assert mine[3][row]["measure"] == pytest.approx(
                mine[3][row]["terminal_observation"][0]
            )  # of the episode that ended
            assert ours.reset_infos[row]["scenario"]["start"] == pytest.approx(mine[0][row, 0])
        assert all(mine[3][row] == {} for row in np.flatnonzero(~mine[2]))
    first = ours.reset()
    ours.seed(4)
    again = ours.reset()
    ours.seed(4)
    assert not np.array_equal(first, again)
    np.testing.assert_array_equal(ours.reset(), again)


def test_attributes_and_methods_are_those_of_the_batch() -> None:
    env = BatchedVecEnv(batch(9, 9, 9))
    env.reset()
    assert env.get_attr("num_envs", indices=[0, 2]) == [3, 3]
    assert not env.has_attr("no_such_attribute")
    env.set_attr("note", 5)
    assert env.get_attr("note") == [5, 5, 5]
    assert [len(images) for images in env.env_method("render")] == [3, 3, 3]
    assert env.env_is_wrapped(Monitor, indices=0) == [False]
    with pytest.raises(ValueError, match="'note' for all 3 environments"):
        env.set_attr("note", 6, indices=[1])
    with pytest.raises(ValueError, match="share one batched simulation"):
        env.env_method("render", indices=0)
    with pytest.raises(ValueError, match="same-step autoreset"):
        BatchedVecEnv(batch(3, mode=AutoresetMode.NEXT_STEP))


# --- our environments --------------------------------------------------------------------------


def test_reset_options_reach_our_environments() -> None:
    env = sb3_vec_env("rare_envs/CutIn-v0", 2)
    env.set_options([{"cut_in_gap": 9.0}, {"cut_in_gap": 12.0}])
    env.reset()
    inner: Any = env.unwrapped
    gaps = [info["scenario"]["cut_in_gap"] for info in inner.reset_infos]
    assert gaps == pytest.approx([9.0, 12.0])


def test_scenarios_side_by_side_have_one_observation() -> None:
    """A vehicle that is not there is ahead as far as features tell, and as fast as the ego."""
    env = sb3_vec_env((FOLLOWING, CUT_IN), 5, seed=0)
    observation = env.reset()
    assert observation.shape == (5, 11)
    assert observation[:3, 7:].tolist() == [[5.0, 0.0, 0.0, 0.0]] * 3
    assert (observation[3:, 7] < 5.0).all()
    actions = np.tile(np.array([0.3, 0.0], np.float32), (5, 1))
    moved = env.step(actions)[0]
    alone = [sb3_vec_env(each, size, seed=seed) for each, size, seed in ((FOLLOWING, 3, 0), (CUT_IN, 2, 3))]
    np.testing.assert_array_equal(observation, np.concatenate([one.reset() for one in alone]))
    np.testing.assert_array_equal(moved, np.concatenate([one.step(actions[: one.num_envs])[0] for one in alone]))
    space = env.get_attr("space", indices=4)[0]
    assert "cut_in_gap" in space.names
    env.set_attr("space", space, indices=[3, 4])
    with pytest.raises(ValueError, match="one single_observation_space"):
        sb3_vec_env((CUT_IN, "rare_envs/Highway-v0"), 2)


def test_rewards_are_scaled_and_recorded_as_they_are() -> None:
    plain, scaled = (sb3_vec_env(FOLLOWING, 2, seed=0, horizon=0.3, reward_scale=scale) for scale in (1.0, 0.02))
    np.testing.assert_array_equal(plain.reset(), scaled.reset())
    for _ in range(3):
        ours, theirs = (env.step(np.zeros((2, 2), np.float32)) for env in (plain, scaled))
        np.testing.assert_allclose(theirs[1], 0.02 * ours[1], rtol=1e-6)
    assert theirs[2].all()
    for mine, other in zip(ours[3], theirs[3], strict=True):
        assert mine["episode"]["r"] == other["episode"]["r"] > 0.0


@pytest.mark.parametrize("beside", [{}, {"observation": "camera", "camera": (36, 60), "weather": True}])
def test_strata_are_drawn_evenly_where_asked_for(beside: dict[str, Any]) -> None:
    """Cutters who look and who do not are half of the draws each: a binomial count, to 5 deviations."""
    whole = sb3_vec_env("rare_envs/CutIn-v1", 1, even_strata=True, **beside).get_attr("space")[0].base
    base = getattr(whole, "blocks", (whole,))[0]
    looked = whole.sample(4_000, np.random.default_rng(0))[:, base.column] > base.limits[0]
    assert looked.mean() == pytest.approx(0.5, abs=5 * 0.5 / 4_000**0.5)


# --- several agents ---------------------------------------------------------------------------


@pytest.mark.parametrize("settings", [{}, {"observation": "camera", "camera": (36, 60)}])
def test_rows_are_the_agents_of_the_parallel_environment(settings):
    """The same scenarios and actions give the same observations, rewards and ends, row by row, to the last bit."""
    batch = AgentsVectorEnv(CUT_IN, 3, horizon=2.0, drivers="idm", **settings)
    batch.action_space.seed(0)
    batch.reset(seed=0)
    several = [rare_envs.parallel_env(CUT_IN, horizon=2.0, drivers="idm", **settings) for _ in range(3)]
    names, n = several[0].possible_agents, len(several[0].possible_agents)
    for env, row in zip(several, batch._x.copy(), strict=True):
        env.reset(options={"x": row})
    running = {0, 1, 2}
    for _ in range(30):
        actions = batch.action_space.sample()
        observation, reward, terminated, truncated, infos = batch.step(actions)
        over = terminated | truncated
        for b in sorted(running):
            rows = slice(b * n, b * n + n)
            seen, earned, ended, cut, info = several[b].step(dict(zip(names, actions[rows], strict=True)))
            last = infos["final_obs"] if over[rows].any() else observation
            for row, agent in enumerate(names, start=b * n):
                np.testing.assert_array_equal(last[row], seen[agent])
                assert reward[row] == pytest.approx(earned[agent], rel=1e-6)
                if over[rows].any():  # a scenario ends for all its agents
                    assert over[row] and terminated[row] == (ended[agent] or ended["ego"])
                    assert infos["final_info"]["collision"][row] == ended[agent]
                    if ended[agent] or cut[agent]:
                        assert infos["final_info"]["measure"][row] == info[agent]["measure"]
            running -= {b} if over[rows].any() else set()
    assert not running


def test_bad_arguments():
    for n, settings, message in (
        (4, {"agents": ["leed"]}, "vehicle 'leed'"),
        (0, {}, "one or more scenarios"),
        (4, {"agents": ["lead"], "rewards": {"ego": adversary_reward}}, "agent of a reward 'ego'"),
    ):
        with pytest.raises(ValueError, match=message):
            training.sb3_agents_env(CUT_IN, n, **settings)

    class Recurrent:
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.zeros((len(observation), 2)), (np.zeros(3),)

    env = training.sb3_agents_env(CUT_IN, 4, agents=["lead"], ego=Recurrent())
    env.reset()
    with pytest.raises(ValueError, match="ego without memory"):
        env.step(np.zeros((4, 2)))


@pytest.mark.slow
@use_one_thread()
def test_an_adversary_raises_the_collision_rate():
    """Starts side by side, so that little training is enough; docs/environments.md has ordinary ones."""
    low, high = np.array([14.0, 14.0, 14.0, 1.0, 30.0, 3.0]), np.array([16.0, 16.0, 16.0, 4.0, 50.0, 4.0])
    near = {"base": BetaDistribution(np.full(6, 2.0), np.full(6, 2.0), low, high), "horizon": 5.0}
    n = 400
    model = adversary.train(CUT_IN, "cutter", 16_000, num_scenarios=32, n_steps=50, batch_size=400, **near)
    scripted = adversary.collisions(CUT_IN, {}, n, seed=1, **near)
    attacked = adversary.collisions(CUT_IN, {"cutter": model}, n, seed=1, **near)
    # the counts are binomial: a difference of 5 standard deviations, none of which is beyond sqrt(n / 4)
    assert attacked - scripted > 5 * (2 * n / 4) ** 0.5
    assert adversary.interval(attacked, n)[0] > adversary.interval(scripted, n)[1]


@pytest.mark.slow
@use_one_thread()
def test_a_shared_policy_learns():
    before, after = (
        shared_policy.mean_return(FOLLOWING, shared_policy.train(FOLLOWING, steps), 512, seed=1)
        for steps in (0, 25_600)
    )
    error = (before[1] ** 2 + after[1] ** 2) ** 0.5
    assert after[0] - before[0] > 5 * error
