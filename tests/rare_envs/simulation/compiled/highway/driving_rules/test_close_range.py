"""Compiled bounds at close range against the rule of collision avoidance."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import agents
from rare_envs.simulation.compiled.highway import read_dense_driver
from rare_envs.simulation.compiled.highway.driving_rules.close_range import brake_behind, limit_action_near
from rare_envs.simulation.compiled.highway.driving_rules.rule_numbers import DriverRules
from tests.rare_envs.simulation.compiled.highway.driving_rules.scenes import (
    RULES,
    N,
    beams_of,
    draw_features,
    own_motions,
)


def rules_of(rule) -> DriverRules:
    return DriverRules.of(read_dense_driver(replace(agents.load_driver("mgail5"), avoidance=rule)))


@pytest.mark.parametrize("kind", RULES)
def test_bounds_are_those_of_torch(kind):
    rng = np.random.default_rng(0)
    features, rules = draw_features(rng), rules_of(RULES[kind])
    action = torch.from_numpy(rng.uniform((-2.0, -0.3), (4.0, 0.3), (N, 2))).float()
    expected = RULES[kind].limit(features[:, None], action[:, None])[:, 0].numpy()
    beams, owns = beams_of(features), own_motions(features)
    found = [limit_action_near(*action[i].numpy(), owns[i], beams, i, rules) for i in range(N)]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    assert ((expected != action.numpy()).mean(axis=0) > 0.1).all()  # both kinds of bounds apply


def test_close_range_makes_a_difference_in_these_scenes():
    features = draw_features(np.random.default_rng(0))
    action = torch.tensor([1.0, 0.1]).expand(N, 1, 2)
    plain, close = (RULES[kind].limit(features[:, None], action) for kind in ("plain", "close range"))
    assert ((plain != close).float().mean(dim=(0, 1)) > 0.01).all()


@pytest.mark.parametrize("kind", RULES)
def test_braking_behind_a_body(kind):
    rng = np.random.default_rng(1)
    gap, closing, speed = (rng.uniform(low, high, 200).astype(np.float32) for low, high in ((-2, 5), (-5, 10), (0, 30)))
    expected = RULES[kind].greatest_acceleration_behind(*map(torch.from_numpy, (gap, closing, speed)))
    rules = rules_of(RULES[kind])
    found = [brake_behind(*row, rules) for row in zip(speed, gap, closing, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
