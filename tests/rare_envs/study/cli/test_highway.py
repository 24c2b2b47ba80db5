"""Learned drivers on the command line: a run on the highway from the question to its files, and training among them."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

import agents
import rare_envs
from rare_envs.problem import AmbiguousActions
from rare_envs.study.ego_check.findings import Finding
from rare_envs.study.ego_check.subprocess_check import EgoCheckRequest, run_checks
from rare_envs.study.run_directory import CRASH, read_failures

Cli = Callable[..., Result]
FOLLOWING = "rare_envs/CarFollowing-v0"
HIGHWAY = ("estimate", "rare_envs/Highway-v0", "--measure", "lidar_ttc", "--gamma", 1.0, "--horizon", 2)


def test_the_highway_end_to_end(cli: Cli, tmp_path: Path) -> None:
    """Blocks of x in every place where parameters are told, and drivers and horizon in the record."""
    words = ("--ego", "bc", "--drivers", "gail", "--noise", "fixed", "--method", "mc", "--max-sim", 256)
    result = cli(*HIGHWAY, *words, "--out", tmp_path)
    assert result.exit_code in (0, 3), result.output
    assert "the drivers' noise is one fixed sequence" in result.stdout
    assert max(map(len, result.stdout.splitlines())) < 200
    lines = {line.split()[0]: line for line in result.stdout.splitlines() if line.strip()}
    assert len(lines["speed"].partition("m/s")[0].split()) == 1 + 6
    assert "404 values" in lines["weights"]

    answer = json.loads((tmp_path / "result.json").read_text())
    asked = answer["question"]
    assert (asked["drivers"], asked["ego"], asked["horizon"], asked["noise"]) == ("gail", "bc", 2.0, "fixed")
    assert asked["observation"] == "lidar"
    assert answer["given"] == "the drivers' noise is one fixed sequence"
    likely = answer["failures"][0]["parameters"]
    assert {name: len(values) for name, values in likely.items()} == {
        "s": 6,
        "t": 6,
        "heading": 6,
        "speed": 6,
        "weights": 404,
    }
    with (tmp_path / "failures.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    assert header[:2] == ["s[0]", "s[1]"]
    assert header[-3 - len(CRASH) :] == ["speed[5]", "f", "log_p0", *CRASH]
    found = read_failures(tmp_path)
    assert [len(values) for values in found.values()] == [len(rows)] * (7 + len(CRASH))
    for name, values in likely.items():
        np.testing.assert_array_equal(found[name][0], np.float32(values) if name == "weights" else values)
    ego = agents.load_ego(asked["ego"])
    problem = rare_envs.DrivingProblem(
        asked["env_id"], ego=ego, measure="lidar_ttc", noise="fixed", drivers="gail", horizon=2.0
    )
    x = np.concatenate([found[name] for name in problem.space.names], axis=1)
    np.testing.assert_allclose(problem.evaluate(x), found["f"], atol=1e-3)  # products round by batch size
    np.testing.assert_allclose(problem.base.log_prob(x), found["log_p0"], atol=0.1)
    assert (tmp_path / "plot.png").stat().st_size > 50_000


def test_a_short_table_needs_no_second_file(cli: Cli, risky: str, tmp_path: Path) -> None:
    (tmp_path / "failures.npz").write_bytes(b"of an earlier run in this folder")
    cli("estimate", FOLLOWING, "--base", risky, "--method", "mc", "--max-sim", 2000, "--out", tmp_path)
    assert not (tmp_path / "failures.npz").exists()
    found = read_failures(tmp_path)
    assert list(found) == ["ego_speed", "lead_speed", "gap", "f", "log_p0", *CRASH]
    problem = rare_envs.DrivingProblem(FOLLOWING, base=risky)
    x = np.column_stack([found[name] for name in problem.space.names])
    np.testing.assert_array_equal(problem.evaluate(x), found["f"])
    with pytest.raises(FileNotFoundError):
        read_failures(tmp_path / "nowhere")


def test_noise_that_nobody_has_is_pointed_out(cli: Cli, risky: str) -> None:
    words = ("estimate", FOLLOWING, "--base", risky, "--method", "mc", "--max-sim", 500, "--noise", "fixed")
    assert "note: --noise fixed changes nothing" in cli(*words).stdout
    assert len(json.loads(cli(*words, "--json").stdout)["notes"]) == 1
    for more in (("--drivers", "bc"), ("--noise", "on")):
        assert json.loads(cli(*words, *more, "--json").stdout)["notes"] == []


def test_what_to_check_is_said_where_something_may_be_missed(cli: Cli, here: Path, risky: str, safe: str) -> None:
    (here / "careful.py").write_text("def make():\n    return 'idm'\n")
    words = ("estimate", FOLLOWING, "--method", "adss", "--max-sim", 2000, "--base")
    assert "check it" not in cli(*words, risky, "--ego", "egos_here:coasting").stdout  # base draws saw it often
    assert "check it: --method mc --max-sim 300000" in cli(*words, safe, "--ego", "careful:make").stdout


def test_an_ego_is_trained_in_the_world_that_was_asked_for(cli: Cli, risky: str, tmp_path: Path) -> None:
    ego = tmp_path / "ego.zip"
    world = ("--drivers", "idm", "--observation", "lidar", "--horizon", 3, "--noise", "off", "--base", risky)
    words = ("train-ego", FOLLOWING, "--steps", 64, "--num-envs", 8, "--out", ego)
    trained = cli(*words, *world)
    assert trained.exit_code == 0, trained.output
    again = trained.stdout.replace("\n", " ").partition(f"--ego {ego} ")[2]
    asked = {f"--base {risky}", "--drivers idm", "--noise off", "--horizon 3.0", "--observation lidar"}
    assert {f"--{words.strip()}" for words in again.split("--")[1:]} == asked
    assert agents.load_ego(ego).observation_space.shape == (51,)
    answer = json.loads(cli(*words, *world, "--json").stdout)
    assert (answer["drivers"], answer["horizon"], answer["noise"]) == ("idm", 3.0, False)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--drivers", "mgial"), "did you mean 'mgail'"),
        (("--base", "us102"), "'us101'"),
        (("--observation", "sonar"), "'features', 'lidar'"),
        (("--horizon", 0), "horizon"),
        (("--noise", "loud"), "'fixed'"),
    ],
)
def test_a_world_that_does_not_exist_is_refused_in_one_line(cli: Cli, tmp_path: Path, words, said: str) -> None:
    result = cli("train-ego", FOLLOWING, "--out", tmp_path / "ego.zip", *words)
    assert result.exit_code == 2
    assert said in result.stderr
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "ego.zip").exists()


DISCRETE = """
import gymnasium as gym
import numpy as np

