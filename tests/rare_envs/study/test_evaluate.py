"""Questions, checked before the first simulation, and their reports."""

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
from rare_envs.study.errors import BadInput
from rare_envs.study.evaluate import Question, prepare, run

SMALL = ("estimate", "rare_envs/CarFollowing-v0", "--method", "mc", "--max-sim", 400)

DISCRETE = """
import gymnasium as gym
import numpy as np

class Idle:
    action_space = gym.spaces.Discrete(5)

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.ones(len(observation), int), None
"""

Cli = Callable[..., Result]

FOLLOWING = "rare_envs/CarFollowing-v0"


def test_progress_reaches_the_caller(risky: str) -> None:
    seen: list[int] = []
    report = run(prepare(Question(env_id=FOLLOWING, base=risky)), lambda progress: seen.append(progress.n_sim))
    assert seen == sorted(seen)
    assert seen[-1] == report.estimate.n_sim


def test_a_question_is_checked_in_python_as_on_the_command_line() -> None:
    with pytest.raises(BadInput, match="'adss'"):
        prepare(Question(env_id=FOLLOWING, method="addss"))


def test_the_same_seed_gives_the_same_answer_and_another_seed_another(cli: Cli, risky: str) -> None:
    def p(seed: int) -> float:
        words = ("--base", risky, "--method", "adss", "--seed", seed, "--json")
        return float(json.loads(cli("estimate", FOLLOWING, *words).stdout)["p"])

    assert p(1) == p(1) != p(2)


def test_the_result_names_the_statistics_that_were_applied(cli, tmp_path):
    """A policy with somebody else's VecNormalize statistics drives unlike its training data: say which file it was."""
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


def test_noise_that_nobody_has_is_pointed_out(cli: Cli, risky: str) -> None:
    words = ("estimate", FOLLOWING, "--base", risky, "--method", "mc", "--max-sim", 500, "--noise", "fixed")
    assert "note: --noise fixed changes nothing" in cli(*words).stdout
    assert len(json.loads(cli(*words, "--json").stdout)["notes"]) == 1
    for more in (("--drivers", "bc"), ("--noise", "on")):
        assert json.loads(cli(*words, *more, "--json").stdout)["notes"] == []


def test_what_actions_are_taken_for_is_pointed_out(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A policy from HighwayEnv without its meta-actions runs all the same, and behaves arbitrarily."""
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


@pytest.mark.parametrize(
    ("ego", "reason"), [("nan_when_close", "NaN or infinite"), ("exiting_when_close", "SystemExit(7)")]
)
def test_scenarios_on_which_the_ego_fails_are_listed(cli: Cli, here: Path, risky: str, ego: str, reason: str) -> None:
    words = (*SMALL, "--base", risky, "--ego", f"egos_here:{ego}", "--out", here / "run")
    found = {}
    for on_error in ("bound", "failure"):
        result = cli(*words, "--on-error", on_error)
        assert result.exit_code == 3, result.output  # the number is doubtful
        found[on_error] = json.loads((here / "run" / "result.json").read_text())
        assert f"the ego failed twice on {found[on_error]['n_faults']} scenarios" in result.stdout
    with (here / "run" / "faults.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    answer = found["failure"]
    assert header == ["ego_speed", "lead_speed", "gap", "reason"]
    assert len(rows) == answer["n_faults"] == answer["n_failures"] > 10  # this ego fails before it collides
    assert all(reason in row[-1] for row in rows)
    assert answer["n_retried"] >= len(rows)
    assert answer["faults"][0]["parameters"]["gap"] == float(rows[0][2])
    assert answer["p"] == pytest.approx(len(rows) / 400)
    assert found["bound"]["interval"][0] == 0.0
    assert found["bound"]["interval"][1] == answer["interval"][1]
    assert np.isfinite(np.array([row[:-1] for row in rows], dtype=float)).all()
    assert cli(*SMALL, "--ego", "idm", "--out", here / "run").exit_code in (0, 3)
    assert not (here / "run" / "faults.csv").exists()


def test_an_ego_that_answers_differently_each_time_is_noticed(cli: Cli, here: Path) -> None:
    (here / "restless.py").write_text(
        "import egos_here\n"
        "import numpy as np\n"
        "def make():\n"
        "    ego = egos_here.Ego()\n"
        "    ego.choose = lambda observation: np.random.uniform(-1, 1, (len(observation), 2))\n"
        "    return ego\n"
    )
    words = (*SMALL[:-1], 50, "--json", "--gamma", 5, "--ego")
    for ego in ("restless:make", "noisy:restless:make"):
        found = json.loads(cli(*words, ego).stdout)
        assert "failures may not replay" in found["given"]
        assert found["n_failures"] > 0
        assert found["kinds"] == {}
        assert "cannot be seen again" in " ".join(found["notes"])
    assert json.loads(cli(*words, "egos_here:coasting").stdout)["given"] == ""


def test_an_unknown_word_is_refused(cli: Cli) -> None:
    result = cli(*SMALL, "--on-error", "bonud")
    assert (result.exit_code, result.stdout) == (2, "")
    assert "Did you mean 'bound'" in result.stderr
