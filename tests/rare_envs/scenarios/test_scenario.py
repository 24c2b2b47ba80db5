"""A scenario of one's own: its trial, the motion of its vehicles by hand, and the suites that it passes."""

import json
import math
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from torch import Tensor
from typer.testing import CliRunner

import rare_envs
import samplers
from rare_envs.distributions.space import Parameter
from rare_envs.scenarios.base import Others, Scenario, drive_points, keep_straight, try_scenario
from rare_envs.scenarios.registry import SCENARIOS, find_scenario
from rare_envs.study.cli.app import app
from rare_envs.study.cli.listing import list_names
from rare_envs.traffic.road import ReferenceLine, Road
from rare_envs.traffic.state import State
from tests.rare_envs.interop.egos import Always
from tests.rare_envs.scenarios.standing import STANDING, initial, others
from tests.rare_envs.traffic_states import F64, traffic

BEND = ReferenceLine(25.0, (0.0, 0.002, 0.004, -0.002, 0.0))
SPEED = Parameter("speed", "m/s", 5.0, 30.0, "")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"vehicle_names": ("car", "stalled")}, 'vehicles with different names, "ego" first'),
        ({"vehicle_names": ("ego", "")}, "vehicles with names, got ('ego', '')"),
        ({"labels": ("the ego",)}, "as many labels as vehicles"),
        ({"bases": {}}, "at least one traffic model"),
        ({"horizon": math.inf}, "a horizon in s"),
        ({"parameters": (SPEED, SPEED)}, "parameters with different names, none of them 'x'"),
        ({"parameters": (replace(SPEED, name="x"),)}, "parameters with different names, none of them 'x'"),
        ({"parameters": (replace(SPEED, low=30.0),)}, "parameters with low < high"),
    ],
)
def test_a_scenario_that_contradicts_itself_is_refused(change: dict[str, Any], expected: str) -> None:
    with pytest.raises(ValueError, match=r"^Expected .* in the scenario 'standing'") as caught:
        replace(STANDING, **change)
    assert expected in str(caught.value)


EGO = (0.0, 0.0, 0.0, 99.0)


def test_vehicles_that_keep_straight_move_by_their_speed_before_the_tick() -> None:
    state = traffic(EGO, (30.0, 1.0, 0.1, 20.0), (60.0, 2.0, 0.0, 1.0))
    after = keep_straight(state, torch.tensor([[-2.0, -4.0]], dtype=F64), 0.5)
    assert after.x.tolist() == [[40.0, 60.5]]
    assert after.speed.tolist() == [[19.0, 0.0]]  # -1 m/s would be backwards
    assert after.y.tolist() == [[1.0, 2.0]]
    assert after.heading.tolist() == [[0.1, 0.0]]
    assert keep_straight(state, 0.0, 0.5).speed.tolist() == [[20.0, 1.0]]


def drive_in_the_bend(y: float, heading: float, action: Tensor, ticks: int) -> list[float]:
    """Drive a point at 20 m/s in the bend; x, y, heading and speed at the end."""
    state, road = traffic(EGO, (0.0, y, heading, 20.0)), Road((-2.0, 2.0, 5.0), BEND)
    for _ in range(ticks):
        after = drive_points(state, action, 0.1, road)
        moved = (torch.cat((mine[:, :1], new), 1) for mine, new in zip(state[:4], after[:4], strict=True))
        state = State(*moved, state.theta)
    return [field[0, 1].item() for field in state[:4]]


def test_a_point_that_does_not_turn_relative_to_the_road_follows_it() -> None:
    """In 10 s at 20 m/s it drives 200 m of its own line, which at y is (1 - k y) of the reference line: x - y theta."""
    x, y, heading, speed = drive_in_the_bend(4.0, 0.0, torch.zeros(1, 1, 2, dtype=F64), 100)
    assert (y, heading, speed) == pytest.approx((4.0, 0.0, 20.0), abs=1e-12)
    turned = BEND.at(torch.tensor([x], dtype=F64)).heading.item()
    assert turned == pytest.approx(0.1, abs=1e-9)  # (0.002 + 0.004 - 0.002) / m times 25 m
    assert x - y * turned == pytest.approx(200.0, abs=0.05)  # explicit Euler, of first order in the tick


def test_a_yaw_rate_is_relative_to_the_road() -> None:
    """0.02 rad/s for 4 s, wherever the road turns meanwhile."""
    action = torch.tensor([[[0.0, 0.02]]], dtype=F64)
    _, _, heading, _ = drive_in_the_bend(0.0, -0.03, action, 40)
    assert heading == pytest.approx(-0.03 + 0.08, abs=1e-12)


