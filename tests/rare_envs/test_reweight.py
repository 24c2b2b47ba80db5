"""Another base distribution from the simulations of one: against simulating anew."""

import dataclasses

import numpy as np
import pytest

import rare_envs
import samplers


def problem(base):
    return rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego="idm", base=base)


def wider(law, factor):
    return dataclasses.replace(law, covariances=factor * law.covariances)


def test_wider_traffic_against_simulating_it():
    us101 = problem("us101")
    changed = problem(wider(us101.base, 1.15))
    result = samplers.estimate(us101, "ce", seed=1)
    found, direct = result.reweight(changed.base), samplers.estimate(changed, "ce", seed=2)
    error = np.hypot(found.cov, direct.cov)
    assert abs(np.log(found.p / direct.p)) < 3.5 * error
    assert found.ratio > 1.2
    assert result.reweight(changed.space).p == found.p


@pytest.mark.parametrize(("old", "new"), [("us101", "highway"), ("highway", "us101")])
def test_the_two_shipped_bases_are_too_far_apart(old, new):
    result = samplers.estimate(problem(old), "ce", seed=1)
    with pytest.raises(ValueError, match="Estimate again with the new base"):
        result.reweight(problem(new).base)
