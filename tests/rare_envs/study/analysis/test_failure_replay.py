"""Failures that are driven once more are those of the run, with the run's weights."""

from __future__ import annotations

import numpy as np
import pytest

import rare_envs
import samplers
from rare_envs.control.idm import IDM
from rare_envs.study.severity import replay_failures
from rare_envs.traffic.crash import CRASH_KINDS

CUT_IN = "rare_envs/CutIn-v0"


def test_every_failure_ends_in_the_crash_of_its_scenario_again() -> None:
    problem = rare_envs.DrivingProblem(CUT_IN, ego=IDM(max_deceleration=1.0))
    estimate = samplers.estimate(problem, "mc", max_sim=1000, seed=0)
    failures, crash = replay_failures(problem, estimate)
    assert failures.weights.sum() == pytest.approx(estimate.p)
    assert (problem.evaluate(failures.x) <= 0.0).all()
    assert [CRASH_KINDS[kind] for kind in crash.kind] == problem.crash_kinds(failures.x)
    some = replay_failures(problem, estimate, most=3)
    assert np.array_equal(some.failures.x[0], failures.x[0])
    assert len(some.crash.kind) == 3


def test_an_ego_that_varies_cannot_be_seen_again() -> None:
    problem = rare_envs.DrivingProblem(CUT_IN, ego=IDM(max_deceleration=1.0))
    estimate = samplers.estimate(problem, "mc", max_sim=500, seed=0)
    problem.varies = True
    with pytest.raises(ValueError, match="vary from run to run"):
        replay_failures(problem, estimate)
