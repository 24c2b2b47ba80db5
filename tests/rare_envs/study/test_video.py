"""Failures of a run driven again, and the pictures of it."""

import numpy as np
import pytest
from PIL import Image

import rare_envs
from rare_envs.study.errors import BadInput
from rare_envs.study.replay import drive_again
from rare_envs.study.video import (
    describe_drive,
    draw_frames,
    find_failure,
    write_film,
)

FOLLOWING = "rare_envs/CarFollowing-v0"


@pytest.fixture
def run(cli, risky, tmp_path):
    folder = tmp_path / "run"
    result = cli("estimate", FOLLOWING, "--base", risky, "--method", "mc", "--max-sim", 400, "--out", folder)
    assert result.exit_code in (0, 3)
    return folder


def test_a_drive_that_comes_out_otherwise_says_why(run):
    found = find_failure(run, 0)
    drive = drive_again(found.problem, found.x)
    other = found._replace(f=found.f + 1.0)
    assert "have changed since" in describe_drive(other, drive, 0)[-1]
    found.problem.varies = True
    assert "what was recorded is what counts" in describe_drive(other, drive, 0)[-1]
    assert "recorded" not in describe_drive(found, drive, 0)[-1]


def test_no_run(tmp_path):
    with pytest.raises(BadInput, match="No finished run in"):
        find_failure(tmp_path, 0)


@pytest.mark.parametrize("env_id", rare_envs.ENV_IDS)
def test_every_scenario_and_a_drive_without_a_crash(env_id, tmp_path):
    problem = rare_envs.DrivingProblem(env_id, horizon=1.0, noise=False)
    drive = drive_again(problem, problem.base.sample(1, np.random.default_rng(0))[0])
    shown = draw_frames(drive)
    assert len(shown) == 11
    assert drive.crash is None
    cursor = [np.flatnonzero((np.asarray(each)[-60] == (200, 0, 150)).all(axis=-1)).mean() for each in shown]
    np.testing.assert_allclose(np.diff(cursor), np.mean(np.diff(cursor)), atol=1.1)  # the cursor moves evenly
    write_film(tmp_path / "small.gif", drive, width=400, every=2)
    with Image.open(tmp_path / "small.gif") as film:
        assert film.size[0] == 400
