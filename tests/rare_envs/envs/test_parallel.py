"""Several agents: PettingZoo's conformance, one beside several, crashes, rewards, batches of agents, and bad input."""

import warnings
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import data_equivalence
from pettingzoo.utils import parallel_to_aec

import rare_envs
import samplers
from agents.files import SHIPPED
from rare_envs.control.actions import IDLE
from rare_envs.control.idm import IDM
from rare_envs.envs.parallel import AgentsVectorEnv
from rare_envs.make import set_up
from rare_envs.multi_agent import adversary_reward, own_reward, play, start, step_agents, step_traffic
from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.simulation.settings import Clock
from rare_envs.simulation.world import World, rollout
from rare_envs.study import BadInput, Question, prepare

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # PettingZoo's test module imports what PettingZoo has deprecated
    from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, render_test, state_test

every = pytest.mark.parametrize("env_id", rare_envs.ENV_IDS)
CUT_IN = "rare_envs/CutIn-v0"
FOLLOWING = "rare_envs/CarFollowing-v0"


@every
def test_pettingzoo_api_and_seeds(env_id):
    make = partial(rare_envs.parallel_env, env_id, horizon=1.0)
    parallel_api_test(make(), num_cycles=25)
    parallel_seed_test(make, num_cycles=12)


@every
@pytest.mark.filterwarnings("ignore:We recommend agents to be named")
# positions may be negative; PettingZoo takes a table of numbers for a picture
@pytest.mark.filterwarnings("ignore:The state contains negative numbers")
def test_pettingzoo_agents_in_turn(env_id):
    """Its conformance tests of environments in which one agent acts after the other, and of the state."""
    make = lambda: parallel_to_aec(rare_envs.parallel_env(env_id, horizon=1.0))  # noqa: E731
    api_test(make(), num_cycles=12)
    state_test(make(), rare_envs.parallel_env(env_id, horizon=1.0), num_cycles=6)


@every
def test_pettingzoo_render(env_id, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    render_test(lambda render_mode: parallel_to_aec(rare_envs.parallel_env(env_id, render_mode=render_mode)))


@pytest.mark.parametrize(
    ("env_id", "agents"),
    [
        (CUT_IN, ["ego"]),
        ("rare_envs/CutIn-v1", None),
        pytest.param("rare_envs/Highway-v0", None, marks=pytest.mark.slow),
    ],
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
        observation, info = one.reset(seed=0)
        observations, infos = several.reset(seed=0)
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


def test_a_cutter_that_is_an_agent_goes_where_it_is_driven_and_keeps_off_once_it_is_released():
    """It is beside the ego: the script would turn back after 0.6 s, the agent goes straight in."""
    x = [20.0, 20.0, 20.0, -3.0, 60.0, 3.5, 4.0, *[0.0] * 6]
    alone, driven = (rare_envs.parallel_env("rare_envs/CutIn-v1", agents=["cutter"]) for _ in range(2))
    for env in (alone, driven):
        env.reset(options={"x": x})
    steer = np.array([0.0, -0.3], np.float32)
    for tick in range(12):
        alone.step({})
        driven.step({"cutter": steer if tick < 5 else -steer})
    assert alone.state()[1, 1] == 3.5 and alone.state()[2, 1] == 0.0
    assert driven.state()[1, 1] < 3.0 < driven.state()[1, 0]
    for _ in range(60):
        driven.step({})
    assert driven.state()[1, 1] == pytest.approx(4.0, abs=0.1)  # it keeps the lane that it was in, by IDM


@pytest.mark.parametrize("commanded", [False, True])
def test_a_cutter_that_is_commanded_neither_signals_nor_evades(commanded: bool) -> None:
    """It has not looked, and its script turns back beside the ego; whoever drives it keeps off by another way."""
    env = rare_envs.parallel_env("rare_envs/CutIn-v1", agents=["ego", "cutter"], measure="near_crash")
    env.reset(options={"x": [20.0, 20.0, 20.0, -3.0, 60.0, 2.9, 4.0, -9.0, *[0.0] * 5]})
    for _ in range(10):
        env.step({"cutter": np.zeros(2, np.float32)} if commanded else {})
    signals = env.world.find_signals(env._episode.traffic)
    assert signals is not None and signals.tolist() == [[not commanded, False]]
    assert [view.f.item() <= 0.0 for view in env._episode.views[:2]] == [not commanded] * 2


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
    assert set(env.step({"ego": full, "cutter": coast})[0]) == {"cutter"}  # a wreck's action does not count
    while env.agents:
        *_, truncated, infos = env.step({"cutter": coast})
    assert truncated == {"cutter": True}
    assert infos["cutter"]["measure"] > 0
    assert env.step({}) == env.step({"cutter": coast}) == ({}, {}, {}, {}, {})  # as PettingZoo's own environments


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"agents": ["cuter"]}, r"'cuter' \(did you mean 'cutter'\?\); expected one of 'ego', 'cutter', 'lead'"),
        ({"agents": "ego"}, "agents as a list of names"),
        ({"agents": []}, "one or more different agents"),
        ({"agents": ["ego", "ego"]}, "one or more different agents"),
        ({"rewards": {"leed": own_reward}}, r"agent of a reward 'leed' \(did you mean 'lead'"),
        ({"rewards": {"lead": 3}}, "rewards as a mapping of agents to functions"),
        ({"ego": "idn"}, "Unknown ego"),
    ],
)
def test_bad_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        rare_envs.parallel_env(CUT_IN, **kwargs)


