"""Pictures of sensitivity and severity; sensitivities of a driving problem on the command line and in JSON."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

import rare_envs
import samplers
from rare_envs.study import run_into
from rare_envs.study.arguments import Question
from rare_envs.study.cli.app import app
from rare_envs.study.plots import save_sensitivity, save_severity
from rare_envs.study.question import prepare
from rare_envs.study.report import Report

FOLLOWING = "rare_envs/CarFollowing-v0"

pytestmark = pytest.mark.usefixtures("full_pictures")


def test_a_picture_is_written(tmp_path: Path) -> None:
    problem = rare_envs.DrivingProblem(FOLLOWING, base="us101-gap")
    found = samplers.estimate(problem, seed=0, max_sim=2000).sensitivity(problem.space.names, problem.space.sizes)
    save_sensitivity(tmp_path / "bars.png", found)
    assert (tmp_path / "bars.png").read_bytes()[1:4] == b"PNG"


def test_a_run_with_collisions_has_a_picture_of_their_severity(tmp_path: Path) -> None:
    report = run_into(tmp_path / "run", prepare(Question(env_id=FOLLOWING, base="us101-gap", max_sim=1500)))
    assert report.kinds.severity is not None
    save_severity(tmp_path / "again.png", report.kinds.severity)
    assert (tmp_path / "run" / "severity.png").read_bytes() == (tmp_path / "again.png").read_bytes()
    run_into(tmp_path / "run", prepare(Question(env_id=FOLLOWING, method="mc", max_sim=50)), force=True)
    assert not (tmp_path / "run" / "severity.png").exists()


def test_the_command_shows_it_and_writes_it(tmp_path: Path) -> None:
    words = [
        "estimate",
        FOLLOWING,
        "--base",
        "us101-gap",
        "--max-sim",
        "2000",
        "--sensitivity",
        "--out",
        str(tmp_path / "run"),
    ]
    shown = CliRunner().invoke(app, words)
    assert shown.exit_code in (0, 3)
    assert "importance of the parameters of x" in shown.stdout
    saved = json.loads((tmp_path / "run" / "result.json").read_text())
    names = {each["name"] for each in saved["sensitivity"]["columns"]}
    assert names == {"ego_speed", "lead_speed", "gap"}
    assert any("gap" in each["name"] for each in saved["sensitivity"]["parameters"])
    assert saved["n_sim"] <= 2000
    assert (tmp_path / "run" / "sensitivity.png").exists()


def test_without_the_option_there_is_none_and_without_failures_a_note_says_why() -> None:
    question = Question(env_id=FOLLOWING, method="mc", max_sim=50)
    study = prepare(question)
    estimate = samplers.estimate(study.problem, "mc", max_sim=50, seed=0)
    assert Report(study, estimate, 1.0).to_dict()["sensitivity"] is None
    asked = prepare(Question(env_id=FOLLOWING, method="mc", max_sim=50, sensitivity=True))
    report = Report(asked, estimate, 1.0)
    assert report.to_dict()["sensitivity"] is None
    assert "sensitivity is not known: No point failed (f <= 0): there is nothing to analyse." in report.notes


@pytest.mark.parametrize("scenario", ["CarFollowing-v0", "CutIn-v0", "HardBrake-v0"])
def test_derivatives_of_shipped_bases_agree_with_reweighting(scenario: str) -> None:
    """The same failing points under bases moved to both sides: differences without an error of sampling."""
    name = "us101-gap" if scenario == "CarFollowing-v0" else None
    problem = rare_envs.DrivingProblem(f"rare_envs/{scenario}", base=name)
    result = samplers.estimate(problem, seed=0, max_sim=2500)
    base = problem.base
    parameters = base.parameters(problem.space.names)  # type: ignore[attr-defined]
    found = {each.name: each for each in result.sensitivity(problem.space.names, problem.space.sizes).parameters}
    values = [each.value for each in parameters]
    for i in range(0, len(parameters), 3):
        p = []
        for sign in (1.0, -1.0):
            moved = [v + sign * 1e-3 * parameters[i].change * (k == i) for k, v in enumerate(values)]
            p.append(result.reweight(base.with_parameters(moved)).ratio)  # type: ignore[attr-defined]
        assert found[parameters[i].name].d_log_p == pytest.approx((p[0] - p[1]) / 2e-3, abs=2e-3)