class Idle:
    action_space = gym.spaces.Discrete(5)

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.ones(len(observation), int), None
"""


def test_what_actions_are_taken_for_is_pointed_out(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A policy from HighwayEnv without its meta-actions runs all the same, and drives like a stranger."""
    (tmp_path / "idle_egos.py").write_text(DISCRETE)
    monkeypatch.chdir(tmp_path)
    words = ("estimate", FOLLOWING, "--ego", "idle_egos:Idle", "--method", "mc", "--max-sim", 50, "--json")
    (note,) = json.loads(cli(*words, "--observation", "kinematics").stdout)["notes"]
    assert "--action meta" in note
    for more in (("--observation", "kinematics", "--action", "meta"), ()):
        assert json.loads(cli(*words, *more).stdout)["notes"] == []
    both = (
        *("compare", "idle_egos:Idle", "idm", FOLLOWING),
        *("--method", "mc", "--max-sim", 20, "--observation", "kinematics"),
    )
    assert json.loads(cli(*both, "--json").stdout)["notes"] == [f"A: {note}"]
    assert f"note: A: {note}" in cli(*both).stdout
    asked = EgoCheckRequest("idle_egos:Idle", FOLLOWING, observation="kinematics")
    (found,) = (each for each in run_checks(asked) if isinstance(each, Finding) and each.found == note)
    assert (found.check, found.status) == ("action space", "warn")
    with pytest.warns(AmbiguousActions, match="--action meta"):
        rare_envs.DrivingProblem(FOLLOWING, ego=agents.load_ego("idle_egos:Idle"), observation="kinematics")
