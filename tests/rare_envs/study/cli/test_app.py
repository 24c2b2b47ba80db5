from __future__ import annotations

import csv
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle
from matplotlib.image import imread
from typer.testing import Result

import agents
import rare_envs
import samplers
from rare_envs import HighwayEnvScenario
from rare_envs.interop.parameters import restore_class_parameters
from rare_envs.scenarios.registry import SCENARIOS

Cli = Callable[..., Result]
FOLLOWING = "rare_envs/CarFollowing-v0"
SMALL = ("estimate", FOLLOWING, "--method", "mc", "--max-sim", 2000)


def assert_refused(result: Result, *words: str) -> None:
    """Exit code 2, nothing on standard output, one line without a traceback that says what is wrong."""
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert result.stderr.startswith("rare-envs: ")
    assert result.stderr.count("\n") == 1
    for word in words:
        assert word in result.stderr
    assert "Traceback" not in result.stderr


BAD_ESTIMATES = {
    "unknown environment": (["rare_envs/CutIn-v1"], ["rare_envs/CutIn-v0"]),
    "environment without its namespace": (["CutIn"], ["rare_envs/CutIn-v0"]),
    "the id with HighwayEnv's layout": (
        ["rare_envs/CutIn-kinematics-v0"],
        ["rare_envs/CutIn-v0", "'kinematics'", "'meta'"],
    ),
    "HighwayEnv's environment": (["highway-fast-v0"], ["rare_envs.highway_env_problem('highway-fast-v0'"]),
    "missing environment": ([], ["ENV"]),
    "missing .zip": ([FOLLOWING, "--ego", "nowhere.zip"], ["nowhere.zip"]),
    "corrupt .zip": ([FOLLOWING, "--ego", "corrupt.zip"], ["corrupt.zip"]),
    "misspelt ego": ([FOLLOWING, "--ego", "imd"], ["idm"]),
    "wrong observation space": ([FOLLOWING, "--ego", "egos_here:wrong_space"], ["99", "(7,)"]),
    "NaN actions": ([FOLLOWING, "--ego", "egos_here:nan_actions"], ["NaN"]),
    "actions of a wrong shape": ([FOLLOWING, "--ego", "egos_here:wrong_shape"], ["(2, 2)"]),
    "an ego that raises": ([FOLLOWING, "--ego", "egos_here:raising"], ["division by zero"]),
    "an ego's function that exits": ([FOLLOWING, "--ego", "egos_here:exiting"], ["egos_here:exiting", "7"]),
    "an ego that exits": ([FOLLOWING, "--ego", "egos_here:exiting_when_asked"], ["SystemExit(7)"]),
    "an array as ego": ([FOLLOWING, "--ego", "egos_here:array"], ["predict", "ndarray"]),
    "algorithm of the rule-based ego": ([FOLLOWING, "--algo", "foo"], ["algo", "'foo'", "'idm'"]),
    "unknown algorithm": ([FOLLOWING, "--ego", "corrupt.zip", "--algo", "ppq"], ["corrupt.zip"]),
    "misspelt method": ([FOLLOWING, "--method", "addss"], ["'adss'", "mc"]),
    "misspelt base": ([FOLLOWING, "--base", "us102"], ["'us101'", "highway"]),
    "damaged base": ([FOLLOWING, "--base", "broken.json"], ["broken.json", "JSON"]),
    "unknown measure": ([FOLLOWING, "--measure", "tttc"], ["ttc"]),
    "unknown noise": ([FOLLOWING, "--noise", "loud"], ["'on'", "'fixed'", "'off'"]),
    "misspelt drivers": ([FOLLOWING, "--drivers", "mgial"], ["did you mean 'mgail'"]),
    "drivers that are no file": ([FOLLOWING, "--drivers", "nowhere.safetensors"], ["nowhere.safetensors"]),
    "misspelt learned ego": ([FOLLOWING, "--ego", "mgial"], ["did you mean 'mgail'"]),
    "unknown observation": ([FOLLOWING, "--observation", "sonar"], ["'features', 'lidar'"]),
    "no horizon": ([FOLLOWING, "--horizon", "0"], ["horizon", "0.0"]),
    "gamma is NaN": ([FOLLOWING, "--gamma", "nan"], ["gamma", "nan"]),
    "gamma is infinite": ([FOLLOWING, "--gamma", "inf"], ["gamma", "inf"]),
    "negative budget": ([FOLLOWING, "--max-sim", "-5"], ["max_sim", "-5"]),
    "no budget": ([FOLLOWING, "--max-sim", "0"], ["max_sim", "0"]),
    "budget in words": ([FOLLOWING, "--max-sim", "many"], ["--max-sim"]),
    "negative target": ([FOLLOWING, "--target-cov", "-0.1"], ["target_cov", "-0.1"]),
    "no replicates": ([FOLLOWING, "--replicates", "0"], ["replicates", "0"]),
    "negative seed": ([FOLLOWING, "--seed", "-1"], ["seed", "-1"]),
    "gamma is NaN, for a new folder": ([FOLLOWING, "--gamma", "nan", "--out", "new/run"], ["gamma", "nan"]),
    "out is a file": ([FOLLOWING, "--out", "a_file"], ["a_file"]),
    "out is in a file": ([FOLLOWING, "--out", "a_file/run"], ["a_file/run", "Not a directory"]),
    "misspelt option": ([FOLLOWING, "--mehtod", "adss"], ["--mehtod", "--method"]),
}


