"""A scenario driven again: f is that of the rollout, and every moment is kept."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from PIL import Image

import rare_envs
import samplers
from rare_envs.study import Question, Report, plots, prepare, run
from rare_envs.study.arguments import BadInput
from rare_envs.study.plots import (
    MARKER,
    SHOWN_SECONDS,
    draw_answer,
    draw_frames,
    draw_measure,
    list_severity,
    one_in,
    write_film,
)
from rare_envs.study.replay import describe_drive, drive_again, find_failure
from rare_envs.study.text import report_as_json
from tests.rare_envs.study.refusals import FOLLOWING, SMALL, Cli, assert_refused, full_disk, in_file

CUT_IN, NEWEST = "rare_envs/CutIn-v0", "rare_envs/CutIn-v1"


@pytest.mark.parametrize(
    ("env_id", "core"), [*((each, "torch") for each in rare_envs.ENV_IDS), (CUT_IN, "numba"), (NEWEST, "numba")]
)
def test_a_replay_gives_the_same_f_bit_for_bit_or_to_rounding_of_a_compiled_rollout(env_id: str, core: str) -> None:
    problem = rare_envs.DrivingProblem(env_id, core=core)
    learned = problem.world.background is not None  # whose products round differently by batch size
    x = problem.base.sample(3 if learned else 20, np.random.default_rng(0))
    tolerance = 1e-3 if learned else 1e-5 if core == "numba" else 0.0
    assert [drive_again(problem, row).f for row in x] == pytest.approx(problem.evaluate(x).tolist(), abs=tolerance)


def test_the_worst_moment_of_a_near_miss_is_where_its_time_to_collision_is_least() -> None:
    drive = drive_again(rare_envs.DrivingProblem(FOLLOWING), np.array([20.0, 0.0, 60.0]))
    closing = drive.closing_speed > 0
    ttc = np.where(closing, drive.gap / np.where(closing, drive.closing_speed, 1.0), np.inf)
    assert not drive.collided
    assert 0 < drive.worst == int(np.argmin(ttc))
    assert drive.f == pytest.approx(ttc.min(), rel=1e-5)


class Coasting:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 2), np.float32), None


def test_moments_by_hand() -> None:
    """Closing 30 m at 10 m/s while the ego coasts: f so far falls by the tick, and each moment's is the same."""
    problem = rare_envs.DrivingProblem(FOLLOWING, ego=Coasting())
    drive = drive_again(problem, np.array([20.0, 10.0, 30.0]))
    k = np.arange(len(drive.f_so_far) - 1)
    expected = np.maximum(3.0 - 0.1 * k, 0.001)  # gaps are at least 1 cm
    np.testing.assert_allclose(drive.f_alone[:-1], expected, atol=1e-4)
    np.testing.assert_allclose(drive.f_so_far[:-1], expected, atol=1e-4)
    assert drive.f == -1.0 == problem.evaluate(np.array([[20.0, 10.0, 30.0]]))[0]
    assert drive.time[len(k)] == pytest.approx(3.0, abs=0.11)
    assert drive.collided and drive.gap[-2] >= 0.0 >= drive.gap[-1] and drive.worst == len(drive.time) - 1
    np.testing.assert_allclose(drive.speed, np.tile([20.0, 10.0], (len(drive.time), 1)), atol=1e-4)