def test_bad_actions_and_options():
    for wrong in (0, 2.5, True, "3"):
        with pytest.raises(ValueError, match="one or more scenarios"):
            AgentsVectorEnv(CUT_IN, wrong)  # type: ignore[arg-type]
    env = rare_envs.parallel_env(CUT_IN, agents=["ego", "cutter"])
    with pytest.raises(RuntimeError, match="reset"):
        env.step({})
    env.reset(seed=0)
    for actions, message in (
        ({"eggo": np.zeros(2)}, r"agent 'eggo' \(did you mean 'ego'\?\); expected one of 'ego', 'cutter'"),
        ({"lead": np.zeros(2)}, "Unknown agent 'lead'"),
        ({"cutter": np.zeros(3)}, r"shape \(2,\) for 'cutter', got \(3,\)"),
        ({"ego": np.array([np.nan, 0.0])}, "NaN"),
        ([np.zeros(2)], "actions as a mapping of agents to actions, got list"),
    ):
        with pytest.raises(ValueError, match=message):
            env.step(actions)
    observations, *_ = env.step({"ego": np.zeros(2), "cutter": None})
    assert set(observations) == {"ego", "cutter"}


def test_a_row_of_a_batch_is_the_episode_alone():
    world, space = set_up(CUT_IN, horizon=5.0)
    x = torch.from_numpy(space.sample(32, np.random.default_rng(0))).float()
    rng = torch.Generator().manual_seed(0)
    action = torch.rand(50, 32, 3, 2, generator=rng) * torch.tensor([8.0, 0.04]) - torch.tensor([4.0, 0.02])
    commanded = torch.rand(50, 32, 3, generator=rng) < 0.5
    together = start(world, x)
    alone = [start(world, x[k : k + 1]) for k in range(2)]
    for t in range(50):
        together = step_traffic(world, together, action[t], commanded[t])
        for k in range(2):
            alone[k] = step_traffic(world, alone[k], action[t, k : k + 1], commanded[t, k : k + 1])
            for view, own in zip(together.views, alone[k].views, strict=True):
                assert torch.equal(view.f[k], own.f[0])
                assert torch.equal(view.state.x[k], own.state.x[0])
            assert torch.equal(together.disabled[k], alone[k].disabled[0])
    assert together.disabled.any()
    assert not together.disabled.all()


def test_the_adversarys_reward_by_hand():
    env = rare_envs.parallel_env(FOLLOWING, agents=["lead"], rewards={"lead": adversary_reward})
    env.reset(options={"x": [20.0, 15.0, 14.5]})
    *_, infos = env.step({"lead": np.array([-1.0, 0.0])})
    terms = infos["lead"]["reward_terms"]
    speed = float(env.state()[0, 3])  # of the ego, which IDM brakes
    assert terms["danger"] == pytest.approx(1.0 - 14.0 / (speed - 14.5) / 4.0, abs=1e-5)
    assert terms["comfort"] == pytest.approx(-0.1)
    assert (terms["collision"], terms["fault"]) == (0.0, 0.0)
    env.reset(options={"x": [20.0, 15.0, 2.0]})
    while env.agents:
        *_, infos = env.step({"lead": np.array([-1.0, 0.0])})
    assert (infos["lead"]["reward_terms"]["collision"], infos["lead"]["reward_terms"]["fault"]) == (30.0, 0.0)
    env.reset(options={"x": [20.0, 20.0, 100.0]})
    while env.agents:
        *_, infos = env.step({"lead": np.array([0.0, 1.0])})
    assert infos["lead"]["collision_type"] == "road_edge"
    assert (infos["lead"]["reward_terms"]["collision"], infos["lead"]["reward_terms"]["fault"]) == (0.0, -30.0)


X = torch.tensor([[20.0, 10.0, 80.0], [20.0, 10.0, 3.5]])


def test_where_the_ego_is_not_commanded_its_driver_drives() -> None:
    world = World(CAR_FOLLOWING, clock=Clock(horizon=3.0))
    end, alone = play(world, X, {}, IDM()), rollout(world, IDM(), X)
    assert torch.equal(end.views[0].f, alone.f)
    running = ~alone.collided
    assert torch.equal(end.traffic.state.x[running], alone.state.x[running])


@pytest.mark.parametrize("given", [torch.ones(2), torch.ones(()), 1.0, 1, np.float64(1.0)])
def test_a_reward_may_be_a_tensor_or_a_number(given: Any) -> None:
    """Its mean over the ten ticks of a meta-action; ticks after the agent's collision count as 0."""
    world = World(CAR_FOLLOWING, clock=Clock(horizon=1.0, action="meta"))
    action, commanded = torch.full((2, 2), IDLE), torch.tensor([[True, False]]).expand(2, 2)
    _, earned, _ = step_agents(world, start(world, X), action, commanded, {0: lambda transition: given}, IDM())
    torch.testing.assert_close(earned[0], torch.tensor([1.0, 0.4]))  # 3.5 m at 10 m/s: four ticks


