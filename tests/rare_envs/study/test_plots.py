from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import agents
import rare_envs
from rare_envs.scenarios.cut_in import CUT_IN
from rare_envs.scenarios.highway import HIGHWAY
from rare_envs.study.columns import list_columns
from rare_envs.study.errors import BadInput
from rare_envs.study.evaluate import Question, prepare, run
from rare_envs.study.plots import MOMENTS, draw_drive, rank_shifted_parameters, save_plot
from rare_envs.study.replay import drive_again

FOLLOWING = "rare_envs/CarFollowing-v0"


@pytest.mark.parametrize("env_id", rare_envs.ENV_IDS)
def test_a_replay_gives_the_same_f_bit_for_bit(env_id: str) -> None:
    problem = rare_envs.DrivingProblem(env_id)
    learned = problem.world.background is not None  # whose products round differently by batch size
    x = problem.base.sample(3 if learned else 20, np.random.default_rng(0))
    tolerance = 1e-3 if learned else 0.0
    assert [drive_again(problem, row).f for row in x] == pytest.approx(problem.evaluate(x).tolist(), abs=tolerance)


def test_a_replay_ends_at_the_collision(risky: str) -> None:
    problem = rare_envs.DrivingProblem(FOLLOWING, base=risky)
    drive = drive_again(problem, np.array([20.0, 5.0, 10.0]))
    assert drive.collided
    assert drive.f == -1.0
    # both keep braking or speed for a tick of 0.1 s; the bodies touch within the last one
    assert drive.gap[-2] > 0.0 >= drive.gap[-1]
    assert drive.worst == len(drive.time) - 1
    assert drive.time[-1] == pytest.approx(0.1 * (len(drive.time) - 1))
    np.testing.assert_allclose(drive.speed[:, 1], 5.0)
    np.testing.assert_allclose(np.diff(drive.position[:, 1, 0]), 0.5, atol=1e-4)


def test_the_worst_moment_of_a_near_miss_is_where_its_time_to_collision_is_least() -> None:
    problem = rare_envs.DrivingProblem(FOLLOWING)
    drive = drive_again(problem, np.array([20.0, 0.0, 60.0]))
    closing = drive.closing_speed > 0
    ttc = np.where(closing, drive.gap / np.where(closing, drive.closing_speed, 1.0), np.inf)
    assert not drive.collided
    assert 0 < drive.worst == int(np.argmin(ttc))
    assert drive.f == pytest.approx(ttc.min(), rel=1e-5)


def test_a_replay_without_a_collision_ends_at_the_horizon() -> None:
    problem = rare_envs.DrivingProblem(FOLLOWING, horizon=3.0)
    drive = drive_again(problem, np.array([10.0, 10.0, 100.0]))
    assert not drive.collided
    assert drive.time[-1] == pytest.approx(3.0)
    assert drive.f > 0


def test_a_replay_asks_a_policy_as_the_rollout_does(here: Path, risky: str) -> None:
    problem = rare_envs.DrivingProblem(FOLLOWING, ego=agents.load_ego("egos_here:coasting"))
    x = np.array([[20.0, 10.0, 25.0], [20.0, 19.0, 50.0]])
    assert [drive_again(problem, row).f for row in x] == problem.evaluate(x).tolist()
    # coasting closes 25 m at 10 m/s
    assert drive_again(problem, x[0]).time[-1] == pytest.approx(2.5, abs=0.15)


@pytest.mark.parametrize("env_id", rare_envs.ENV_IDS)
def test_the_legend_says_which_vehicle_is_which(env_id: str) -> None:
    problem = rare_envs.DrivingProblem(env_id, horizon=3.0)
    axes = list(Figure().subplots(MOMENTS + 1))
    draw_drive(axes, drive_again(problem, problem.base.sample(1, np.random.default_rng(0))[0]))
    legend = axes[-1].get_legend()
    assert legend is not None
    speeds = [f"speed of {label}" for label in problem.world.scenario.labels]
    assert [text.get_text() for text in legend.get_texts()] == [*speeds, "gap to the vehicle ahead"]


def test_vehicles_without_names_are_numbered() -> None:
    assert CUT_IN.labels == ("the ego", "the cutter", "the lead")
    numbered = replace(CUT_IN, vehicle_names=("ego", "vehicle_1", "vehicle_2"), labels=())
    assert numbered.labels == ("the ego", "vehicle 1", "vehicle 2")
    assert HIGHWAY.labels == ("the ego", *(f"lane {number}'s car" for number in (1, 2, 4, 5, 6)))


def test_the_most_shifted_parameters_come_first() -> None:
    space = rare_envs.DrivingProblem("rare_envs/CutIn-v0").space
    ordinary = space.sample(4000, np.random.default_rng(0))
    failures = space.sample(400, np.random.default_rng(1))
    failures[:, 3] -= 2.0 * ordinary[:, 3].std()
    failures[:, 1] += 1.0 * ordinary[:, 1].std()
    assert rank_shifted_parameters(space, ordinary, failures)[:2] == [3, 1]


def test_weights_and_noise_are_never_the_most_shifted() -> None:
    space = rare_envs.DrivingProblem("rare_envs/Highway-v0", horizon=2.0).space
    ordinary = space.sample(500, np.random.default_rng(0))
    failures = space.sample(50, np.random.default_rng(1))
    failures[:, 24:] += 100.0
    failures[:, 18:20] += (10.0, -20.0)
    order = rank_shifted_parameters(space, ordinary, failures)
    assert order[:2] == [19, 18]
    assert sorted(order) == list(range(24))


def test_columns_have_the_names_of_their_blocks() -> None:
    columns = list_columns(rare_envs.DrivingProblem("rare_envs/Highway-v0", horizon=2.0).space)
    assert [column.label for column in columns[:2]] == ["s[0] [m]", "s[1] [m]"]
    assert (columns[23].label, columns[24].label) == ("speed[5] [m/s]", "weights[0]")
    assert [column.shown for column in columns] == [True] * 24 + [False] * (404 + 220)
    assert [column.name for column in list_columns(rare_envs.DrivingProblem(FOLLOWING).space)] == [
        "ego_speed",
        "lead_speed",
        "gap",
    ]


def test_replicates_and_policies_are_drawn_too(here: Path, risky: str, tmp_path: Path) -> None:
    question = Question(env_id=FOLLOWING, base=risky, ego="egos_here:coasting", replicates=3, max_sim=3000, method="mc")
    report = run(prepare(question))
    save_plot(tmp_path / "plot.png", report)
    assert (tmp_path / "plot.png").stat().st_size > 20_000


def test_progress_reaches_the_caller(risky: str) -> None:
    seen: list[int] = []
    report = run(prepare(Question(env_id=FOLLOWING, base=risky)), lambda progress: seen.append(progress.n_sim))
    assert seen == sorted(seen)
    assert seen[-1] == report.estimate.n_sim


def test_a_question_is_checked_in_python_as_on_the_command_line() -> None:
    with pytest.raises(BadInput, match="'adss'"):
        prepare(Question(env_id=FOLLOWING, method="addss"))
