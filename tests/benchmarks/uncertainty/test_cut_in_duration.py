"""Durations of lane changes: rows that are driven with their own duration, and the error of a ratio."""

import numpy as np
import pytest

import rare_envs
from benchmarks.uncertainty.cut_in_duration import compare_outcomes, drive_with_durations
from rare_envs.scenarios.cut_in import CUT_IN_DURATION
from training.scenario_fitting.shipped.cut_ins import CUT_IN_V0


def test_each_row_is_driven_with_its_own_duration():
    x = rare_envs.DrivingProblem(CUT_IN_V0, base="i80").base.sample(300, np.random.default_rng(1))
    own = rare_envs.DrivingProblem(CUT_IN_V0, base="i80").evaluate(x) <= 0.0
    assert own.any() and not own.all()
    assert (drive_with_durations(x, np.full(300, CUT_IN_DURATION)) == own).all()
    durations = np.where(np.arange(300) % 2 == 0, 8.0, 2.0)
    slow, fast = (drive_with_durations(x, np.full(300, seconds)) for seconds in (8.0, 2.0))
    assert (drive_with_durations(x, durations) == np.where(durations == 8.0, slow, fast)).all()
    assert slow.sum() > own.sum() > fast.sum()


def test_the_error_of_a_ratio_is_that_of_pairs():
    rng = np.random.default_rng(0)
    fixed = rng.random(20_000) < 0.02
    other = fixed & (rng.random(20_000) < 0.5)
    found = compare_outcomes("us101", "recorded", other, fixed)
    assert found.ratio == pytest.approx(other.sum() / fixed.sum())
    assert found.standard_error == pytest.approx(np.sqrt(found.ratio * (1 - found.ratio) / fixed.sum()), rel=0.01)
