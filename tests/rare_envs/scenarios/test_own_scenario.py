"""A scenario of one's own: one definition, one registration, and it passes the suites like those that are shipped."""

import json
import sys
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from typer.testing import CliRunner

import rare_envs
import samplers
from rare_envs.distributions.space import Parameter
from rare_envs.scenarios.base import Others, Scenario, columns
from rare_envs.scenarios.registry import SCENARIOS, scenario_named
from rare_envs.study.cli.app import app
from rare_envs.study.cli.catalogue import list_names
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import VEHICLE_LENGTH, State

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # PettingZoo's test module imports what PettingZoo has deprecated
    from pettingzoo.test import parallel_api_test, parallel_seed_test

ENV_ID = "tests/Standing-v0"


def initial(x):
    """speed, distance: an ego that comes upon a vehicle that stands."""
    speed, distance = x.unbind(dim=1)
    zero = torch.zeros_like(speed)
    return State(
        columns(zero, distance + VEHICLE_LENGTH),
        columns(zero, zero),
        columns(zero, zero),
        columns(speed, zero),
        theta=x[:, :0],
    )


def others(state, dt):
    return Others(state.x[:, 1:], state.y[:, 1:], state.heading[:, 1:], state.speed[:, 1:])


STANDING = Scenario(
    name="standing",
    road=straight(1),
    vehicle_names=("ego", "stalled"),
    horizon=6.0,
    parameters=(
        Parameter("speed", "m/s", 5.0, 30.0, "of the ego"),
        Parameter("distance", "m", 10.0, 150.0, "bumper to bumper"),
    ),
    bases={"even": {"alpha": [1.0, 1.0], "beta": [1.0, 1.0]}},
    initial=initial,
    others=others,
    driven=lambda state, action, dt: others(state, dt),
)


@pytest.fixture
def registered():
    rare_envs.register_scenario(ENV_ID, STANDING)
    yield ENV_ID
    SCENARIOS.remove(ENV_ID)
    del gym.registry[ENV_ID]


def test_it_is_known_everywhere(registered):
    assert registered in rare_envs.ENV_IDS
    assert scenario_named("standing") is STANDING
    entry = list_names()["environments"][registered]
    assert [p["name"] for p in entry["parameters"]] == ["speed", "distance"]
    assert entry["bases"] == ["even"]
    with pytest.raises(ValueError, match="did you mean 'tests/Standing-v0'"):
        rare_envs.make_batch("tests/Standin-v0", 2)


def test_it_passes_the_suites(registered):
    check_env(gym.make(registered).unwrapped, skip_render_check=True)
    sb3_check_env(gym.make(registered))
    parallel_api_test(rare_envs.parallel_env(registered), num_cycles=60)
    parallel_seed_test(partial(rare_envs.parallel_env, registered), num_cycles=30)
    batch = gym.make_vec(registered, num_envs=4)
    observation, infos = batch.reset(seed=0, options={"speed": np.full(4, 20.0)})
    assert observation in batch.observation_space
    assert (infos["scenario"]["speed"] == 20.0).all()
    env = rare_envs.parallel_env(registered, render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == (208, 800, 3)


def test_its_probability_is_the_one_on_paper(registered):
    """An ego that only brakes stops within v^2 / (2 * 5): it crashes where the distance is shorter."""

    class Braking:
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.tile([-1.0, 0.0], (len(observation), 1)), None

    problem = rare_envs.DrivingProblem(registered, ego=Braking())
    n = 20_000
    result = samplers.estimate(problem, samplers.MonteCarlo(), max_sim=n, seed=0)
    v = np.linspace(5.0, 30.0, 100_001)
    # explicit Euler drives half a tick's way at the first speed more
    exact = np.clip((v**2 / 10 + v * 0.05 - 10.0) / 140.0, 0.0, 1.0).mean()
    assert abs(result.p - exact) < 5 * (exact * (1 - exact) / n) ** 0.5
    assert samplers.estimate(problem, samplers.TwoStage(), gamma=0.0, seed=0).interval[0] < exact


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vehicle_names": ("car", "stalled")}, '"ego" first'),
        ({"vehicle_names": ("ego", "ego")}, "different names"),
        ({"labels": ("the ego",)}, "as many labels as vehicles"),
        ({"bases": {}}, "at least one base distribution"),
        ({"horizon": 0.0}, "a horizon in s"),
        ({"parameters": ()}, "parameters with different names"),
        ({"parameters": (Parameter("x", "m", 0.0, 1.0, ""),)}, "none of them 'x'"),
        ({"parameters": (Parameter("speed", "m/s", 1.0, 0.0, ""),)}, "low < high"),
        ({"bases": {"even": {"alpha": [1.0], "beta": [1.0]}}}, "Base distribution even"),
        ({"vehicle_names": ("ego", "stalled", "ghost"), "labels": ()}, r"expected x of shape \(B, 3\) from initial"),
        ({"others": lambda state, dt: Others(*(field * torch.nan for field in others(state, dt)))}, "not finite"),
        ({"driven": lambda state, action, dt: Others(*(state[:4]))}, r"shape \(B, 1\) from driven"),
        ({"others": lambda state, dt: None}, r"expected others\(state, dt\) to give x, y, heading and speed"),
        ({"initial": lambda x: None}, r"expected initial\(x\) to give a State"),
    ],
)
def test_what_does_not_work_is_refused_when_it_is_made_or_registered(change, message):
    with pytest.raises(ValueError, match=message):
        rare_envs.register_scenario("tests/Broken-v0", replace(STANDING, **change))
    assert "tests/Broken-v0" not in rare_envs.ENV_IDS
    assert "tests/Broken-v0" not in gym.registry


def test_an_id_is_taken_once():
    with pytest.raises(ValueError, match="is taken"):
        rare_envs.register_scenario("rare_envs/CutIn-v0", STANDING)


def test_a_command_imports_the_module_that_registers_it(tmp_path, monkeypatch):
    """Under the id that `gym.make` takes, from the working directory; a run of it replays."""
    (tmp_path / "crests.py").write_text(
        f"import sys; sys.path.append({str(Path(__file__).parent)!r})\n"
        "from test_own_scenario import STANDING; import rare_envs\n"
        "rare_envs.register_scenario('tests/Crest-v0', STANDING)\n"
    )
    (tmp_path / "broken.py").write_text("1 / 0\n")
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
        with pytest.raises(ValueError, match="did you mean 'tests/Crest-v0'"):
            rare_envs.DrivingProblem("crests:tests/Crests-v0")
    finally:
        SCENARIOS.remove("tests/Crest-v0")
        del gym.registry["tests/Crest-v0"]
    for name in ("broken", "nowhere_at_all"):
        with pytest.raises(ValueError, match=f"Cannot import '{name}' for the environment '{name}:tests/Crest-v0'"):
            rare_envs.DrivingProblem(f"{name}:tests/Crest-v0")