@pytest.mark.parametrize(("words", "said"), BAD_ESTIMATES.values(), ids=BAD_ESTIMATES.keys())
def test_bad_input_is_one_line_before_any_simulation(
    cli: Cli, here: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], said: list[str]
) -> None:
    def simulated(*_: Any) -> None:
        raise AssertionError("a simulation was started")

    monkeypatch.setattr(rare_envs.DrivingProblem, "evaluate", simulated)
    assert_refused(cli("estimate", *words), *said)
    assert (here / "a_file").read_text() == "mine"
    assert not (here / "new").exists()


@pytest.mark.parametrize("words", [["estimat"], ["--loud"], ["list", "extra"]])
def test_a_wrong_command_is_one_line(cli: Cli, words: list[str]) -> None:
    assert_refused(cli(*words), words[-1])


@pytest.mark.parametrize(("ego", "said"), [("nan_when_close", "NaN"), ("exiting_when_close", "SystemExit(7)")])
def test_an_ego_that_fails_on_the_way_is_one_line(cli: Cli, here: Path, risky: str, ego: str, said: str) -> None:
    words = (*SMALL[:-1], 300, "--base", risky, "--ego", f"egos_here:{ego}", "--out")
    assert_refused(cli(*words, here / "new" / "run"), said)
    assert not (here / "new").exists()
    (here / "old").mkdir()
    assert_refused(cli(*words, here / "old"), said)
    assert (here / "old").exists()


BAD_TRAININGS = {
    "unknown environment": (["rare_envs/CutIn-v1"], ["rare_envs/CutIn-v0"]),
    "misspelt algorithm": ([FOLLOWING, "--algo", "poo"], ["'ppo'"]),
    "no steps": ([FOLLOWING, "--steps", "0"], ["steps", "0"]),
    "no environments": ([FOLLOWING, "--num-envs", "0"], ["num_envs", "0"]),
    "out is a folder": ([FOLLOWING, "--out", "."], ["folder"]),
}


@pytest.mark.parametrize(("words", "said"), BAD_TRAININGS.values(), ids=BAD_TRAININGS.keys())
def test_bad_input_to_training_is_one_line(cli: Cli, here: Path, words: list[str], said: list[str]) -> None:
    before = sorted(here.iterdir())
    assert_refused(cli("train-ego", *words), *said)
    assert sorted(here.iterdir()) == before


def test_json_is_one_object_and_nothing_else(cli: Cli, risky: str) -> None:
    result = cli(*SMALL, "--base", risky, "--json")
    assert result.exit_code == 0
    answer = json.loads(result.stdout)
    low, high = answer["interval"]
    assert 0.01 < low < answer["p"] < high < 0.1
    assert answer["n_sim"] == 2000
    assert answer["n_failures"] == round(answer["p"] * 2000)
    assert answer["question"]["env_id"] == FOLLOWING
    assert list(answer["units"]) == ["ego_speed", "lead_speed", "gap"]
    assert len(answer["failures"]) == 10
    likely = [failure["log_p0"] for failure in answer["failures"]]
    assert likely == sorted(likely, reverse=True)
    assert "2,000 simulations" in result.stderr


