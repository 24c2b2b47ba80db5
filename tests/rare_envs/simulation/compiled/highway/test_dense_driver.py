"""Learned drivers are read with their present weights; changed ones are left to torch."""

import copy

import numpy as np
import pytest
import torch

import agents
from agents.learned.driver import LearnedDriver
from rare_envs.simulation.compiled.failures import NotCompiled
from rare_envs.simulation.compiled.highway import OffersDenseDriver, read_dense_driver


def changed(change):
    driver = agents.load_driver("mgail")
    policy = copy.deepcopy(driver.policy)
    driver = LearnedDriver(policy, driver.colour, weights=driver.weights)
    change(policy)
    return driver


def test_the_numbers_are_those_of_the_network():
    driver = agents.load_driver("mgail")
    dense = read_dense_driver(driver)
    features = torch.randn(7, 51) * 5 + driver.policy.scaling.feature_mean
    values = np.clip(
        (features.numpy() - dense.feature_mean) / dense.feature_deviation, -dense.feature_bound, dense.feature_bound
    )
    for weight, bias in dense.hidden:
        values = np.tanh(values @ weight.T + bias)
    layer = dense.head.reshape(4, -1)
    with torch.no_grad():
        assert np.allclose(
            values @ layer[:, :-1].T + layer[:, -1], driver.policy.head(driver.policy.trunk(features)), atol=1e-5
        )
    assert (dense.lag_1, dense.lag_2, dense.fresh) == (driver.colour.first, driver.colour.second, driver.colour.scale)
    assert (dense.low, dense.high) == ((-8.0, -0.3), (4.0, 0.3))


def test_a_driver_that_learns_on_is_read_as_it_is():
    driver = changed(lambda policy: policy.first.weight.data.mul_(2.0))
    assert np.allclose(
        read_dense_driver(driver).hidden[0][0], 2.0 * read_dense_driver(agents.load_driver("mgail")).hidden[0][0]
    )


class Other(LearnedDriver):
    """Could act in any way."""


@pytest.mark.parametrize(
    "driver",
    [
        Other(agents.load_driver("mgail").policy),
        changed(lambda policy: policy.double()),
        changed(lambda policy: policy.first.register_forward_hook(lambda *_: None)),
        changed(lambda policy: setattr(policy, "trunk", torch.tanh)),
    ],
)
def test_a_driver_that_was_changed_is_not_compiled(driver):
    assert isinstance(driver, OffersDenseDriver)
    with pytest.raises(NotCompiled, match="with a network or methods of its own is not compiled"):
        read_dense_driver(driver)
