"""`rare-envs replay`: failures of a run driven again, and the pictures of it."""

import json

import numpy as np
import pytest
from PIL import Image

import rare_envs
from rare_envs.study.errors import BadInput
from rare_envs.study.replay import drive_again
from rare_envs.study.storage.failure_table import read_failures
from rare_envs.study.video import (
    CURVES_HEIGHT,
    LAST_FRAME_TICKS,
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


def test_a_failure_of_a_run_is_shown(cli, run, tmp_path):
    clip = tmp_path / "clip.gif"
    result = cli("replay", run, "--failure", 1, "--out", clip, "--json")
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    assert answer["f"] == answer["f_recorded"] == read_failures(run)["f"][1] == -1.0
    assert answer["crash"]["kind"] == "rear_end"
    assert answer["crash"]["vehicles"] == [0, 1]
    with Image.open(clip) as film:
        assert film.size == (800, 160 + 48 + CURVES_HEIGHT)
        length = 0
        for k in range(film.n_frames):
            film.seek(k)
            length += film.info["duration"]
    assert length == pytest.approx(1000 * answer["seconds"] + 100 * LAST_FRAME_TICKS, abs=1)  # equal frames are one
    words = cli("replay", run, "--out", tmp_path / "worst.png").stdout
    for said in ("Failure 0 of", "ego_speed", "the ego into the lead (rear_end", f"Wrote {tmp_path / 'worst.png'}"):
        assert said in words


def test_a_drive_that_comes_out_otherwise_says_why(run):
    found = find_failure(run, 0)
    drive = drive_again(found.problem, found.x)
    other = found._replace(f=found.f + 1.0)
    assert "have changed since" in describe_drive(other, drive, 0)[-1]
    found.problem.varies = True
    assert "what was recorded is what counts" in describe_drive(other, drive, 0)[-1]
    assert "recorded" not in describe_drive(found, drive, 0)[-1]


def test_bad_input_is_one_line(cli, run):
    for words, said in (
        (["--failure", 100000], "Expected a failure from 0 to"),
        (["--failure", -1], "Expected a failure from 0 to"),
        (["--out", "clip.mp4"], "ends in .gif"),
        (["--out", "no/such/clip.gif"], "no folder"),
    ):
        result = cli("replay", run, *words)
        assert result.exit_code == 2
        assert said in result.stderr
        assert len(result.stderr.strip().splitlines()) == 1


def test_no_run(tmp_path):
    with pytest.raises(BadInput, match="No run in"):
        find_failure(tmp_path, 0)


def test_another_f_than_recorded_is_a_warning(cli, run):
    result = json.loads((run / "result.json").read_text())
    result["question"]["horizon"] = 0.5  # as if the program had changed
    (run / "result.json").write_text(json.dumps(result))
    answer = cli("replay", run)
    assert answer.exit_code == 3
    assert "warning: the run recorded f = -1" in answer.stdout


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
