"""Reports: what they note and doubt, the curve over thresholds, scenarios on which the ego fails, and comparisons."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import samplers
from rare_envs.study import Question, prepare, run
from rare_envs.study.report import N_THRESHOLDS, compute_threshold_curve
from rare_envs.study.run_folder import read_failures
from rare_envs.study.text import format_shares, print_report
from tests.rare_envs.study.refusals import FOLLOWING, SMALL, Cli, in_file


@pytest.mark.parametrize("shares", [[0.998, 0.002], [0.335, 0.335, 0.33], [0.962, 0.034, 0.004], [1.0, 0.0], [1.0]])
def test_shares_of_a_whole_add_to_no_more_than_100(shares: list[float]) -> None:
    shown = [float(each.removeprefix("over ").removesuffix(" %")) for each in format_shares(shares)]
    assert sum(shown) <= 100 and np.abs(np.array(shown) - 100 * np.array(shares)).max() < 1
    assert format_shares([0.998, 0.002]) == ["over 99 %", "0.2 %"]


@pytest.mark.parametrize("method", ["mc", "two-stage", "adss"])
def test_the_curve_starts_at_p_and_its_band_holds_the_truth(method: str) -> None:
    problem = samplers.FunctionProblem(lambda x: 2.5 - x[:, 0], dim=2)
    estimate = samplers.estimate(problem, method, seed=1, max_sim=5000)
    curve = compute_threshold_curve(estimate)
    assert len(curve) == N_THRESHOLDS and curve.gammas[0] == 0.0 and curve.p[0] == pytest.approx(estimate.p)
    truth = stats.norm.cdf(curve.gammas - 2.5)
    assert np.mean((curve.low <= truth) & (truth <= curve.high)) > 0.9
    assert 0.3 < curve.p[-1] < 0.7


@pytest.mark.slow
def test_the_result_names_the_statistics_that_were_applied(cli: Cli, tmp_path: Path) -> None:
    """A policy with somebody else's VecNormalize statistics drives unlike its training data: say which file it was."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    import training

    env = VecNormalize(training.sb3_vec_env(FOLLOWING, 4))
    PPO("MlpPolicy", env, n_steps=8, batch_size=32).learn(32).save(tmp_path / "ego.zip")
    words = ("estimate", FOLLOWING, "--ego", str(tmp_path / "ego.zip"), "--method", "mc", "--max-sim", "50", "--json")
    without = json.loads(cli(*words).stdout)
    assert without["vec_normalize"] is None and "trained behind VecNormalize" in without["doubt_of_statistics"]
    assert "Warning      the ego has no VecNormalize statistics" in cli(*words[:-1]).stdout
    env.save(str(tmp_path / "vecnormalize.pkl"))
    assert json.loads(cli(*words).stdout)["vec_normalize"] == str(tmp_path / "vecnormalize.pkl")
    shown = cli(*words[:-1], "--details").stdout
    assert "normalised by" in shown and "the ego has no" not in shown


@pytest.mark.parametrize(
    ("ego", "reason"),
    [
        ("nan_when_close", "NaN or infinite"),
        pytest.param("exiting_when_close", "SystemExit(7)", marks=pytest.mark.slow),
    ],
)
def test_scenarios_on_which_the_ego_fails_are_listed(cli: Cli, here: Path, risky: str, ego: str, reason: str) -> None:
    words = (*SMALL[:-1], 400, "--base", risky, "--ego", f"egos_here:{ego}", "--out", here / "run")
    found = {}
    for on_error in ("bound", "failure"):
        result = cli(*words, *in_file(on_error=on_error), "--force", "--details")
        assert result.exit_code == 3, result.output  # the number is doubtful
        found[on_error] = json.loads((here / "run" / "result.json").read_text())
        assert f"the ego gave no answer in {found[on_error]['n_faults']} scenarios" in result.stdout
        assert "the ego gave no answer, " in result.stdout and "f = nan" not in result.stdout
    with (here / "run" / "faults.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    answer = found["failure"]
    assert header == ["ego_speed", "lead_speed", "gap", "reason"]
    assert len(rows) == answer["n_faults"] == answer["n_failures"] > 10  # this ego fails before it collides
    assert all(reason in row[-1] for row in rows)
    assert answer["n_retried"] >= len(rows) and answer["p"] == pytest.approx(len(rows) / 400)
    assert answer["faults"][0]["parameters"]["gap"] == float(rows[0][2])
    assert found["bound"]["interval"] == [0.0, answer["interval"][1]]
    assert cli(*SMALL, "--ego", "idm", "--out", here / "run", "--force").exit_code in (0, 3)
    assert not (here / "run" / "faults.csv").exists()


def test_plain_monte_carlo_is_advised_where_it_would_find_enough(
    risky: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """30 failures at least; beyond a million simulations nothing is advised."""
    report = run(prepare(Question(env_id=FOLLOWING, base=risky, method="two-stage", max_sim=1000, horizon=4.0)))
    for p, said in ((1.1e-3, "--max-sim 30000 "), (4e-5, "--max-sim 800000 "), (1e-5, ""), (0.0, "")):
        print_report(replace(report, estimate=replace(report.estimate, p=p, cov=0.1)), details=True)
        line = capsys.readouterr().out.partition("check: --method mc ")[2]
        assert line.startswith(said) and bool(line) == bool(said), (p, line)


def test_the_ratio_of_an_ego_that_brakes_and_one_that_does_not(cli, risky, here):
    words = ("compare", "egos_here:coasting", "idm", FOLLOWING, "--base", risky, "--method", "mc", "--max-sim", 2000)
    result = cli(*words, *in_file(collisions="any"), "--out", "run", "--json")
    assert result.exit_code in (0, 3), result.output
    found = json.loads(result.stdout)
    assert json.loads((here / "run" / "comparison.json").read_text()) == found
    assert (found["question"]["ego_a"], found["question"]["collisions"]) == ("egos_here:coasting", "any")
    low, high = found["interval"]
    assert found["n_sim"] == 2000 and 1 < low < found["ratio"] < high
    assert found["a"]["p"] > found["b"]["p"]
    failures = read_failures(here / "run")
    assert len(failures["f"]) > 3 and (failures["f"] <= 0.0).all()
    assert failures["gap"].shape == failures["log_p0"].shape == failures["f"].shape
    assert cli("replay", "run").exit_code == 2
    text = cli(*words).stdout
    assert "egos_here:coasting (A) against idm (B) in " in text and f" {found['ratio']:.2g} times as often" in text


def test_an_ego_that_answers_at_random_is_named(cli, risky, here):
    words = ("compare", "idm", "egos_here:random_later", FOLLOWING, "--base", risky, "--method", "mc", "--max-sim", 400)
    result = cli(*words, "--gamma", 2, "--json")
    assert result.exit_code == 3, result.output
    found = json.loads(result.stdout)["warnings"]
    assert [text for text in found if text.startswith("B: ") and "gave another f" in text]
    assert not [text for text in found if text.startswith("A: ")]