def test_a_film_on_a_full_disk_is_one_line_and_the_film_before_it_stays(
    cli: Cli, finished_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    film = tmp_path / "film.gif"
    film.write_text("the one before")
    monkeypatch.setattr(plots, "save_gif", full_disk)
    assert_refused(cli("replay", finished_run, "--out", film, "--force"), "No space left on device", str(film))
    assert film.read_text() == "the one before" and list(tmp_path.iterdir()) == [film]


def test_a_drive_that_comes_out_otherwise_says_why(finished_run: Path) -> None:
    found = find_failure(finished_run, 0)
    drive = drive_again(found.problem, found.x)
    other = found._replace(f=found.f + 1.0)
    assert "have changed since" in describe_drive(other, drive, 0)[-1]
    found.problem.varies = True
    assert "what was recorded is what counts" in describe_drive(other, drive, 0)[-1]
    assert "recorded" not in describe_drive(found, drive, 0)[-1]
    with pytest.raises(BadInput, match="Expected a failure from 0 to"):
        find_failure(finished_run, 10_000)


pytestmark = pytest.mark.usefixtures("full_pictures")


def test_the_folder_of_a_run_holds_what_was_printed_and_a_picture(cli: Cli, risky: str, tmp_path: Path) -> None:
    out = tmp_path / "runs" / "one"
    result = cli(*SMALL, "--base", risky, "--out", out, "--json")
    assert result.exit_code == 0
    pictures = ["answer.png", "crash.png", "failures.png", "severity.png"]
    tables = ["episodes.parquet", "failures.csv", "result.json", "study.json"]
    assert sorted(path.name for path in out.iterdir()) == sorted([*pictures, *tables])
    assert json.loads((out / "result.json").read_text()) == json.loads(result.stdout)
    for name in pictures:  # of the width of a page, with ink, and what is of the ego in green
        picture = imread(out / name)[..., :3]
        assert picture.shape[1] == 720 and 0.01 < np.mean(picture.min(axis=2) < 0.9) < 0.6
        green = (picture[..., 1] > picture[..., 0] + 0.1) & (picture[..., 1] > picture[..., 2] + 0.1)
        assert green.mean() > 0.001 or name == "failures.png"
    severity = json.loads(result.stdout)["severity"]
    assert list_severity(severity)[0][0] == 0.0 and len(list_severity(severity)) == 3


def test_where_nobody_closes_in_the_curve_has_a_gap_and_not_the_cap() -> None:
    """60 m behind, closing at 10 m/s: from 5 s on a curve, to the crash; at equal speeds there is none."""
    problem = rare_envs.DrivingProblem(FOLLOWING, ego=Coasting())
    for speed, crashes in ((10.0, True), (20.0, False)):
        axes = Figure().subplots()
        drive = drive_again(problem, np.array([20.0, speed, 60.0]))
        draw_measure(axes, drive)
        alone = np.asarray(axes.get_lines()[0].get_ydata())
        expected = 6.0 - drive.time if crashes else np.full(len(drive.time), np.inf)
        shown = (expected <= SHOWN_SECONDS) & (np.arange(len(expected)) < len(expected) - crashes)
        np.testing.assert_array_equal(np.isfinite(alone), shown)
        np.testing.assert_allclose(alone[shown], expected[shown], atol=2e-3)  # gaps are at least 1 cm
        words = {str(line.get_label()) for line in axes.get_lines()}
        assert axes.get_ylim() == (0.0, SHOWN_SECONDS) and ("crash" in words) is crashes


def test_a_run_without_a_failure_shows_its_bound() -> None:
    report = run(prepare(Question(env_id=FOLLOWING, base="i24", ego="idm", max_sim=200, method="mc")))
    high = report.estimate.interval[1]
    figure = Figure(layout="constrained")
    draw_answer(figure.subplots(), report)
    assert figure.axes[0].get_title().startswith(f"Collision: fewer than {one_in(high)} scenarios (95 %)")


@pytest.mark.parametrize("env_id", rare_envs.ENV_IDS)
def test_a_film_of_every_scenario_without_a_crash(env_id: str, tmp_path: Path) -> None:
    problem = rare_envs.DrivingProblem(env_id, horizon=1.0, noise=False)
    drive = drive_again(problem, problem.base.sample(1, np.random.default_rng(0))[0])
    shown = draw_frames(drive)
    assert len(shown) == 11 and drive.crash is None
    cursor = [np.flatnonzero((np.asarray(each)[-60] == MARKER).all(axis=-1)).mean() for each in shown]
    np.testing.assert_allclose(np.diff(cursor), np.mean(np.diff(cursor)), atol=1.1)  # the cursor moves evenly
    write_film(tmp_path / "small.gif", drive, width=400, every=2)
    with Image.open(tmp_path / "small.gif") as film:
        assert film.size[0] == 400


def test_sensitivity_is_shown_and_written(cli: Cli, tmp_path: Path) -> None:
    words = ("--base", "us101-gap", "--max-sim", 2000, *in_file(sensitivity=True), "--out", tmp_path)
    shown = cli("estimate", FOLLOWING, *words)
    assert shown.exit_code in (0, 3) and "importance (relative entropy of u_j given failure" in shown.stdout
    saved = json.loads((tmp_path / "result.json").read_text())["sensitivity"]
    assert {each["name"] for each in saved["columns"]} == {"ego_speed", "lead_speed", "gap"}
    assert any("gap" in each["name"] for each in saved["parameters"])
    assert (tmp_path / "sensitivity.png").exists()


def test_without_failures_a_note_says_why_there_is_no_sensitivity() -> None:
    for asked in (False, True):
        study = prepare(Question(env_id=FOLLOWING, method="mc", max_sim=50, sensitivity=asked))
        report = Report(study, samplers.estimate(study.problem, "mc", max_sim=50, seed=0), 1.0)
        assert report_as_json(report)["sensitivity"] is None
        note = "sensitivity is not known: No point failed (f <= 0): there is nothing to analyse."
        assert (note in report.notes) is asked
