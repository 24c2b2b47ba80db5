"""Pictures of sensitivity and severity; sensitivities of a driving problem on the command line and in JSON."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

import samplers
from rare_envs.study.arguments import Question
from rare_envs.study.cli.app import app
from rare_envs.study.question import prepare
from rare_envs.study.report import Report

FOLLOWING = "rare_envs/CarFollowing-v0"

pytestmark = pytest.mark.usefixtures("full_pictures")


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
