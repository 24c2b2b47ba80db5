"""The compiled course of a lane change, and the room beside, against their torch twins."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import agents
from agents.learned.lane_changes import ChangeState
from rare_envs.sensors.lidar import MAX_RANGE
from rare_envs.sensors.perception import RANGE_COLUMNS
from rare_envs.simulation.compiled.highway import read_dense_driver
from rare_envs.simulation.compiled.highway.driving_rules.change_course import slowness_of, steer_across, steer_within
from rare_envs.simulation.compiled.highway.driving_rules.lane_changing import distance_left
from rare_envs.simulation.compiled.highway.driving_rules.rule_numbers import DriverRules
from tests.rare_envs.simulation.compiled.highway.driving_rules.scenes import (
    CHANGES,
    RULES,
    N,
    draw_features,
    own_motions,
    single_settings,
)

FOREVER = replace(CHANGES["waiting"], coefficients=(-30.0, 0.0, 0.0, 0.0, 0.0))
"""Nobody begins a change."""


def in_changes(rng) -> ChangeState:
    """Vehicles half of which are in a change, some of them across the line."""
    state = FOREVER.begin(torch.zeros(N, 1, 2))
    draws = {name: torch.from_numpy(rng.random((N, 1))).float() for name in ("share", "pace", "distance")}
    side, crossed = (torch.from_numpy(rng.integers(low, 2, (N, 1))).float() for low in (-1, 0))
    unseen = torch.from_numpy(rng.uniform(0.0, 20.0, (N, 1, 2))).float()
    changed = state._replace(**draws, side=side, crossed=crossed, unseen=unseen)
    return changed._replace(distance=3.0 + draws["distance"], share=0.9 * draws["share"])


def test_the_way_across():
    rng = np.random.default_rng(6)
    state, features, settings = in_changes(rng), draw_features(rng), single_settings(FOREVER)
    state = state._replace(offset=features[:, None, 0])  # no line is crossed
    action, after = FOREVER.step(features[:, None], state, None)
    minds, owns = state._replace(side=after.side).pack()[:, 0].numpy(), own_motions(features)
    found = [steer_across(minds[i], owns[i], distance_left(minds[i], owns[i]), settings) for i in range(N)]
    changing = action.changing[:, 0].numpy()
    np.testing.assert_allclose(np.array(found)[changing], action.yaw_rate[:, 0][changing], rtol=1e-4, atol=1e-5)
    passed = [minds[i, 6] * slowness_of(owns[i].speed, settings) for i in range(N)]
    np.testing.assert_allclose(0.1 * np.array(passed), (after.share - state.share)[:, 0], rtol=1e-4, atol=1e-6)
    assert 0.3 < changing.mean() < 0.9


@pytest.mark.parametrize("kind", CHANGES)
def test_the_room_beside(kind):
    changes, rng = replace(CHANGES[kind], coefficients=FOREVER.coefficients), np.random.default_rng(7)
    driver = replace(agents.load_driver("mgail5"), changes=changes, avoidance=RULES["close range"])
    state, features = in_changes(rng), draw_features(rng)
    features[:, RANGE_COLUMNS] = MAX_RANGE
    state = state._replace(side=torch.zeros(N, 1), offset=features[:, None, 0])
    action, after = changes.step(features[:, None], state, None)
    left, right = driver.avoidance.greatest_yaw_rates_within(features[:, None], action.room)
    expected = torch.minimum(torch.maximum(torch.full_like(left, 0.05), -left), right)[:, 0].numpy()
    rules, minds, owns = DriverRules.of(read_dense_driver(driver)), after.pack()[:, 0].numpy(), own_motions(features)
    found = [steer_within(minds[i], np.float32(0.05), owns[i], rules) for i in range(N)]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    bound = (expected != np.float32(0.05)).mean()
    assert bound > 0.05 if kind == "waiting" else bound == 0.0
