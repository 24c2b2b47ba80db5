"""Several agents: PettingZoo's conformance, agreement with the environment of one, crashes, and bad input."""

import warnings
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from pettingzoo.utils import parallel_to_aec

import rare_envs
from rare_envs.multi_agent import own_reward

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # PettingZoo's test module imports what PettingZoo has deprecated
    from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, render_test, seed_test, state_test

every = pytest.mark.parametrize("env_id", rare_envs.ENV_IDS)
CUT_IN = "rare_envs/CutIn-v0"
FOLLOWING = "rare_envs/CarFollowing-v0"


@every
def test_pettingzoo_api(env_id):
    parallel_api_test(rare_envs.parallel_env(env_id, horizon=1.0), num_cycles=25)


@every
def test_pettingzoo_seeds(env_id):
    parallel_seed_test(partial(rare_envs.parallel_env, env_id, horizon=1.0), num_cycles=12)


@every
@pytest.mark.filterwarnings("ignore:We recommend agents to be named")
# positions may be negative; PettingZoo takes a table of numbers for a picture
@pytest.mark.filterwarnings("ignore:The state contains negative numbers")
def test_pettingzoo_agents_in_turn(env_id):
    """Its conformance tests of environments in which one agent acts after the other, and of the state."""
    make = partial(rare_envs.env, env_id, horizon=1.0)
    api_test(make(), num_cycles=12)
    seed_test(make, num_cycles=6)
    state_test(make(), rare_envs.parallel_env(env_id, horizon=1.0), num_cycles=6)
    raw = rare_envs.raw_env(env_id, agents=["ego"], observation="kinematics", action="meta")
    raw.reset(seed=1)
    assert raw.last()[0].shape == (5, 5) and raw.possible_agents == ["ego"]
    with pytest.raises(AssertionError, match="needs to be called before step"):
        make().step(0)


