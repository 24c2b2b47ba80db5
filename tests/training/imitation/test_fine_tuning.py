"""Fine-tuning goes on from a driver, hears the cost of what is driven beside it, and is repeatable."""

import dataclasses

import pytest
import torch

from agents import load_driver
from agents.learned.rule_driver import RuleDriver
from rare_envs.sensors.perception import RANGE_COLUMNS, SPEED_COLUMN
from tests.training.imitation.synthetic_scenes import tiny
from training.imitation import fine_tuning as module
from training.imitation.algorithms.config import HUMAN_NOISE
from training.imitation.fine_tuning import (
    NARROW_NOISE,
    StopAndGo,
    fine_tune,
    make_fine_tuning,
    mix_drivers,
    rule_cost,
)

FEW = tiny(updates=2, epochs=0, warm_up=1, colour=NARROW_NOISE)


@pytest.fixture(scope="module")
def mgail():
    return load_driver("mgail")


def weights_of(driver):
    return torch.cat([value.flatten() for value in driver.policy.state_dict().values()])


def tuned(data, driver, beside):
    return fine_tune(make_fine_tuning(data, driver, FEW), beside)


def test_it_goes_on_from_a_driver_which_stays_as_it_is(data, mgail):
    before = weights_of(mgail)
    one, again = (tuned(data, mgail, StopAndGo.draw(3, seed=0)) for _ in range(2))
    assert torch.equal(weights_of(mgail), before)
    assert torch.equal(weights_of(one), weights_of(again))
    assert 0.0 < (weights_of(one) - before).abs().max() < 0.01
    assert (one.colour, one.weights) == (NARROW_NOISE, None)
    assert all(torch.equal(a, b) for a, b in zip(one.policy.scaling, mgail.policy.scaling, strict=True))


def test_the_cost_of_what_is_driven_beside_counts(data, mgail):
    """A cost on the first bias alone moves it."""
    plain = tuned(data, mgail, lambda learner: torch.zeros(()))
    pulled = tuned(data, mgail, lambda learner: 1e4 * learner.policy.head.bias[0])
    assert pulled.policy.head.bias[0] < plain.policy.head.bias[0]


def test_stop_and_go_traffic_goes_on_and_starts_anew(data, mgail):
    beside = dataclasses.replace(StopAndGo.draw(3, seed=0), age=2 * module.DENSE_TICKS)
    learner = make_fine_tuning(data, mgail, FEW)
    ages = []
    for update in (0, 4, 8, 1):  # of four pools
        learner.update = update
        cost = beside(learner)
        assert cost.requires_grad
        assert float(cost.detach()) >= 0.0
        ages.append(beside.pools[update % module.DENSE_POOLS].age)
    assert ages == [module.DENSE_TICKS, 2 * module.DENSE_TICKS, module.DENSE_TICKS, module.DENSE_TICKS]


def test_the_rule_cost_is_the_squared_distance_from_the_rule(mgail):
    features = torch.zeros(4, 51)
    features[:, SPEED_COLUMN] = torch.tensor([0.0, 5.0, 10.0, 15.0])
    features[:2, RANGE_COLUMNS] = 100.0  # nobody in reach of the first two
    mean, _ = mgail.policy(features)
    action, _ = RuleDriver().act(features[None])
    wanted = action[0, :, 0].clamp(*module.RULE_BOUNDS)
    driven = mgail.policy.scaling.action_mean[0] + mgail.policy.scaling.action_std[0] * mean[:, 0]
    expected = ((driven - wanted) / mgail.policy.scaling.action_std[0]).square().mean()
    assert float(rule_cost(mgail.policy, features)) == pytest.approx(float(expected), rel=1e-4)


def test_a_mix_of_drivers_lies_between_them(mgail):
    other = load_driver("bc")
    half = mix_drivers(mgail, other, 0.5)
    torch.testing.assert_close(weights_of(half), 0.5 * (weights_of(mgail) + weights_of(other)))
    assert torch.equal(weights_of(mix_drivers(mgail, other, 1.0)), weights_of(other))
    assert torch.equal(weights_of(mix_drivers(mgail, other, 0.0)), weights_of(mgail))
    assert half.weights is None
    with pytest.raises(ValueError, match=r"from 0 to 1, got 1\.5"):
        mix_drivers(mgail, other, 1.5)


def test_the_narrow_noise_differs_from_that_of_people_in_its_low_frequencies_only():
    def power(noise, frequency):
        step = torch.exp(torch.tensor(-1j * frequency * 0.1))
        return float((noise.scale[0] / (1.0 - noise.first[0] * step - noise.second[0] * step**2)).abs().square())

    def neighbours(noise):  # correlation of lag 1, which decides the jerk
        return noise.first[0] / (1.0 - noise.second[0])

    assert power(NARROW_NOISE, 0.0) / power(HUMAN_NOISE, 0.0) == pytest.approx(0.41, abs=0.02)
    assert NARROW_NOISE.first[1] == HUMAN_NOISE.first[1]
    assert 1.0 - neighbours(NARROW_NOISE) == pytest.approx(1.0 - neighbours(HUMAN_NOISE), rel=0.06)