def test_what_an_ego_prints_is_no_part_of_the_answer(cli: Cli, here: Path, risky: str) -> None:
    (here / "talking_ego.py").write_text(
        "import egos_here\n"
        "print('says the module')\n"
        "class Talking(egos_here.Ego):\n"
        "    def choose(self, observation):\n"
        "        print('says the policy')\n"
        "        return egos_here.np.zeros((len(observation), 2))\n"
        "def make():\n"
        "    print('says the function')\n"
        "    return Talking()\n"
    )
    result = cli(*SMALL, "--base", risky, "--ego", "talking_ego:make", "--out", "run", "--json")
    assert json.loads(result.stdout)["n_sim"] == 2000
    for speaker in ("module", "function", "policy"):
        assert f"says the {speaker}" in result.stderr


def test_the_same_seed_gives_the_same_answer_and_another_seed_another(cli: Cli, risky: str) -> None:
    def p(seed: int) -> float:
        words = ("--base", risky, "--method", "adss", "--seed", seed, "--json")
        return float(json.loads(cli("estimate", FOLLOWING, *words).stdout)["p"])

    assert p(1) == p(1) != p(2)


def test_the_answer_is_readable(cli: Cli, risky: str) -> None:
    result = cli(*SMALL, "--base", risky)
    assert result.exit_code == 0
    for word in ("P[f <= 0] = ", "95 % interval", "c.o.v.", "2,000", "plain Monte Carlo", "idm"):
        assert word in result.stdout
    for name, unit in (("ego_speed", "m/s"), ("lead_speed", "m/s"), ("gap", "m")):
        assert any(line.split()[:1] == [name] and unit in line.split() for line in result.stdout.splitlines())


def test_a_doubtful_number_says_so_and_exits_with_3(cli: Cli, safe: str, tmp_path: Path) -> None:
    result = cli(*SMALL, "--base", safe, "--out", tmp_path / "run")
    assert result.exit_code == 3
    assert "warning: " in result.stdout
    assert "no failure found" in result.stdout
    assert json.loads((tmp_path / "run" / "result.json").read_text())["doubtful"] is True
    assert (tmp_path / "run" / "plot.png").stat().st_size > 10_000
    assert cli(*SMALL, "--base", safe, "--json").exit_code == 3