class Two(NamedTuple):
    gap: Any
    bonus: Any


@pytest.mark.parametrize("action", ["continuous", "meta"])
def test_terms_of_a_reward_may_be_numbers_and_what_is_neither_is_refused(action: str) -> None:
    for given, right in ((Two(torch.full((1,), 2.0), 0.5), True), (torch.zeros(3, 1), False), ("much", False)):
        rewards = {"lead": lambda transition, given=given: given}
        env = rare_envs.parallel_env(FOLLOWING, agents=["lead"], rewards=rewards, action=action)
        env.reset(seed=0)
        act = {"lead": np.zeros(2) if action == "continuous" else IDLE}
        if right:
            _, reward, *_, infos = env.step(act)
            assert (reward["lead"], infos["lead"]["reward_terms"]) == (2.5, {"gap": 2.0, "bonus": 0.5})
        else:
            with pytest.raises(ValueError, match=r"Expected a finite reward of shape \(1,\), a number, or"):
                env.step(act)


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


class Swerving:
    """An adversary in the cutter's place: it brakes a little, and steers into the ego's way."""

    def predict(self, observation: Any, state: Any = None, **_: Any) -> Any:
        steering = (2.0 * observation[:, 5] - 0.5 * observation[:, 2]).clip(-1, 1)
        return np.stack([np.full_like(steering, -0.1), steering], axis=1), None


@pytest.mark.parametrize("env_id", ["rare_envs/CutIn-v0", "rare_envs/CutIn-v1"])
def test_a_policy_in_traffic_drives_as_an_agent_does(env_id: str) -> None:
    adversary, coasting = Swerving(), lambda seen: np.zeros((len(seen), 2))
    problem = rare_envs.DrivingProblem(env_id, ego=coasting, drivers={"cutter": adversary}, horizon=4.0)
    x = problem.base.sample(400, np.random.default_rng(0))
    f, env = problem.evaluate(x), rare_envs.parallel_env(env_id, agents=["ego", "cutter"], horizon=4.0)
    for row in (*np.flatnonzero(f <= 0)[:2], *np.flatnonzero(f > 0)[:2]):
        seen, infos = env.reset(options={"x": x[row]})
        while "ego" in env.agents:
            others = {"cutter": adversary.predict(seen["cutter"][None])[0][0]} if "cutter" in seen else {}
            seen, _, _, _, infos = env.step({"ego": np.zeros(2), **others})
        assert infos["ego"]["measure"] == pytest.approx(f[row], abs=1e-4)
    result, share = samplers.estimate(problem, samplers.MonteCarlo(), max_sim=400, seed=1), np.mean(f <= 0)
    assert result.given == "Swerving drives the cutter"
    assert result.p == pytest.approx(share, abs=4.0 * np.sqrt(2 * share * (1 - share) / 400))


def test_what_cannot_drive_a_vehicle_of_the_traffic_is_refused() -> None:
    for drivers, said in (
        ({"cuter": Swerving()}, r"^Unknown vehicle of the traffic 'cuter' \(did you mean 'cutter'\?\)"),
        ({"ego": Swerving()}, "^Unknown vehicle of the traffic 'ego'; expected one of 'cutter', 'lead'"),
        ({"cutter": "idm"}, "^Expected a policy with predict, or its file, to drive the cutter, got idm"),
        ("cutter=a.zip,cutter=b.zip", "^Expected one driver for each vehicle, got cutter=a.zip,cutter=b.zip"),
        ("mgale", "^Unknown drivers 'mgale' .*'VEHICLE=POLICY.zip'"),
    ):
        with pytest.raises(ValueError, match=said):
            rare_envs.DrivingProblem("rare_envs/CutIn-v0", drivers=drivers)
    with pytest.raises(ValueError, match=r"^Expected drivers of all vehicles here: .* as agents, by step\(\)"):
        rare_envs.parallel_env("cut_in", drivers={"cutter": Swerving()})


def test_a_path_of_drivers_may_look_like_the_name_of_a_vehicle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = Path("seed=0", "driver.safetensors")
    path.parent.mkdir()
    path.write_bytes((SHIPPED / "gail.safetensors").read_bytes())
    found, named = (rare_envs.DrivingProblem(CUT_IN, drivers=drivers) for drivers in (str(path), "gail"))
    assert found.column_names == named.column_names


def test_trust_holds_for_policies_in_traffic(tmp_path: Path) -> None:
    path = tmp_path / "ego.zip"
    path.touch()
    path.chmod(0o666)
    for trust, said in ((False, "is writable by everybody"), (True, "^(?!.*writable by everybody)")):
        with pytest.raises(BadInput, match=said):
            prepare(Question(env_id=CUT_IN, drivers=f"cutter={path}", trust=trust))
