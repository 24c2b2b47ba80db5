"""Durations of lane changes: courses by pencil and paper, and rows that are driven with their own duration."""

import numpy as np
import pytest

import rare_envs
from benchmarks.uncertainty.cut_in_duration import (
    ENV_ID,
    compare_outcomes,
    course_durations,
    drive_with_durations,
    time_around_peak,
)
from rare_envs.scenarios.cut_in import CUT_IN, CUT_IN_DURATION
from rare_envs.scenarios.registry import SCENARIOS
from training.data.events import LATERAL_SPEED


@pytest.mark.parametrize(("duration", "displacement"), [(2.0, 3.5), (4.0, 3.0), (8.0, 2.5)])
def test_a_course_has_the_duration_it_was_made_with(duration, displacement):
    t = np.linspace(0.0, duration, 200_001)
    speed = 6.0 * displacement * (t / duration) * (1.0 - t / duration) / duration
    above = time_around_peak(speed, t)
    assert course_durations(np.array([above]), np.array([displacement])) == pytest.approx([duration], rel=1e-3)


def test_a_course_that_never_moves_so_long_is_the_one_that_moves_longest():
    assert course_durations(np.array([60.0]), np.array([3.0])) == pytest.approx([3.0 / LATERAL_SPEED])


def test_each_row_is_driven_with_its_own_duration():
    x = rare_envs.DrivingProblem(ENV_ID, base="i80").base.sample(300, np.random.default_rng(1))
    own = rare_envs.DrivingProblem(ENV_ID, base="i80").evaluate(x) <= 0.0
    assert own.any() and not own.all()
    assert (drive_with_durations(x, np.full(300, CUT_IN_DURATION), "i80") == own).all()
    durations = np.where(np.arange(300) % 2 == 0, 8.0, 2.0)
    slow, fast = (drive_with_durations(x, np.full(300, seconds), "i80") for seconds in (8.0, 2.0))
    assert (drive_with_durations(x, durations, "i80") == np.where(durations == 8.0, slow, fast)).all()
    assert slow.sum() > own.sum() > fast.sum()
    assert SCENARIOS[ENV_ID] is CUT_IN


def test_the_error_of_a_ratio_is_that_of_pairs():
    rng = np.random.default_rng(0)
    fixed = rng.random(20_000) < 0.02
    other = fixed & (rng.random(20_000) < 0.5)
    found = compare_outcomes("us101", "recorded", other, fixed)
    assert found.ratio == pytest.approx(other.sum() / fixed.sum())
    assert found.standard_error == pytest.approx(np.sqrt(found.ratio * (1 - found.ratio) / fixed.sum()), rel=0.01)
