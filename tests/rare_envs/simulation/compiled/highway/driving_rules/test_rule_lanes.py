"""Compiled rules of drivers against `LearnedDriver.act`, whose network acts in both."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import agents
from rare_envs.simulation.compiled.highway import read_dense_driver
from rare_envs.simulation.compiled.highway.driving_rules.rule_lanes import apply_rules, ease_braking
from rare_envs.simulation.compiled.highway.driving_rules.rule_numbers import DriverRules
from tests.rare_envs.simulation.compiled.highway.driving_rules.scenes import (
    CHANGES,
    N,
    beams_of,
    draw_features,
    own_motions,
)

SHIPPED = agents.load_driver("mgail5")
DRIVERS = {
    "mgail3": agents.load_driver("mgail3"),
    "mgail4, eager": replace(agents.load_driver("mgail4"), changes=CHANGES["given up"]),
    "mgail5, eager": replace(SHIPPED, changes=CHANGES["waiting"]),
    "close range alone": replace(SHIPPED, changes=None),
}


@pytest.mark.parametrize("name", DRIVERS)
def test_actions_and_minds_tick_after_tick(name):
    driver, rng = DRIVERS[name], np.random.default_rng(8)
    network = replace(driver, changes=None, avoidance=None, hard_braking=1.0)
    rules = DriverRules.of(read_dense_driver(driver))
    memory = driver.begin(torch.from_numpy(rng.normal(size=(N, 1, 2, 2))).float())
    minds, ruled = memory.flatten(2)[:, 0, 4:].numpy().copy(), 0
    for _ in range(6):
        features, draws = draw_features(rng), torch.from_numpy(rng.normal(size=(N, 1, 2))).float()
        noise = memory.flatten(2)[..., :4].reshape(N, 1, 2, 2)
        with torch.no_grad():
            plain, _ = network.act(features[:, None], None, draws, noise)
            expected, memory = driver.act(features[:, None], None, draws, memory)
        beams, owns = beams_of(features), own_motions(features)
        for i in range(0, N, 3):
            action = apply_rules(
                tuple(plain[i, 0].numpy()), owns[i], beams, i, minds[i], tuple(draws[i, 0].numpy()), rules
            )
            assert np.allclose(action, expected[i, 0], rtol=1e-4, atol=1e-4)
        assert np.allclose(minds[::3], memory.flatten(2)[::3, 0, 4:], rtol=1e-4, atol=1e-4)
        ruled += (plain != expected)[:, 0].float().mean(dim=0).numpy()
    assert (ruled > 0.5).all()


def test_half_of_hard_braking():
    rules = DriverRules.of(read_dense_driver(replace(SHIPPED, hard_braking=0.5)))
    found = [ease_braking(np.float32(each), rules) for each in (1.0, -2.0, -4.0)]
    assert found == [1.0, -2.0, -3.0]