@every
def test_pettingzoo_render(env_id, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    render_test(lambda render_mode: parallel_to_aec(rare_envs.parallel_env(env_id, render_mode=render_mode)))


@pytest.mark.parametrize(
    ("env_id", "agents"), [(CUT_IN, ["ego"]), pytest.param("rare_envs/Highway-v0", None, marks=pytest.mark.slow)]
)
def test_an_ego_alone_has_exactly_the_environment_of_one(env_id, agents):
    """To the last bit, until the ego's end: whether the others may not act or do not."""
    for kwargs in (
        {"horizon": 2.0},
        {"horizon": 1.0, "observation": "lidar", "drivers": "mgail"},
        {"horizon": 3.0, "observation": "kinematics", "action": "meta"},
    ):
        one = gym.make(env_id, core="torch", **kwargs)  # the compiled core rounds otherwise
        several = rare_envs.parallel_env(env_id, agents=agents, **kwargs)
        rng = np.random.default_rng(0)
        for seed in range(2):
            observation, info = one.reset(seed=seed)
            observations, infos = several.reset(seed=seed)
            assert data_equivalence((observation, info), (observations["ego"], infos["ego"]), exact=True)
            done = False
            while not done:
                action = rng.uniform((-1.0, -0.2), (1.0, 0.2)).astype(np.float32)
                if "action" in kwargs:
                    action = int(rng.integers(5))
                expected = one.step(action)
                got = several.step({"ego": action})
                assert data_equivalence(expected, tuple(each["ego"] for each in got), exact=True)
                done = expected[2] or expected[3]
            assert "ego" not in several.agents


def test_who_crashes_leaves_and_the_others_drive_on():
    env = rare_envs.parallel_env(CUT_IN)
    env.reset(options={"x": [20.0, 20.0, 20.0, 5.0, 60.0, 4.0]})
    full, coast = np.array([1.0, 0.0], np.float32), np.zeros(2, np.float32)
    # the cutter stays in its lane: the ego passes it and runs into the lead, which brakes
    while {"ego", "lead"} <= set(env.agents):
        actions = {"ego": full, "cutter": coast, "lead": -full}
        _, rewards, terminated, truncated, infos = env.step(actions)
    assert terminated == {"ego": True, "cutter": False, "lead": True}
    assert not any(truncated.values())
    assert env.agents == ["cutter"]
    assert [infos[agent]["collision_type"] for agent in ("ego", "lead")] == ["rear_end", "rear_ended"]
    assert infos["ego"]["crash"]["vehicles"] == infos["lead"]["crash"]["vehicles"] == [0, 2]  # the ego runs into it
    assert rewards["ego"] < -20
    assert rewards["lead"] < -20
    assert rewards["cutter"] > 0
    speed = env.state()[:, 3]
    after, *_ = env.step({"cutter": coast})
    assert set(after) == {"cutter"}
    np.testing.assert_allclose(env.state()[:, 3], speed * [0.9, 1.0, 0.9], rtol=1e-5)  # wrecks lose a tenth per tick
    with pytest.raises(ValueError, match="Expected actions of cutter only: 'ego' has left"):
        env.step({"ego": full})
    while env.agents:
        *_, truncated, infos = env.step({"cutter": coast})
    assert truncated == {"cutter": True}
    assert infos["cutter"]["measure"] > 0
    with pytest.raises(RuntimeError, match="no agent"):
        env.step({})


def test_a_vehicle_off_the_road_is_its_own_collision():
    env = rare_envs.parallel_env(FOLLOWING)
    env.reset(options={"x": [20.0, 20.0, 60.0]})
    while "lead" in env.agents:
        *_, infos = env.step({"lead": np.array([0.0, 1.0])})
    assert infos["lead"]["collision_type"] == "road_edge"
    assert not infos["ego"]["collision"]
    assert env.agents == ["ego"]


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"agents": ["cuter"]}, r"no vehicle 'cuter' \(did you mean 'cutter'\?\); the vehicles are ego, cutter, lead"),
        ({"agents": "ego"}, "agents as a list of names"),
        ({"agents": []}, "one or more different agents"),
        ({"agents": ["ego", "ego"]}, "one or more different agents"),
        ({"rewards": {"leed": own_reward}}, r"Reward for 'leed' \(did you mean 'lead'"),
        ({"rewards": {"lead": 3}}, "reward of 'lead' as a function"),
        ({"render_mode": "ansi"}, "render_mode"),
        ({"observation": "feature"}, "Unknown observation"),
        ({"ego": "idn"}, "Unknown ego"),
        ({"rewards": len}, "rewards as a mapping"),
    ],
)
def test_bad_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        rare_envs.parallel_env(CUT_IN, **kwargs)


def test_bad_actions_and_options():
    with pytest.raises(ValueError, match="did you mean 'rare_envs/CutIn-v0'"):
        rare_envs.parallel_env("rare_envs/CutInn-v0")
    env = rare_envs.parallel_env(CUT_IN, agents=["ego", "cutter"])
    with pytest.raises(RuntimeError, match="reset"):
        env.step({})
    with pytest.raises(ValueError, match="did you mean 'cut_in_gap'"):
        env.reset(options={"cut_in_gab": 9.0})
    env.reset(seed=0)
    for actions, message in (
        ({"eggo": np.zeros(2)}, r"no agent 'eggo' \(did you mean 'ego'\?\); the agents are ego, cutter"),
        ({"lead": np.zeros(2)}, "no agent 'lead'"),
        ({"cutter": np.zeros(3)}, r"shape \(2,\) for 'cutter', got \(3,\)"),
        ({"ego": np.array([np.nan, 0.0])}, "NaN"),
        ([np.zeros(2)], "actions as a mapping of agents to actions, got list"),
    ):
        with pytest.raises(ValueError, match=message):
            env.step(actions)
    observations, *_ = env.step({"ego": np.zeros(2), "cutter": None})
    assert set(observations) == {"ego", "cutter"}


@pytest.mark.parametrize("make", [rare_envs.parallel_env, rare_envs.env], ids=["parallel", "in turn"])
def test_the_state_lies_in_the_state_space(make):
    """As trainers with a central critic take it: every vehicle, also those that nobody commands."""
    world = make("rare_envs/CutIn-v1")
    world.reset(seed=1)
    state = world.state()
    assert world.state_space.contains(state)
    assert state.shape == (3, 4)
    world.reset(seed=2)
    assert (world.state() != state).any()
