"""Another base distribution from the simulations of one: against simulating anew."""

import dataclasses

import numpy as np

import rare_envs
import samplers
from rare_envs.distributions.events import EventCounts
from rare_envs.distributions.fitted import FittedDistribution


def problem(base):
    return rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego="idm", base=base)


def wider(base, factor):
    fitted = base.distribution
    return dataclasses.replace(fitted, covariances=factor * fitted.covariances)


def test_wider_traffic_against_simulating_it():
    us101 = problem("us101-gap")
    changed = problem(wider(us101.base, 1.15))
    result = samplers.estimate(us101, "ce", seed=1)
    found, direct = result.reweight(changed.base), samplers.estimate(changed, "ce", seed=2)
    error = np.hypot(found.cov, direct.cov)
    assert abs(np.log(found.p / direct.p)) < 3.5 * error
    assert found.ratio > 1.2
    assert result.reweight(changed.space).p == found.p


def fitted_us101(number=30):
    """Return the base distribution of car-following with refits a few per cent wider and narrower."""
    us101 = problem("us101-gap").base
    return FittedDistribution(
        distribution=us101,
        refits=tuple(wider(us101, factor) for factor in np.linspace(0.8, 1.2, number)),
        events=EventCounts(used=(470,), clusters=28),
        family="3 components, plain gaps",
        siblings=lambda name: problem(name).base,
    )


def test_a_safer_ego_is_safer_under_every_refit_and_the_ratio_is_known_better_than_p():
    base = fitted_us101()
    careful, usual = (
        rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=rare_envs.IDM(max_deceleration=limit), base=base)
        for limit in (9.0, 7.0)
    )
    found = samplers.compare(usual, careful, seed=1, max_sim=8000)
    assert min(found.base_uncertainty.value_refits) > 1
    of_ratio, of_p = (np.ptp(np.log(each.base_uncertainty.interval)) for each in (found, found.either))
    assert of_ratio < of_p
