"""A scenario of one's own: one definition, one registration, and it passes the suites like those that are shipped."""

import json
import sys
import warnings
from dataclasses import replace
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from typer.testing import CliRunner

import rare_envs
import samplers
from rare_envs.scenarios.registry import SCENARIOS, scenario_named
from rare_envs.study.cli.app import app
from rare_envs.study.cli.listing import list_names
from tests.rare_envs.scenarios.standing import STANDING

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # PettingZoo's test module imports what PettingZoo has deprecated
    from pettingzoo.test import parallel_api_test, parallel_seed_test

ENV_ID = "tests/Standing-v0"


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


def test_what_does_not_work_is_not_registered():
    with pytest.raises(ValueError, match=r"expected others\(state, dt\) to give x, y, heading and speed"):
        rare_envs.register_scenario("tests/Broken-v0", replace(STANDING, others=lambda state, dt: None))
    assert "tests/Broken-v0" not in rare_envs.ENV_IDS
    assert "tests/Broken-v0" not in gym.registry


def test_an_id_is_taken_once():
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
        SCENARIOS.remove("tests/Crest-v0")
        del gym.registry["tests/Crest-v0"]