def without_a_value(function: Callable[..., Any], field: str) -> Callable[..., Any]:
    """The same function with NaN in one field of one row."""

    def broken(*arguments: Any) -> Any:
        fields = function(*arguments)
        value = getattr(fields, field).clone()
        value[3] = torch.nan
        return fields._replace(**{field: value})

    return broken


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bases": {"odd": {"weights": [1.0]}}}, "^Traffic model odd: Missing means, covariances"),
        ({"initial": lambda x: None}, r"expected initial\(x\) to give a State, got NoneType\.$"),
        ({"initial": lambda x: initial(x)._replace(theta=x[:3])}, r"expected theta of 8 rows, got \(3, 2\)\.$"),
        ({"vehicle_names": ("ego", "a", "b"), "labels": ()}, r"x of shape \(B, 3\) from initial\(x\), got \(8, 2\)"),
        ({"initial": without_a_value(initial, "heading")}, r"heading from initial\(x\) is not finite\.$"),
        ({"others": lambda state, dt: None}, r"expected others\(state, dt\) to give x, y, .* or Others; got None\.$"),
        ({"others": lambda state, dt: Others(1, 2, 3, 4)}, r"heading and speed, as State or Others; got Others\(x=1"),
        ({"others": lambda state, dt: Others(*others(state, dt)[:4], state.theta[:3])}, r"to keep the shape \(8, 0\)"),
        ({"signals": lambda state: state.x > 0.0}, r"expected signals\(state\) of shape \(8, 1\), got \(8, 2\)\.$"),
        ({"others": without_a_value(others, "y")}, r"y from others\(state, dt\) is not finite\.$"),
        ({"driven": lambda state, action, dt: Others(*state[:4])}, r"x of shape \(B, 1\) from driven.*, got \(8, 2\)"),
    ],
)
def test_what_does_not_work_is_refused(change: dict[str, Any], message: str) -> None:
    scenario: Scenario = replace(STANDING, **change)
    with pytest.raises(ValueError, match=message) as caught:
        try_scenario(scenario)
    assert str(caught.value).startswith(("Scenario 'standing': ", "Traffic model "))


with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # PettingZoo's test module imports what PettingZoo has deprecated
    from pettingzoo.test import parallel_api_test, parallel_seed_test

ENV_ID = "tests/Standing-v0"


@pytest.fixture
def registered():
    rare_envs.register_scenario(ENV_ID, STANDING)
    yield ENV_ID
    del SCENARIOS[ENV_ID]
    del gym.registry[ENV_ID]


def test_it_is_known_everywhere(registered):
    assert registered in rare_envs.ENV_IDS
    assert find_scenario("standing") is STANDING
    entry = list_names()["environments"][registered]
    assert [p["name"] for p in entry["parameters"]] == ["speed", "distance"]
    assert entry["bases"] == ["even"]


def test_it_passes_the_suites(registered):
    check_env(gym.make(registered).unwrapped, skip_render_check=True)
    sb3_check_env(gym.make(registered))
    parallel_api_test(rare_envs.parallel_env(registered), num_cycles=20)
    parallel_seed_test(partial(rare_envs.parallel_env, registered), num_cycles=10)
    batch = gym.make_vec(registered, num_envs=4)
    observation, infos = batch.reset(seed=0, options={"speed": np.full(4, 20.0)})
    assert observation in batch.observation_space
    assert (infos["scenario"]["speed"] == 20.0).all()
    env = rare_envs.parallel_env(registered, render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == (208, 800, 3)


def test_its_probability_is_the_one_on_paper(registered):
    """An ego that only brakes stops within v^2 / (2 * 5): it crashes where the distance is shorter."""
    problem = rare_envs.DrivingProblem(registered, ego=Always([-1.0, 0.0]))
    n = 20_000
    result = samplers.estimate(problem, samplers.MonteCarlo(), max_sim=n, seed=0)
    v = np.linspace(5.0, 30.0, 100_001)
    # explicit Euler drives half a tick's way at the first speed more
    exact = np.clip((v**2 / 10 + v * 0.05 - 10.0) / 140.0, 0.0, 1.0).mean()
    assert abs(result.p - exact) < 5 * (exact * (1 - exact) / n) ** 0.5
    assert samplers.estimate(problem, samplers.TwoStage(), gamma=0.0, seed=0).interval[0] < exact


def test_what_does_not_work_is_not_registered():
    with pytest.raises(ValueError, match=r"expected others\(state, dt\) to give x, y, heading and speed"):
        rare_envs.register_scenario("tests/Broken-v0", replace(STANDING, others=lambda state, dt: None))
    assert "tests/Broken-v0" not in rare_envs.ENV_IDS
    assert "tests/Broken-v0" not in gym.registry
    with pytest.raises(ValueError, match="is taken"):
        rare_envs.register_scenario("rare_envs/CutIn-v0", STANDING)


@pytest.mark.slow
def test_a_command_imports_the_module_that_registers_it(tmp_path, monkeypatch):
    """Under the id that `gym.make` takes, from the working directory; a run of it replays."""
    (tmp_path / "crests.py").write_text(
        "from tests.rare_envs.scenarios.standing import STANDING; import rare_envs\n"
        "rare_envs.register_scenario('tests/Crest-v0', STANDING)\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    env_id = "crests:tests/Crest-v0"
    try:
        ran = CliRunner().invoke(
            app, ["estimate", env_id, "--method", "mc", "--max-sim", "2000", "--out", "run", "--json"]
        )
        assert ran.exit_code in (0, 3), ran.stderr
        assert json.loads(ran.stdout)["question"]["env_id"] == env_id
        assert rare_envs.DrivingProblem(env_id).space.names == ("speed", "distance")
    finally:
        del SCENARIOS["tests/Crest-v0"]
        del gym.registry["tests/Crest-v0"]
