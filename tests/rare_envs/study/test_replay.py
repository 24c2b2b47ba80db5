"""A scenario driven again: f is that of the rollout, and every moment is kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rare_envs
from rare_envs.study.arguments import BadInput
from rare_envs.study.replay import describe_drive, drive_again, find_failure
from tests.rare_envs.study.refusals import FOLLOWING


@pytest.mark.parametrize("env_id", rare_envs.ENV_IDS)
def test_a_replay_gives_the_same_f_bit_for_bit(env_id: str) -> None:
    problem = rare_envs.DrivingProblem(env_id, core="torch")
    learned = problem.world.background is not None  # whose products round differently by batch size
    x = problem.base.sample(3 if learned else 20, np.random.default_rng(0))
    tolerance = 1e-3 if learned else 0.0
    assert [drive_again(problem, row).f for row in x] == pytest.approx(problem.evaluate(x).tolist(), abs=tolerance)


@pytest.mark.parametrize("env_id", ["rare_envs/CutIn-v0", "rare_envs/HardBrake-v0"])
def test_a_replay_gives_the_f_of_a_compiled_rollout_to_rounding(env_id: str) -> None:
    problem = rare_envs.DrivingProblem(env_id, core="numba")
    x = problem.base.sample(20, np.random.default_rng(0))
    assert [drive_again(problem, row).f for row in x] == pytest.approx(problem.evaluate(x).tolist(), abs=1e-5)


def test_a_replay_ends_at_the_collision(risky: str) -> None:
    drive = drive_again(rare_envs.DrivingProblem(FOLLOWING, base=risky), np.array([20.0, 5.0, 10.0]))
    assert drive.collided and drive.f == -1.0
    # both keep braking or speed for a tick of 0.1 s; the bodies touch within the last one
    assert drive.gap[-2] > 0.0 >= drive.gap[-1]
    assert drive.worst == len(drive.time) - 1
    np.testing.assert_allclose(drive.speed[:, 1], 5.0)
    np.testing.assert_allclose(np.diff(drive.position[:, 1, 0]), 0.5, atol=1e-4)


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
