"""Every environment x observation x action behind every wrapper, without a warning; and one seed, one trajectory."""

from itertools import product

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from gymnasium.utils.env_checker import check_env, data_equivalence
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import rare_envs
from rare_envs.control.actions import ACTIONS
from rare_envs.simulation.observation import OBSERVATIONS
from rare_envs.simulation.world import drive

KINDS = [kind for kind in OBSERVATIONS if kind != "camera"]
"""Images have a suite of their own: they are slow, and not every wrapper is for them."""
every = pytest.mark.parametrize("env_id", rare_envs.ENV_IDS)
each_kind = pytest.mark.parametrize(
    ("observation", "action"),
    [
        pytest.param(kind, action, marks=[] if kind == KINDS[0] or action == next(iter(ACTIONS)) else pytest.mark.slow)
        for kind, action in product(KINDS, ACTIONS)
    ],
)
WRAPPERS = {
    "TimeLimit": lambda env: wrappers.TimeLimit(env, 3),
    "RecordEpisodeStatistics": wrappers.RecordEpisodeStatistics,
    "FlattenObservation": wrappers.FlattenObservation,
    "FrameStackObservation": lambda env: wrappers.FrameStackObservation(env, 3),
    "NormalizeObservation": wrappers.NormalizeObservation,
    "NormalizeReward": wrappers.NormalizeReward,
    "Autoreset": wrappers.Autoreset,
}
VECTOR_WRAPPERS = {
    "RecordEpisodeStatistics": wrappers.vector.RecordEpisodeStatistics,
    "NormalizeReward": wrappers.vector.NormalizeReward,
    "ClipReward": lambda batch: wrappers.vector.ClipReward(batch, -1.0, 1.0),
    "DictInfoToList": wrappers.vector.DictInfoToList,
}


def episode_of(action):
    """Return the duration of a short episode [s]: five ticks, or one decision."""
    return 1.0 if action == "meta" else 0.5


@every
@each_kind
# kinematics has no bounds, like HighwayEnv's, of which the checker warns
@pytest.mark.filterwarnings("ignore:.*A Box observation space .*imum value is -?infinity")
def test_checkers(env_id, observation, action):
    env = gym.make(env_id, observation=observation, action=action, horizon=2.0)
    check_env(env.unwrapped, skip_render_check=True)
    sb3_check_env(env if observation != "kinematics" else wrappers.FlattenObservation(env))  # it wants one axis


@every
@each_kind
def test_behind_every_wrapper(env_id, observation, action):
    """An episode or two behind each: observations are in the space that the wrapper says, and episodes end."""
    inner = gym.make(env_id, observation=observation, action=action, horizon=episode_of(action)).unwrapped
    for name, wrap in WRAPPERS.items():
        env = wrap(inner)
        env.action_space.seed(0)
        seen, _ = env.reset(seed=0)
        assert seen in env.observation_space, name
        ended = False
        for _ in range(12):
            seen, _, terminated, truncated, info = env.step(env.action_space.sample())
            assert seen in env.observation_space, name
            if terminated or truncated:
                ended = True
                assert name != "RecordEpisodeStatistics" or info["episode"]["l"] > 0
                break
        assert ended, name


@every
@each_kind
def test_batches_behind_every_vector_wrapper(env_id, observation, action):
    for name, wrap in VECTOR_WRAPPERS.items():
        batch = gym.make_vec(env_id, num_envs=3, observation=observation, action=action, horizon=episode_of(action))
        batch = wrap(batch)
        batch.action_space.seed(0)
        seen, _ = batch.reset(seed=0)
        assert seen in batch.observation_space, name
        ended = 0
        for _ in range(2 if action == "meta" else 6):  # one decision, or half a second of ticks
            seen, reward, terminated, truncated, _ = batch.step(batch.action_space.sample())
            assert seen in batch.observation_space, name
            assert np.isfinite(reward).all(), name
            ended += int((terminated | truncated).sum())
        assert ended >= 3, name


