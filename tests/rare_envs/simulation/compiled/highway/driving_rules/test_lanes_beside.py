"""The compiled look at the lanes beside against its torch twin."""

import numpy as np
import torch

from agents.learned.adjacent_lanes import look_aside
from rare_envs.simulation.compiled.highway.driving_rules.lanes_beside import LaneBeside, gap_after, look_beside
from tests.rare_envs.simulation.compiled.highway.driving_rules.scenes import (
    EAGER,
    N,
    beams_of,
    draw_features,
    own_motions,
    single_settings,
)


def test_who_is_ahead_and_behind_and_whether_there_is_a_lane():
    features, settings = draw_features(np.random.default_rng(2)), single_settings(EAGER)
    beams, owns = beams_of(features), own_motions(features)
    found = [look_beside(beams, i, owns[i], settings) for i in range(N)]
    for name, expected in look_aside(features)._asdict().items():
        values = [[getattr(lane, name) for lane in lanes] for lanes in found]
        np.testing.assert_allclose(values, expected, rtol=1e-5, atol=1e-5)
        assert 1 < len(torch.unique(expected))


def test_a_gap_after_some_time():
    lane = LaneBeside(*map(np.float32, (10.0, 2.0, 8.0, -1.0)), True)
    assert gap_after(lane, np.float32(1.0)) == 8.0 and gap_after(lane, np.float32(0.0)) == 8.0
    assert gap_after(lane, np.float32(3.0)) == 4.0
    nobody = LaneBeside(*map(np.float32, (np.inf, 0.0, np.inf, 0.0)), False)
    assert gap_after(nobody, np.float32(1.0)) == np.inf