def test_the_run_folder_holds_numbers_failures_and_a_picture(cli: Cli, risky: str, tmp_path: Path) -> None:
    out = tmp_path / "runs" / "one"
    result = cli(*SMALL, "--base", risky, "--out", out, "--json")
    assert result.exit_code == 0
    assert sorted(path.name for path in out.iterdir()) == ["failures.csv", "plot.png", "result.json"]
    assert json.loads((out / "result.json").read_text()) == json.loads(result.stdout)

    with (out / "failures.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == json.loads(result.stdout)["n_failures"]
    problem = rare_envs.DrivingProblem(FOLLOWING, base=risky)
    x = np.array([[float(row[name]) for name in problem.space.names] for row in rows])
    np.testing.assert_array_equal(problem.evaluate(x), [float(row["f"]) for row in rows])
    np.testing.assert_allclose(problem.base.log_prob(x), [float(row["log_p0"]) for row in rows])

    picture = imread(out / "plot.png")[..., :3]
    assert picture.shape[0] > 500
    assert picture.shape[1] > 1500
    for part in np.array_split(picture, 3, axis=1):  # each of the three drawings has ink and colour
        assert 0.01 < np.mean(part.min(axis=2) < 0.9) < 0.6
        assert np.mean(np.ptp(part, axis=2) > 0.2) > 0.001


def test_what_the_ego_observes_can_be_chosen(cli: Cli, here: Path) -> None:
    (here / "looking.py").write_text(
        "import egos_here\n"
        "def make():\n"
        "    ego = egos_here.coasting()\n"
        "    ego.observation_space = egos_here.Box(-5.0, 5.0, (51,))\n"
        "    return ego\n"
    )
    words = (*SMALL[:-1], 100, "--ego", "looking:make")
    assert_refused(cli(*words, "--observation", "kinematics"), "51")
    for chosen in ((), ("--observation", "lidar")):  # an ego that expects the lidar's 51 numbers need not say so
        result = cli(*words, *chosen, "--json")
        assert json.loads(result.stdout)["question"]["observation"] == "lidar"


def test_help_calls_replicates_what_samplers_calls_them(cli: Cli) -> None:
    shown = cli("estimate", "--help").stdout.replace("│", " ")
    assert "Independent runs, combined by their mean" in " ".join(shown.split())


@pytest.mark.filterwarnings("ignore:.*is out of date")  # HighwayEnv keeps its old versions
def test_list_shows_what_there_is(cli: Cli) -> None:
    shown = cli("list").stdout
    entries = json.loads(cli("list", "--json").stdout)
    assert list(entries["environments"]) == list(SCENARIOS)
    assert list(entries["methods"]) == list(samplers.METHODS)
    for name in (*SCENARIOS, *samplers.METHODS, "us101", "highway", "idm", "ttc", "lateral_offset"):
        assert name in shown
    for env_id, environment in entries["environments"].items():
        space = rare_envs.DrivingProblem(env_id).space
        assert environment["vehicles"] == rare_envs.parallel_env(env_id).possible_agents
        listed = environment["parameters"]
        sizes = [each["size"] for each in listed]
        assert [each["name"] for each in listed] == list(space.names[: len(listed)])
        assert set(space.names[len(listed) :]) == ({"weights", "noise"} if environment["drivers"] else set())
        assert sizes == list(space.sizes[: len(listed)])
        learned = rare_envs.DrivingProblem(env_id, drivers="mgail").space
        added = [(each["name"], each["size"]) for each in environment["of_learned_drivers"]]
        assert added == list(zip(learned.names, learned.sizes, strict=True))[len(listed) :]
        for end in ("low", "high"):
            expected = np.repeat([each[end] for each in listed], sizes).tolist()
            assert expected == getattr(space, end)[: sum(sizes)].tolist()
        assert all(each["unit"] and each["meaning"] for each in listed)
        assert environment["kinematics_id"] in gym.registry
        assert environment["kinematics_id"] in shown
    with restore_class_parameters(IDMVehicle):  # the intersection changes it for all
        for env_id in entries["highway_env"]:
            assert HighwayEnvScenario(gym.make(env_id)).space.dim > 0
            assert env_id in " ".join(shown.split())
    assert {"highway-v0", "merge-v0", "intersection-v0", "roundabout-v0"} <= set(entries["highway_env"])
    assert "speed (6 values)" in shown
    assert "weights (404 values), noise (1,020 values)" in shown
    for name in (*agents.names.SHIPPED_DRIVERS, "okelly2018", "lidar_ttc"):
        assert name in shown


def test_an_ego_is_trained_and_then_estimated(cli: Cli, risky: str, tmp_path: Path) -> None:
    ego = tmp_path / "ego.zip"
    words = ("--steps", 512, "--num-envs", 8, "--out", ego)
    trained = cli("train-ego", FOLLOWING, *words)
    assert trained.exit_code == 0, trained.output
    assert f"rare-envs estimate {FOLLOWING} --ego {ego}" in trained.stdout.replace("\n", " ")
    result = cli(*SMALL, "--base", risky, "--ego", ego, "--json")
    assert result.exit_code in (0, 3)
    assert json.loads(result.stdout)["question"]["ego"] == str(ego)
    assert_refused(cli("estimate", "rare_envs/CutIn-v0", "--ego", ego), "(7,)", "(11,)")


def run(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "rare_envs", *words], capture_output=True, text=True, check=False)


def test_the_installed_command_behaves_the_same() -> None:
    refused = run("estimate", "CutIn")
    assert (refused.returncode, refused.stdout) == (2, "")
    assert refused.stderr.count("\n") == 1
    alone = run()
    assert (alone.returncode, alone.stderr) == (0, "")
    assert all(word in alone.stdout for word in ("list", "estimate", "train-ego"))


def test_the_result_names_the_statistics_that_were_applied(cli, tmp_path):
    """A policy with somebody else's VecNormalize statistics drives like a stranger: say which file it was."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    import training

    env = VecNormalize(training.sb3_vec_env(FOLLOWING, 4))
    PPO("MlpPolicy", env, n_steps=8, batch_size=32).save(tmp_path / "ego.zip")
    words = ("estimate", FOLLOWING, "--ego", str(tmp_path / "ego.zip"), "--method", "mc", "--max-sim", "50", "--json")
    assert json.loads(cli(*words).stdout)["vec_normalize"] is None
    env.save(str(tmp_path / "vecnormalize.pkl"))
    assert json.loads(cli(*words).stdout)["vec_normalize"] == str(tmp_path / "vecnormalize.pkl")
    assert "normalised by" in cli(*words[:-1]).stdout