@pytest.mark.parametrize(
    ("kwargs", "steps"), [({}, 100), ({"horizon": 20.0}, 200), ({"action": "meta"}, 10), ({"max_episode_steps": 5}, 5)]
)
def test_the_length_of_an_episode_is_in_the_spec(kwargs, steps):
    """So what Gymnasium makes of it, as one or as a batch, again from the spec too, ends then."""
    one, batch = (make("rare_envs/CarFollowing-v0", **kwargs) for make in (gym.make, gym.make_vec))
    assert (one.spec.max_episode_steps, batch.spec.max_episode_steps) == (steps, steps)
    one, batch = wrappers.TimeAwareObservation(gym.make(one.spec)), gym.make_vec(batch.spec)
    x = [20.0, 20.0, 100.0]
    one.reset(options={"x": x})
    batch.reset(options={"x": x})
    ends = []
    for _ in range(steps):
        ends.append((one.step(one.action_space.sample() * 0)[3], bool(batch.step(batch.action_space.sample() * 0)[3])))
    assert ends == [(False, False)] * (steps - 1) + [(True, True)]


class Recorded:
    """An ego with a fixed sequence of actions, whatever it sees."""

    def __init__(self, actions):
        self.actions = actions

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        tick = 0 if state is None else int(state[0][0])
        rows = np.repeat(self.actions[min(tick, len(self.actions) - 1)][None], len(observation), axis=0)
        return rows, (np.full(len(observation), tick + 1),)


TOLERANCE = 20 * 12 * np.finfo(np.float32).eps / 2
"""Of 20 ticks, each of which rounds every number about a dozen times: 1.4e-5 of its size."""


def first_of(stepped):
    """Return the step of a batch of one as that of one, with the last observation of an episode that has ended."""
    seen, reward, terminated, truncated, infos = stepped
    ended = terminated[0] or truncated[0]
    return (infos["final_obs"] if ended else seen)[0], reward[0], terminated[0], truncated[0]


def assert_close(step, expected):
    """Check observation and reward to `TOLERANCE`, and that the episode has ended or not."""
    np.testing.assert_allclose(step[0], expected[0], rtol=TOLERANCE, atol=TOLERANCE)
    np.testing.assert_allclose(step[1], expected[1], rtol=TOLERANCE, atol=TOLERANCE)
    assert tuple(step[2:4]) == tuple(expected[2:4])


@every
@pytest.mark.parametrize("action", ACTIONS)
def test_same_seed_same_trajectory_however_it_is_asked_for(env_id, action):
    """gym.make, make_vec, parallel_env and rollout; of one, because products of networks round by batch size.

    The same bits with the core that parallel_env steps by; with the default one to rounding.
    """
    kwargs = {"action": action, "observation": "kinematics", "horizon": 2.0}
    one, batch = (make(env_id, core="torch", **kwargs) for make in (gym.make, gym.make_vec))
    usual = gym.make(env_id, **kwargs), gym.make_vec(env_id, **kwargs)
    for env in usual:
        env.reset(seed=5)
    several = rare_envs.parallel_env(env_id, **kwargs)
    space = one.action_space
    space.seed(1)
    steps = [space.sample() for _ in range(20)]
    first, info = one.reset(seed=5)
    others, infos = batch.reset(seed=5)
    many, _ = several.reset(seed=5)
    np.testing.assert_array_equal(infos["x"][0], info["x"])
    np.testing.assert_array_equal(others[0], first)
    np.testing.assert_array_equal(many["ego"], first)
    states, taken, ended = [], [], False
    while not ended:
        chosen = steps[len(taken)]
        taken.append(chosen)
        expected = one.step(chosen)
        states.append(one.unwrapped._episode.state)
        seen, reward, terminated, truncated, final = batch.step(np.asarray([chosen]))
        ended = expected[2] or expected[3]
        assert_close(usual[0].step(chosen), expected)
        assert_close(first_of(usual[1].step(np.asarray([chosen]))), expected)
        seen = final["final_obs"][0] if ended else seen[0]
        np.testing.assert_array_equal(seen, expected[0])
        assert (reward[0], terminated[0], truncated[0]) == expected[1:4]
        parallel = tuple(each["ego"] for each in several.step({"ego": chosen}))
        assert data_equivalence(expected, parallel, exact=True)
    problem = rare_envs.DrivingProblem(env_id, ego=Recorded(np.asarray(taken)), **kwargs)
    x = torch.from_numpy(info["x"]).float()[None]
    with torch.inference_mode():
        moments = list(drive(problem.world, problem.driver, x))
    stride = problem.world.clock.stride
    for k, state in enumerate(states[:-1], start=1):  # a decision may end before its last tick
        for one_field, other in zip(state[:4], moments[k * stride].state[:4], strict=True):
            assert torch.equal(one_field, other)
    assert float(moments[-1].f) == expected[4]["measure"]
