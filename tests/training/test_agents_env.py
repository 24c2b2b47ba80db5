"""One Stable-Baselines3 policy in several vehicles, and an adversary in one."""

import numpy as np
import pytest
from stable_baselines3.common.vec_env import VecEnv

import rare_envs
import training
from examples import adversary, shared_policy
from rare_envs.distributions.beta import BetaDistribution
from rare_envs.envs.multi_agent_vector import AgentsVectorEnv
from rare_envs.multi_agent import adversary_reward
from rare_envs.threads import use_one_thread

CUT_IN = "rare_envs/CutIn-v0"
FOLLOWING = "rare_envs/CarFollowing-v0"


@pytest.mark.parametrize("env_id", rare_envs.ENV_IDS)
@pytest.mark.parametrize("kwargs", [{}, {"observation": "kinematics", "action": "meta"}], ids=["continuous", "meta"])
def test_rows_are_the_agents_of_the_parallel_environment(env_id, kwargs):
    """The same scenarios and actions give the same observations, rewards and ends, row by row, to the last bit."""
    batch = AgentsVectorEnv(env_id, 3, horizon=2.0, drivers="idm", **kwargs)
    batch.action_space.seed(0)
    observation, _ = batch.reset(seed=0)
    several = [rare_envs.parallel_env(env_id, horizon=2.0, drivers="idm", **kwargs) for _ in range(3)]
    names, n = several[0].possible_agents, len(several[0].possible_agents)
    x = batch._x.copy()
    for env, row in zip(several, x, strict=True):
        env.reset(options={"x": row})
    running = [True] * 3
    for _ in range(30):
        actions = batch.action_space.sample()
        observation, reward, terminated, truncated, infos = batch.step(actions)
        for b in (b for b in range(3) if running[b]):
            rows = slice(b * n, b * n + n)
            seen, earned, ended, cut, info = several[b].step(dict(zip(names, actions[rows], strict=True)))
            last = infos["final_obs"] if (terminated | truncated)[rows].any() else observation
            for row, agent in enumerate(names, start=b * n):
                np.testing.assert_array_equal(last[row], seen[agent])
                assert reward[row] == pytest.approx(earned[agent], rel=1e-6)
            running[b] = not (terminated | truncated)[rows].any()
            if not running[b]:
                assert (terminated | truncated)[rows].all()  # a scenario ends for all its agents
                for row, agent in enumerate(names, start=b * n):
                    assert terminated[row] == (ended[agent] or ended["ego"])
                    assert infos["final_info"]["collision"][row] == ended[agent]
                    if ended[agent] or cut[agent]:
                        assert infos["final_info"]["measure"][row] == info[agent]["measure"]
    assert not any(running)


def test_new_scenarios_follow_those_that_ended():
    env = training.sb3_agents_env(CUT_IN, 8, agents=["ego", "lead"], horizon=1.0, seed=0)
    assert isinstance(env, VecEnv)
    assert env.num_envs == 16
    env.reset()
    ended = 0
    for _ in range(25):
        observation, _, dones, infos = env.step(np.zeros((16, 2), np.float32))
        assert np.isfinite(observation).all()
        for row in np.flatnonzero(dones):
            assert infos[row]["TimeLimit.truncated"] != infos[row]["collision"]
            assert infos[row]["terminal_observation"].shape == observation[row].shape
            ended += 1
    assert ended == 2 * 16


def test_same_seed_same_training_data():
    runs = []
    for _ in range(2):
        env = AgentsVectorEnv(CUT_IN, 4, horizon=2.0)
        rows = [env.reset(seed=3)[0]]
        env.action_space.seed(0)
        rows += [env.step(env.action_space.sample())[0] for _ in range(45)]
        runs.append(np.array(rows))
    np.testing.assert_array_equal(*runs)


def test_bad_arguments():
    with pytest.raises(ValueError, match="no vehicle 'leed'"):
        training.sb3_agents_env(CUT_IN, 4, agents=["leed"])
    with pytest.raises(ValueError, match="one or more scenarios"):
        training.sb3_agents_env(CUT_IN, 0)
    with pytest.raises(ValueError, match="Reward for 'ego'"):
        training.sb3_agents_env(CUT_IN, 4, agents=["lead"], rewards={"ego": adversary_reward})

    class Recurrent:
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.zeros((len(observation), 2)), (np.zeros(3),)

    env = training.sb3_agents_env(CUT_IN, 4, agents=["lead"], ego=Recurrent())
    env.reset()
    with pytest.raises(ValueError, match="ego without memory"):
        env.step(np.zeros((4, 2)))


@use_one_thread()
def test_an_adversary_raises_the_collision_rate():
    """Starts side by side, so that little training is enough; from ordinary starts docs/agents.md has the numbers."""
    low, high = np.array([14.0, 14.0, 14.0, 1.0, 30.0, 3.0]), np.array([16.0, 16.0, 16.0, 4.0, 50.0, 4.0])
    near = {"base": BetaDistribution(np.full(6, 2.0), np.full(6, 2.0), low, high), "horizon": 5.0}
    n = 400
    model = adversary.train(CUT_IN, "cutter", 16_000, num_scenarios=32, n_steps=50, batch_size=400, **near)
    scripted = adversary.collisions(CUT_IN, {}, n, seed=1, **near)
    attacked = adversary.collisions(CUT_IN, {"cutter": model}, n, seed=1, **near)
    # the counts are binomial: a difference of 5 standard deviations, none of which is beyond sqrt(n / 4)
    assert attacked - scripted > 5 * (2 * n / 4) ** 0.5
    assert adversary.interval(attacked, n)[0] > adversary.interval(scripted, n)[1]


@use_one_thread()
def test_a_shared_policy_learns():
    before, after = (
        shared_policy.mean_return(FOLLOWING, shared_policy.train(FOLLOWING, steps), 512, seed=1)
        for steps in (0, 25_600)
    )
    error = (before[1] ** 2 + after[1] ** 2) ** 0.5
    assert after[0] - before[0] > 5 * error


def test_an_interval_by_hand():
    low, high = adversary.interval(0, 100)
    assert (low, high) == (0.0, pytest.approx(1 - 0.025 ** (1 / 100)))  # the rule of three and a little
    assert adversary.interval(100, 100) == (pytest.approx(0.025 ** (1 / 100)), 1.0)
